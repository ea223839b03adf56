"""Training in one call."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from coliags_plugin.api.runs import Run
from coliags_plugin.config.assignments import assignments
from coliags_plugin.config.method_config import method_name
from coliags_plugin.core.errors import InputError
from coliags_plugin.engine.run_folder import RunFolder

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
        device: ``auto``, ``cpu`` or ``cuda``.
        resume: Continue from the run's latest checkpoint.
        overwrite: Replace an existing run folder.

    Raises:
        InputError: Method, data or options are invalid or do not fit each other; nothing was written.
        InterruptedRunError: Ctrl-C, after the state was saved.
        NotFiniteError: A loss or parameter became NaN or infinite.
    """
    from coliags_plugin.engine.data_formats import load_method_for, load_scene
    from coliags_plugin.engine.devices import choose_device
    from coliags_plugin.engine.resuming import resumed_method, resumed_seed
    from coliags_plugin.engine.trainer import Trainer

    if resume and overwrite:
        raise InputError("--resume and --overwrite together", "one of them")
    data, on = Path(data), choose_device(device)
    named = {"schedule.steps": steps, "renderer.name": renderer}
    chosen = {key: value for key, value in named.items() if value is not None}
    overrides = (*assignments(settings), *assignments(chosen))
    folder = _run_folder(method, data, output, resume)
    if resume:
        folder = RunFolder.existing(folder.path)
        loaded = resumed_method(folder, method, data, overrides, data_format)
        seed = resumed_seed(folder, seed)
    else:
        folder.check_free(overwrite)
        loaded = load_method_for(data, method, overrides, data_format)
    trainer = Trainer(loaded, load_scene(loaded.config, data), str(data.resolve()), folder, seed or 0, on)
    log.info("renderer %s: %s", trainer.chosen.name, trainer.chosen.reason)
    if resume:
        trainer.resume()
    else:
        trainer.start(overwrite)
    trainer.train()
    return Run(folder.path, data=data, device=device)


def _run_folder(method: str, data: Path, output: str | Path | None, resume: bool) -> RunFolder:
    if output is not None:
        return RunFolder(Path(output))
    scene_name, short = data.resolve().name, method_name(method).rsplit("/", maxsplit=1)[-1]
    return RunFolder.newest(scene_name, short) if resume else RunFolder.default(scene_name, short)
