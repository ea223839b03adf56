"""Runs from training and from files of Gaussians."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from coliags_plugin.api.runs import Run
from coliags_plugin.config.assignments import assignments
from coliags_plugin.config.method_config import method_name
from coliags_plugin.core.errors import InputError
from coliags_plugin.engine.run_folder import RunFolder

if TYPE_CHECKING:
    from coliags_plugin.contracts import Follower  # with torch

log = logging.getLogger(__name__)


def train(
    method: str,
    data: str | Path,
    output: str | Path | None = None,
    *,
    steps: int | None = None,
    seed: int | None = None,
    settings: Mapping[str, Any] | None = None,
    renderer: str | None = None,
    data_format: str | None = None,
    device: str = "auto",
    resume: bool = False,
    overwrite: bool = False,
    loggers: Sequence[str] = (),
    view_port: int | None = None,
) -> Run:
    """Train a method on a scene.

    Args:
        method: Name of a method or path of a method config.
        data: The scene's folder.
        output: Run folder; None: ``runs/SCENE/METHOD/STAMP``, or the newest of these when resuming.
        steps: Training steps, schedules being scaled to them; None: the method's, or those of the resumed run.
        seed: Seed of all random generators; None: 0, or that of the resumed run.
        settings: Changes of the method config by key path, for instance ``{"field.voxel_size": 1.0}``.
        renderer: Name of a renderer; None: the method's.
        data_format: Name of a data manager; None: the method's, or the one that recognises the folder.
        device: ``auto``, ``cpu``, ``cuda`` (the first CUDA device) or ``cuda:N``.
        resume: Continue from the run's latest checkpoint.
        overwrite: Replace an existing run folder.
        loggers: What also gets the training log, by name: ``tensorboard``, ``wandb``, or of another package.
        view_port: Port at which browsers see the run while it is trained; None: they do not; 0: any free one.

    Raises:
        InputError: Method, data or options are invalid or do not fit each other, or a logger's library is missing;
            nothing was written.
        InterruptedRunError: Ctrl-C, SIGTERM or SIGHUP, after the state was saved.
        NotFiniteError: A loss or parameter became NaN or infinite.
    """
    from coliags_plugin.engine.devices import choose_device
    from coliags_plugin.engine.loggers import find_loggers
    from coliags_plugin.engine.training import TrainingRequest, open_training

    if resume and overwrite:
        raise InputError("--resume and --overwrite together", "one of them")
    data, on = Path(data), choose_device(device)
    named = {"schedule.steps": steps, "renderer.name": renderer}
    chosen = {key: value for key, value in named.items() if value is not None}
    request = TrainingRequest(method, data, (*assignments(settings), *assignments(chosen)), seed, data_format)
    chosen_loggers = find_loggers(loggers)
    if view_port is not None:
        from coliags_plugin.export.viewer.serving import check_server

        check_server("127.0.0.1", view_port)
    folder = _run_folder(method, data, output, resume)
    if_exists: Literal["resume", "overwrite", "refuse"] = "resume" if resume else "overwrite" if overwrite else "refuse"
    with open_training(request, folder, on, if_exists) as trainer:
        title = f"{trainer.method.name} on {trainer.scene.name}, seed {trainer.seed}"
        config = trainer.method.config.model_dump()
        followers: list[Follower] = [logger(folder.path, title, config, trainer.step) for logger in chosen_loggers]
        if view_port is not None:
            from coliags_plugin.export.viewer.live import LiveView

            live = LiveView(trainer, view_port)
            log.info("%s shows the run until training ends", live.viewer.url)
            followers.append(live)
        trainer.train(followers=followers)
    return Run(folder.path, data=data, device=device)


def _run_folder(method: str, data: Path, output: str | Path | None, resume: bool) -> RunFolder:
    if output is not None:
        return RunFolder(Path(output))
    scene_name, short = data.resolve().name, method_name(method).rsplit("/", maxsplit=1)[-1]
    return RunFolder.newest(scene_name, short) if resume else RunFolder.default(scene_name, short)


def import_splats(
    file: str | Path,
    data: str | Path,
    output: str | Path | None = None,
    *,
    data_format: str | None = None,
    device: str = "auto",
    overwrite: bool = False,
) -> Run:
    """Make a run of a file of 3D Gaussians on a scene, at step 0, to evaluate, render and mesh.

    Args:
        file: PLY or SPZ, in the world frame and unit of the scene.
        data: The scene's folder.
        output: Run folder; None: ``runs/SCENE/imported/STAMP``.
        data_format: Name of a data manager; None: the one that recognises the folder.
        device: ``auto``, ``cpu``, ``cuda`` (the first CUDA device) or ``cuda:N``.
        overwrite: Replace an existing run folder.

    Raises:
        InputError: The file is damaged, compressed or of another lineage, the scene cannot be read, or the folder
            exists or cannot be written.
    """
    from coliags_plugin.engine.devices import choose_device
    from coliags_plugin.export.baking.importing import import_run

    scene = Path(data)
    folder = RunFolder.default(scene.resolve().name, "imported") if output is None else RunFolder(Path(output))
    import_run(Path(file), scene, folder, choose_device(device), data_format, overwrite)
    return Run(folder.path, data=scene, device=device)
