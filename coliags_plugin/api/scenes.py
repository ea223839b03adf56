"""Reading, making, measuring and reconstruction of scenes, each in one call."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from coliags_plugin.config.options import CoverageOptions, ReconstructOptions, takes
from coliags_plugin.config.yaml_tree import assignments, settings_of
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import refuse_existing, user_path

if TYPE_CHECKING:
    from coliags_plugin.core.scenes import Scene
    from coliags_plugin.pipeline.stages import Record
    from coliags_plugin.surface.coverage.writing import MeasuredCoverage


def load_scene(data: str | Path, data_format: str | None = None, settings: Mapping[str, Any] | None = None) -> Scene:
    """Read a scene.

    Args:
        data: The scene's folder.
        data_format: Name of a data manager; None: the one that recognises the folder.
        settings: Options of the data manager, for instance ``{"frame_step": 4}``.

    Raises:
        InputError: The folder is missing, of no known format or damaged, or an option is unknown.
    """
    from coliags_plugin.engine.data_formats import READING_IS_LONG, open_scene
    from coliags_plugin.engine.progress import progress_callback

    with progress_callback(after=READING_IS_LONG) as progress:
        return open_scene(user_path(data), data_format, assignments(settings), progress)


def make_phantom(output: str | Path, /, *, overwrite: bool = False, **settings: Any) -> Path:
    """Generate a synthetic, physically lit colon with exact ground truth, in the layout of a dataset.

    Args:
        output: Folder to make.
        overwrite: Replace the folder where it exists.
        settings: Settings of the phantom (docs/phantom.md 6), for instance ``seed=1, light="strong", frames=60``.

    Returns:
        The folder, a scene to train on.

    Raises:
        InputError: A setting is unknown or invalid, or the folder exists or cannot be written.
    """
    from coliags_plugin.engine.progress import progress_callback
    from coliags_plugin.phantom.generate import generate
    from coliags_plugin.phantom.settings import phantom_settings

    with progress_callback() as progress:
        generate(phantom_settings(settings), folder := user_path(output), overwrite=overwrite, progress=progress)
    return folder


@takes(CoverageOptions)
def measure_scene_coverage(data: str | Path, options: CoverageOptions) -> MeasuredCoverage:
    """Measure what a scene's recording shows of a mesh of the wall, without a run. Research use only.

    Raises:
        InputError: An option is unknown, missing or invalid; the scene or the mesh cannot be read or do not belong
            together; or the folder exists or cannot be written.
    """
    from coliags_plugin.geometry.meshes.mesh import read_mesh
    from coliags_plugin.surface.coverage.visibility import CoverageSettings
    from coliags_plugin.surface.coverage.writing import measure_scene, open_recording

    if options.mesh is None or options.output is None:
        raise InputError(
            f"{data} is not a run folder", "a run folder, or a scene's folder with `mesh=FILE` and `output=FOLDER`"
        )
    settings = settings_of(CoverageSettings, options.settings)
    refuse_existing(options.output, options.overwrite)
    recording, wall = open_recording(user_path(data)), read_mesh(options.mesh)
    return measure_scene(recording, wall, options.output, settings, options.overwrite)


@takes(ReconstructOptions)
def reconstruct(options: ReconstructOptions) -> Record:
    """Reconstruct a colon from a video: frames, poses, depth, training, mesh and report, one folder for all.

    What is done is kept: the same call goes on with what an interrupted one has left (docs/reconstruct.md).

    Returns:
        The record: what each stage made, with which options, in what time; of a video that is longer than a segment
        (``frames.segment``), those of each segment behind its folder: ``record.stages["segment-000/poses"]``.

    Raises:
        InputError: The video or a setting is not valid, or a stage cannot be done; what was done before stands.
        InterruptedRunError: Ctrl-C in training, after the state was saved.
    """
    from coliags_plugin.engine.devices import choose_device
    from coliags_plugin.engine.progress import progress_callback
    from coliags_plugin.engine.tasks import ExecutionOptions
    from coliags_plugin.pipeline.reconstruct import reconstruct as run
    from coliags_plugin.pipeline.settings import ReconstructionSettings

    chosen = settings_of(ReconstructionSettings, options.settings)
    by_workers, where, execution = options.executor is not None or options.jobs is not None, options.device, None
    if by_workers:
        executor, address = options.executor or "local", options.ray_address
        execution = ExecutionOptions(options.jobs, options.threads, where, executor, address)
    device = choose_device("cpu" if by_workers else where)
    with progress_callback() as progress:
        return run(options.video, options.output, chosen, device, options.mask, options.overwrite, progress, execution)
