"""From a video, a folder of images or a posed scene to mesh and report, in stages that a repeated call goes on with."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import torch

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import refuse_overlap
from coliags_plugin.core.locks import locked
from coliags_plugin.core.progress import Progress
from coliags_plugin.datamanagers.recognition import find_format, recognised
from coliags_plugin.execution.executors import ExecutionOptions
from coliags_plugin.execution.queue import make_executor
from coliags_plugin.pipeline.chain import stages_of
from coliags_plugin.pipeline.context import StageContext
from coliags_plugin.pipeline.frame_sources import FrameSource, Span, frame_source, opened_recording
from coliags_plugin.pipeline.jobs import PartJobs, run_jobs
from coliags_plugin.pipeline.page import write_index
from coliags_plugin.pipeline.procedure.run import FinishedProcedure, reconstruct_procedure
from coliags_plugin.pipeline.settings import FrameSettings, ReconstructionSettings
from coliags_plugin.pipeline.stages import LOCK_FILE, Record, run_stages
from coliags_plugin.reconstruction.structure.sfm_settings import SfmSettings
from coliags_plugin.reporting.numbers import duration, file_size

log = logging.getLogger(__name__)

#: In which the progress of jobs is told: thousandths of a video.
_UNITS = 1000


def reconstruct(
    source: Path,
    out: Path,
    settings: ReconstructionSettings,
    device: torch.device,
    mask: Path | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
    execution: ExecutionOptions | None = None,
) -> Record | FinishedProcedure:
    """Reconstruct a video, or go on with what was begun; arguments as in :func:`coliags_plugin.reconstruct`.

    Raises:
        InputError: The source cannot be read; a stage cannot be done; ``out`` is something else, or was made with
            other settings; or another process works on it.
        InterruptedRunError: Ctrl-C in training, after the state was saved.
    """
    refuse_overlap(out, source)
    if mask is not None and not mask.is_file():
        raise InputError(f"no file {mask}", "an image, black where pixels are ignored", "Check --mask")
    data_format = find_format(source) if source.is_dir() and recognised(source) else None
    frames, is_long = settings.frames, False
    if data_format is None:
        source, sfm = opened_recording(source, settings.sfm)
        settings = settings.model_copy(update={"sfm": sfm})
        video = frame_source(source, Span(frames.first, frames.last, frames.seek))
        log.info("%s", forecast(video, settings))
        is_long = video.expected > frames.segment * frames.every
    else:
        _refuse_unused(source, settings, mask)
    context = StageContext(out, source, settings, mask, data_format, device, progress)
    if is_long:
        with locked(out / LOCK_FILE, out):
            return reconstruct_procedure(context, execution or ExecutionOptions(jobs=1, device=str(device)), overwrite)
    Record.of(out)  # refuses another folder before anything is written
    stages = stages_of(context)
    with locked(out / LOCK_FILE, out):
        if execution is not None:
            return _by_workers(context, execution, overwrite)
        record = Record.of(out)
        record.places = context.places
        record.write()  # so that the folder is known for one from now on, whatever happens in the first stage
        record.take_over_all()
        failure = run_stages(stages, record, overwrite, lambda: stages_of(context))
        write_index(record, context.posed, f"Reconstruction of {source.resolve().name}")
    if failure is not None:
        raise failure
    return record


def _by_workers(context: StageContext, execution: ExecutionOptions, overwrite: bool) -> Record:
    """Run the stages as tasks of worker processes: one for those that all need, then one for each sub-map."""
    executor = make_executor(execution)
    executor.check(context.out, [path for path in (context.source, context.mask) if path is not None])
    jobs = PartJobs(context, executor, execution, overwrite, _UNITS)
    run_jobs(executor, execution, jobs.jobs(), _UNITS)
    for part in (None, 0):
        if part in jobs.failures:
            raise InputError(jobs.failures[part])
    return jobs.record


def _refuse_unused(source: Path, settings: ReconstructionSettings, mask: Path | None) -> None:
    """Refuse settings of stages that a scene with poses does not need."""
    unused = {
        "mask": mask is not None,
        "diameter": settings.diameter is not None,
        "frames": settings.frames != FrameSettings(),
        "sfm": settings.sfm != SfmSettings(),
    }
    if given := ", ".join(name for name, is_given in unused.items() if is_given):
        raise InputError(
            f"{source} has poses, and settings of {given} are given",
            "these for a video or a folder of images alone",
            "Leave them out, or give the folder of the scene's images, for their poses to be estimated",
        )


#: Seconds of a CPU core, of a patient's clip on an AMD EPYC (docs/reconstruct.md 5): poses of a frame; depth and
#: evaluation of a frame with a pose; a training step; and what every sub-map takes besides. Depth and training are of
#: so many pixels there, and of so many at most.
_POSES, _FRAME, _STEP, _SUBMAP = 1.1, 1.7, 0.24, 75.0
_TRAINED_PIXELS, _MOST_PIXELS = 270 * 270, 338 * 270
#: Share of the frames that get a pose, and frames of a sub-map, in that clip; training steps of a frame, of 2000.
_POSED, _SUBMAP_FRAMES, _STEPS = 0.92, 45, 23
#: Bytes: of a pixel of a frame; of a frame's depth; and of a sub-map.
_PIXEL, _DEPTH, _SUBMAP_BYTES = 1.0, 0.45e6, 75e6


@dataclass(frozen=True)
class Forecast:
    """What a reconstruction takes, roughly: half to twice as much."""

    frames: int  # of use, at most
    seconds: float  # of one CPU core
    size: float  # of the results, bytes

    def __str__(self) -> str:
        return (
            f"{self.frames} frames of use: about {duration(self.seconds)} of a CPU core and {file_size(self.size)} of "
            "disk, by a patient's clip"
        )


def forecast(source: FrameSource, settings: ReconstructionSettings) -> Forecast:
    """The forecast of a video by the number and size of its frames."""
    frames, steps = -(-source.expected // settings.frames.every), settings.steps
    height, width = next(iter(source))[1].shape[:2]
    pixels = int(height * width)
    posed, submaps = _POSED * frames, max(1.0, frames / _SUBMAP_FRAMES)
    share = min(pixels, _MOST_PIXELS) / _TRAINED_PIXELS
    seconds = _POSES * frames + share * posed * (_FRAME + _STEP * _STEPS * steps / 2000) + _SUBMAP * submaps
    return Forecast(frames, seconds, frames * (_PIXEL * pixels + _DEPTH) + submaps * _SUBMAP_BYTES)
