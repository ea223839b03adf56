"""Runs from training and from files of Gaussians."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from coliags_plugin.api.runs import Run
from coliags_plugin.config.method_config import method_name
from coliags_plugin.config.options import ImportOptions, TrainOptions, takes
from coliags_plugin.core.errors import InputError
from coliags_plugin.engine.run_folder import RunFolder

if TYPE_CHECKING:
    from coliags_plugin.contracts import Follower  # with torch
    from coliags_plugin.core.scenes import Scene

log = logging.getLogger(__name__)


@takes(TrainOptions)
def train(options: TrainOptions, *, view_port: int | None = None) -> Run:
    """Train a method on a scene.

    Images, poses and depth that contradict each other, as far as that is quickly seen, are warned of.

    Args:
        options: See below; settings by key path, for instance ``{"field.voxel_size": 1.0}``.
        view_port: Port at which browsers see the run while it is trained; None: they do not; 0: any free one.

    Raises:
        InputError: Method, data or options are invalid or do not fit each other, or a logger's library is missing;
            nothing was written.
        InterruptedRunError: Ctrl-C, SIGTERM or SIGHUP, after the state was saved.
        NotFiniteError: A loss or parameter became NaN or infinite.
    """
    from coliags_plugin.engine.devices import choose_device
    from coliags_plugin.engine.loggers import find_loggers
    from coliags_plugin.engine.trainer import IfExists, open_training

    if options.resume and options.overwrite:
        raise InputError("`resume=True` and `overwrite=True` together", "one of them")
    on = choose_device(options.device)
    chosen_loggers = find_loggers(options.loggers)
    if view_port is not None:
        from coliags_plugin.export.viewer.live import check_server

        check_server("127.0.0.1", view_port)
    folder = _run_folder(options)
    if_exists: IfExists = "resume" if options.resume else "overwrite" if options.overwrite else "refuse"
    with open_training(options, folder, on, if_exists) as trainer:
        if not options.resume:
            warn_of_suspect_data(trainer.scene)
        title = f"{trainer.method.name} on {trainer.scene.name}, seed {trainer.seed}"
        config = trainer.method.config.model_dump()
        followers: list[Follower] = [logger(folder.path, title, config, trainer.step) for logger in chosen_loggers]
        if view_port is not None:
            from coliags_plugin.export.viewer.live import Viewer

            viewer = Viewer.of_training(trainer, view_port)
            log.info("%s shows the run until training ends", viewer.url)
            followers.append(viewer)
        trainer.train(followers=followers)
    return Run(folder.path, data=options.data, device=options.device)


def warn_of_suspect_data(scene: Scene) -> None:
    """Warn of what the quick checks of ``coliags data check`` find, in the lengths of the dataset."""
    from coliags_plugin.checks.data.check import check_scene

    stored = scene.scaled(1.0 / scene.provenance.training_scale)
    for finding in check_scene(stored, match_images=False).findings:
        log.warning("%s", finding)


def _run_folder(options: TrainOptions) -> RunFolder:
    if options.output is not None:
        return RunFolder(options.output)
    scene_name = options.data.resolve().name
    short = method_name(options.method).rsplit("/", maxsplit=1)[-1]
    return RunFolder.newest(scene_name, short) if options.resume else RunFolder.default(scene_name, short)


@takes(ImportOptions)
def import_splats(options: ImportOptions) -> Run:
    """Make a run of a file of 3D Gaussians on a scene, at step 0, to evaluate, render and mesh.

    Raises:
        InputError: The file is damaged, compressed or of another lineage, the scene cannot be read, or the folder
            exists or cannot be written.
    """
    from coliags_plugin.engine.devices import choose_device
    from coliags_plugin.export.baking.exporting import import_run

    scene = options.data.resolve().name
    folder = RunFolder.default(scene, "imported") if options.output is None else RunFolder(options.output)
    device = choose_device(options.device)
    import_run(options, folder, device)
    return Run(folder.path, data=options.data, device=options.device)
