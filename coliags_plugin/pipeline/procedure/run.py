"""Reconstructs a long video: survey, segments as jobs of worker processes, joins."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import write_mask
from coliags_plugin.execution.executors import ExecutionOptions, Executor
from coliags_plugin.execution.queue import Job, make_executor
from coliags_plugin.geometry.poses.colmap import model_suffix, read_cameras, read_images
from coliags_plugin.pipeline.chain import identity_of
from coliags_plugin.pipeline.context import StageContext
from coliags_plugin.pipeline.frame_selection import reduced
from coliags_plugin.pipeline.frame_sources import FrameSource, chosen_frames, frame_source
from coliags_plugin.pipeline.frames import MASK
from coliags_plugin.pipeline.jobs import PartJobs, run_jobs
from coliags_plugin.pipeline.procedure.joins import PosedFrames, apart, joins, read_posed
from coliags_plugin.pipeline.procedure.page import write_procedure_page
from coliags_plugin.pipeline.procedure.record import Procedure, SegmentJoin
from coliags_plugin.pipeline.procedure.segments import SURVEY_FILE, Survey, checksum, cut, survey_video
from coliags_plugin.pipeline.stages import PAGE_FILE, Record
from coliags_plugin.reconstruction.structure.sfm_settings import CameraSettings, has_known_camera

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FinishedProcedure:
    """What a procedure came to."""

    folder: Path
    procedure: Procedure
    segments: dict[str, Record]  # by name


def reconstruct_procedure(
    context: StageContext, execution: ExecutionOptions, overwrite: bool = False
) -> FinishedProcedure:
    """Reconstruct a long video, or go on with what was begun. The caller holds the folder's lock.

    Raises:
        InputError: The video cannot be read; the folder was made with other options; or nothing could be posed.
        NotWritableError: The disk is full, or cannot be written; all that is done is kept.
        InterruptedRunError: Ctrl-C; likewise.
    """
    executor = make_executor(execution)
    executor.check(context.out, [path for path in (context.source, context.mask) if path is not None])
    procedure, survey = _prepare(context, overwrite)
    if procedure.segments:
        jobs = _segment_jobs(context, procedure, survey, executor, execution, overwrite)
        run_jobs(executor, execution, jobs, sum(segment.count for segment in procedure.segments))
    names = [segment.name for segment in procedure.segments]
    procedure = procedure.model_copy(update={"joins": _joins(context.out, procedure, names)})
    procedure.write(context.out)
    write_procedure_page(context.out)
    records = {name: Record.of(context.out / name) for name in names}
    if not any(record.is_done("poses") for record in records.values()):
        raise _without_poses(context, procedure, records)
    return FinishedProcedure(context.out, procedure, records)


def _without_poses(context: StageContext, procedure: Procedure, records: Mapping[str, Record]) -> InputError:
    """The error where no frame has a pose; its page is there."""
    stages = [stage for record in records.values() for stage in record.stages.values()]
    why = next((stage.summary for stage in stages if stage.state == "failed"), "no stage was begun")
    seen = f"none of {len(records)} segments of {context.source} has poses: {why}"
    if not records:
        seen = (
            f"no stretch of {context.source} of {context.settings.least_submap} frames in which points can be followed"
        )
    return InputError(
        seen, "a video of a camera that moves along tissue it sees", f"{context.out / PAGE_FILE} shows why"
    )


def _prepare(context: StageContext, overwrite: bool) -> tuple[Procedure, Survey]:
    """Survey the video and cut it, or read what was found before."""
    out, chosen = context.out, context.settings.frames
    least = context.settings.least_submap
    options = {"least": least, **chosen.model_dump(include={"every", "segment", "last", "deinterlace"})}
    known = Procedure.read(out)
    size = identity_of(context.source)["bytes"]
    if known is not None and (out / SURVEY_FILE).is_file():
        same = (known.source, known.bytes, known.first) == ([context.source.name], size, chosen.first)
        if same and known.options == options:
            return known, Survey.read(out)
        if not overwrite and known.segments:
            raise InputError(
                f"{out} was made from {', '.join(known.source)}, {known.bytes} bytes, cut by {known.options}",
                f"{context.source.name}, {size} bytes, cut by {options}",
                "Choose another --output, or pass --overwrite to begin again",
            )
        for segment in known.segments:
            shutil.rmtree(out / segment.name, ignore_errors=True)
    if known is None and out.is_dir() and any(not path.name.startswith(".") for path in out.iterdir()):
        raise InputError(
            f"{out} already exists and is no procedure", "a new or empty folder", "Choose another --output"
        )
    source = chosen_frames(context.source, chosen)
    survey = survey_video(source, context.progress)
    segments, skipped = cut(survey, chosen, least)
    seek = chosen.seek and _are_found(source, survey, [each.first for each in segments])
    height, width = survey.size
    procedure = Procedure(
        source=[context.source.name],
        bytes=size,
        rate=source.rate,
        frames=len(survey),
        size=(width, height),
        first=chosen.first,
        options=options,
        seek=seek,
        deinterlace=source.span.deinterlace,
        segments=segments,
        skipped=skipped,
        joins=(),
    )
    procedure.write(out)
    survey.write(out)  # last: the folder is known for a procedure's from the record on, and surveyed anew without this
    log.info("%d frames in %d segments, %d stretches left out", len(survey), len(segments), len(skipped))
    return procedure, survey


def _are_found(source: FrameSource, survey: Survey, numbers: Sequence[int]) -> bool:
    """Whether frames that are sought by their number are those that came in order."""
    for number in numbers:
        one = frame_source(source.path, replace(source.span, first=number, last=number))
        image = next((image for _, image in one), None)
        if image is None or checksum(reduced(image)) != survey.checksums[number - source.span.first]:
            log.warning("%s: frames are not found by their number, and decoded in order for every segment", source.path)
            return False
    return True


def _segment_jobs(
    context: StageContext,
    procedure: Procedure,
    survey: Survey,
    executor: Executor,
    execution: ExecutionOptions,
    overwrite: bool,
) -> list[Job]:
    """Jobs that reconstruct the segments, first those of one that tells the camera of the others if it is not known.

    That is the segment in which most is followed; if it gets no poses, the next one.
    """
    known, mask = context.settings.sfm.camera, context.mask
    if mask is None and survey.mask is not None:
        mask = context.out / MASK
        write_mask(mask, survey.mask)
    followed = [
        float(survey.followed[each.first - procedure.first : each.last + 1 - procedure.first].sum())
        for each in procedure.segments
    ]
    left = sorted(range(len(followed)), key=lambda number: -followed[number])

    def jobs_of(number: int, camera: CameraSettings, then: Callable[[PartJobs], list[Job]] | None = None) -> list[Job]:
        segment, settings = procedure.segments[number], context.settings
        span = {"first": segment.first, "last": segment.last}
        span |= {"seek": procedure.seek, "deinterlace": procedure.deinterlace}
        frames, sfm = settings.frames.model_copy(update=span), settings.sfm.model_copy(update={"camera": camera})
        own = settings.model_copy(update={"frames": frames, "sfm": sfm})
        inside = replace(context, out=context.out / segment.name, settings=own, mask=mask)
        return PartJobs(inside, executor, execution, overwrite, segment.count, then).jobs()

    def first() -> list[Job]:
        return jobs_of(left.pop(0), known, others) if left else []

    def others(jobs: PartJobs) -> list[Job]:
        camera = _camera_of(jobs.context.posed)
        return first() if camera is None else all_left(camera)

    def all_left(camera: CameraSettings) -> list[Job]:
        numbers = sorted(left)
        left.clear()
        return [job for number in numbers for job in jobs_of(number, camera)]

    return all_left(known) if has_known_camera(known) else first()


def _camera_of(scene: Path) -> CameraSettings | None:
    """The camera of the largest model of a scene; None where there is none."""
    folder = scene / "sparse" / "0"
    suffix = model_suffix(folder, ("images", "cameras"))
    if suffix is None:
        return None
    number = read_images(folder / f"images{suffix}", observations=False)[0].camera
    camera = read_cameras(folder / f"cameras{suffix}")[number]
    return CameraSettings(model=camera.model, params=tuple(map(float, camera.params)), refine=False)


def _joins(out: Path, procedure: Procedure, names: Sequence[str]) -> list[SegmentJoin]:
    """Joins of every two neighbouring segments."""
    found, before = list[SegmentJoin](), _posed(out / names[0]) if names else []
    for (one, other), (first, second) in zip(pairwise(names), pairwise(procedure.segments), strict=True):
        posed = _posed(out / other)
        gap = second.first - first.last - 1
        why = f"{gap} frames between them show nothing that can be followed"
        found += joins((one, other), before, posed) if gap < 0 else [apart((one, other), why)]
        before = posed
    return found


def _posed(segment: Path) -> list[PosedFrames]:
    return read_posed(segment / "poses") if (segment / "poses").is_dir() else []
