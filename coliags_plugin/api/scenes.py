"""Reading, checking, making and measuring of scenes, and their reconstruction from images, each in one call."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from coliags_plugin.config.options import (
    CheckDataOptions,
    CoverageOptions,
    DepthOptions,
    PosesOptions,
    ReconstructOptions,
    takes,
)
from coliags_plugin.config.yaml_tree import assignments, parse_assignments, settings_of
from coliags_plugin.core.errors import InputError, check_number
from coliags_plugin.core.files import refuse_existing, refuse_overlap, user_path

if TYPE_CHECKING:
    from coliags_plugin.checks.data.check import SceneCheck
    from coliags_plugin.core.scenes import Scene
    from coliags_plugin.pipeline.stages import Record
    from coliags_plugin.surface.coverage.writing import MeasuredCoverage

log = logging.getLogger(__name__)


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


@takes(CheckDataOptions)
def check_data(options: CheckDataOptions) -> SceneCheck:
    """Check that images, poses, depth and calibration of a scene agree (docs/data.md 4): suspect are its ``findings``.

    Raises:
        InputError: The scene cannot be read, an option is unknown or invalid, or the page cannot be written.
    """
    from coliags_plugin.checks.data.check import check_scene
    from coliags_plugin.checks.data.page import ShownCheck, check_page
    from coliags_plugin.engine.data_formats import open_scene
    from coliags_plugin.engine.progress import progress_callback
    from coliags_plugin.reporting.html_page import write_html

    with progress_callback() as progress:
        scene = open_scene(options.scene, options.data_format, options.settings, progress)
        stored = partial(open_scene, options.scene, scene.provenance.dataset, options.settings, stored_size=True)
        check = ShownCheck(**vars(check_scene(scene, progress, stored if scene.is_resized else None)))
    if options.html is not None:
        write_html(check_page(check), options.html)
    return check


@dataclass(frozen=True)
class EstimatedScene:
    """A scene that was written, and what was found."""

    folder: Path  # the scene's, to train on
    summary: str  # in a line or several
    settings: Mapping[str, object]  # of training with split and size of its source


@takes(DepthOptions)
def estimate_depth(options: DepthOptions) -> EstimatedScene:
    """Estimate the dense depth of a scene with known poses, with its confidence; write it as a scene (docs/depth.md).

    What an interrupted call has left, the same call goes on with.

    Raises:
        InputError: The scene cannot be read or its frames agree on no surface, an option is unknown or invalid, or the
            folder exists or cannot be written.
    """
    from coliags_plugin.engine.data_formats import open_scene
    from coliags_plugin.engine.progress import progress_callback
    from coliags_plugin.reconstruction.depth.scene import estimate_scene, training_options
    from coliags_plugin.reconstruction.depth.sweeping import DepthEstimationSettings

    refuse_overlap(output := options.output, options.scene)
    refuse_existing(output, options.overwrite)
    near_far = None if options.near is None or options.far is None else (options.near, options.far)
    if near_far is None and options.near != options.far:
        raise InputError("`near` without `far`, or the reverse", "both or neither")
    check_number("jobs", options.jobs)
    chosen = [item.removeprefix("depth.") for item in options.settings if item.startswith("depth.")]
    settings = settings_of(DepthEstimationSettings, chosen, "depth.")
    # Images are read when they are needed, so that memory does not grow with the video.
    of_manager = [item for item in options.settings if not item.startswith("depth.")]
    reading = ["initial_points=none", "keep_pixels=false", *of_manager]
    with progress_callback() as progress:
        scene = open_scene(options.scene, options.data_format, reading, progress)
        summary, warnings, _ = estimate_scene(
            scene, output, settings, near_far, options.prior, options.jobs, options.overwrite, progress
        )
    for warning in warnings:
        log.warning(warning)
    return EstimatedScene(output, summary, parse_assignments(training_options(scene)))


@takes(PosesOptions)
def estimate_poses(options: PosesOptions) -> EstimatedScene:
    """Estimate poses, intrinsics and surface points from images alone; write them as a scene (docs/poses.md).

    Raises:
        InputError: The images cannot be read or no model of them is found, an option is unknown or invalid, or the
            folder exists or cannot be written.
    """
    from coliags_plugin.engine.progress import progress_callback
    from coliags_plugin.pipeline.frame_sources import image_files, opened_recording
    from coliags_plugin.pipeline.survey import FrameSurvey
    from coliags_plugin.reconstruction.structure.colmap_scene import write_sfm_scene
    from coliags_plugin.reconstruction.structure.image_files import Masks, masks_for, read_image
    from coliags_plugin.reconstruction.structure.sfm import millimetres, reconstruct, scaled
    from coliags_plugin.reconstruction.structure.sfm_settings import SfmSettings

    refuse_overlap(options.output, options.frames)
    refuse_existing(options.output, options.overwrite)
    check_number("every", options.every)
    check_number("max_frames", options.max_frames, least=2)
    known = [length for length in (options.diameter, options.distance and options.distance[2]) if length is not None]
    if len(known) > 1 or not all(0.0 < length < float("inf") for length in known):
        lengths = " and ".join(f"{length:g} mm" for length in known)
        raise InputError(f"{lengths} by `diameter` or `distance`", "one length above 0")
    named = [] if options.camera is None else [f"camera.model={options.camera}"]
    named += [] if options.params is None else [f"camera.params=[{options.params}]"]
    frames, settings = opened_recording(options.frames, settings_of(SfmSettings, [*named, *options.settings]))
    survey = FrameSurvey(frames)
    with progress_callback() as progress, image_files(frames, progress) as files:
        images = files[:: options.every][: options.max_frames]
        for path in images if frames.is_dir() else files:
            survey.add(read_image(path))
        masks: Masks = (surveyed := survey.mask())
        if options.mask is not None:
            masks = masks_for(options.mask, images)
        elif surveyed is not None:
            share = 100.0 * (1.0 - surveyed.mean())
            log.info("ignored: black surroundings and overlays, %.0f %% of the image", share)
        atlas = reconstruct(images, settings, masks, progress)
        factor = millimetres(atlas.largest, options.diameter, options.distance)
        if factor is not None:
            atlas = replace(atlas, models=(scaled(atlas.largest, factor), *atlas.models[1:]))
        write_sfm_scene(options.output, atlas, masks, options.overwrite, [] if factor is None else ["mm"])
    found = f"mm, {factor:.4g} per unit of the model" if factor else "unknown, as images alone do not determine it"
    depth, hint = atlas.largest.median_depth, "" if factor else " (`diameter` or `distance` fix the scale)"
    summary = f"{atlas.summary()}\nunit: {found}; the median depth of the points is {depth:.4g}{hint}"
    return EstimatedScene(options.output, summary, {})


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
