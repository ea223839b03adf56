"""Reconstruction of a video, a folder of images or a posed scene, in stages that a repeated call goes on with.

A long video is cut into segments, which are reconstructed each by itself and joined.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import torch

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import refuse_overlap
from coliags_plugin.core.jobs import Progress, locked
from coliags_plugin.engine.data_formats import find_format, recognised
from coliags_plugin.engine.task_queue import make_executor
from coliags_plugin.engine.tasks import ExecutionOptions
from coliags_plugin.pipeline.contents import figures_as
from coliags_plugin.pipeline.frame_sources import FrameSource, Span, frame_source, opened_recording
from coliags_plugin.pipeline.jobs import StageJobs, Workers
from coliags_plugin.pipeline.joins import find_joins
from coliags_plugin.pipeline.page import write_page
from coliags_plugin.pipeline.settings import FrameSettings, ReconstructionSettings
from coliags_plugin.pipeline.stages import (
    LOCK_FILE,
    PAGE_FILE,
    Record,
    StageRecord,
    check_options,
    run_stages,
    wait_for_workers,
)
from coliags_plugin.pipeline.steps import StageContext, stages_of, survey_stage
from coliags_plugin.pipeline.survey import SURVEY_FILE, Survey, Video
from coliags_plugin.reconstruction.structure.sfm_settings import SfmSettings
from coliags_plugin.reporting.numbers import counted, duration, file_size

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
) -> Record:
    """Reconstruct a video, or go on with what was begun; arguments as in :func:`coliags_plugin.reconstruct`.

    Raises:
        InputError: The source cannot be read; a stage cannot be done; ``out`` is something else, or was made with
            other settings; or another process works on it.
        NotWritableError: The disk is full, or cannot be written; all that is done is kept.
        InterruptedRunError: Ctrl-C, after the state was saved.
    """
    refuse_overlap(out, source)
    if mask is not None and not mask.is_file():
        problem = f"{mask} is a folder" if mask.is_dir() else f"no file {mask}"
        raise InputError(problem, "an image, black where pixels are ignored", "Check `mask`")
    data_format = find_format(source) if source.is_dir() and recognised(source) else None
    if data_format is None:
        source, sfm = opened_recording(source, settings.sfm)
        settings = settings.model_copy(update={"sfm": sfm})
        video = frame_source(source, Span(settings.frames.first, settings.frames.last))
        frames, seconds, size = forecast(video, settings)
        needs = f"about {duration(seconds)} of a CPU core and {file_size(size)} of disk"
        log.info("%d frames of use: %s, by a patient's clip", frames, needs)
    else:
        _refuse_unused(source, settings, mask)
    context = StageContext(out, source, settings, mask, data_format, device, progress)
    for part in (context, *context.submaps()):
        stages_of(part)  # finds out wrong settings before anything is written
    Record.of(out)  # refuses another folder
    workers = None if execution is None else _workers(execution)
    if workers is not None:
        workers.executor.check(out, context.places)
    with locked(out / LOCK_FILE, out):
        wait_for_workers(out)
        record = Record.of(out, context.places)
        record.write()  # so that the folder is known for one from now on, whatever happens in the first stage
        segments = [(context, _UNITS)] if data_format is not None else _segments(context, record, overwrite)
        if len(segments) > 1 and workers is None:
            workers = _workers(ExecutionOptions(jobs=1, device=str(device)))
        jobs = StageJobs(record, segments, overwrite, workers)
        jobs.run()
        if len(segments) != 1:
            _join(out, record)
        write_page(out, record, source)
    if not segments:
        raise InputError(
            f"no stretch of {source} of {settings.least_submap} frames in which points can be followed",
            "a video of a camera that moves along tissue it sees",
            f"{out / PAGE_FILE} shows why",
        )
    if not any(record.is_done(f"{segment.prefix}report") for segment, _ in segments):
        failure = next(error for context, error in jobs.failures if context.folder == context.out)
        if len(segments) == 1:
            raise failure
        problem = f"none of {len(segments)} segments of {source} could be reconstructed: {str(failure).rstrip('.')}"
        raise InputError(problem, do=f"{out / PAGE_FILE} shows why")
    return record


def _workers(execution: ExecutionOptions) -> Workers:
    return Workers(make_executor(execution), execution)


def _segments(context: StageContext, record: Record, overwrite: bool) -> list[tuple[StageContext, int]]:
    """Survey the video and cut it, or read what was found before; where nothing was found, options may change.

    Returns contexts of the segments and their frames, first the one in which most is followed.
    """
    out, settings, stages = context.root, context.settings, [survey_stage(context)]
    if not (out / SURVEY_FILE).is_file() or not record.stages.keys() - {"survey", "joins"}:
        record.forget(["survey"])
    check_options(stages, record, overwrite, list(record.stages))
    run_stages(stages, record)
    video, survey = figures_as(record.stages, "survey", Video, out), Survey.read(out)
    segments = []
    for segment in sorted(video.segments, key=lambda span: -survey.part(span.first, span.last).followed.sum()):
        span = {"first": segment.first, "last": segment.last, "deinterlace": video.deinterlace}
        of_segment = settings.model_copy(update={"frames": settings.frames.model_copy(update=span)})
        segments.append((replace(context, segment=segment.name, settings=of_segment), segment.count))
    return segments


def _join(out: Path, record: Record) -> None:
    """Record how the segments are joined."""
    joins = find_joins(out, figures_as(record.stages, "survey", Video, out).segments)
    summary = f"{sum(join.joined for join in joins)} of {counted(len(joins), 'join')}"
    record.put("joins", StageRecord(summary, figures={"joins": [join.model_dump(mode="json") for join in joins]}))


def _refuse_unused(source: Path, settings: ReconstructionSettings, mask: Path | None) -> None:
    """Refuse settings of stages that a scene with poses does not need."""
    unused = {
        "mask": mask is not None,
        "diameter": settings.diameter is not None,
        "frames": settings.frames != FrameSettings(),
        "sfm": settings.sfm != SfmSettings(),
    }
    if names := ", ".join(name for name, is_given in unused.items() if is_given):
        raise InputError(
            f"{source} has poses, and settings of {names} are given",
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


def forecast(source: FrameSource, settings: ReconstructionSettings) -> tuple[int, float, float]:
    """Frames of use, seconds of one CPU core and bytes that a video takes at most, right within a factor of two."""
    frames, steps = -(-source.expected // settings.frames.every), settings.steps
    height, width = next(iter(source))[1].shape[:2]
    pixels = int(height * width)
    posed, submaps = _POSED * frames, max(1.0, frames / _SUBMAP_FRAMES)
    share = min(pixels, _MOST_PIXELS) / _TRAINED_PIXELS
    seconds = _POSES * frames + share * posed * (_FRAME + _STEP * _STEPS * steps / 2000) + _SUBMAP * submaps
    return frames, seconds, frames * (_PIXEL * pixels + _DEPTH) + submaps * _SUBMAP_BYTES
