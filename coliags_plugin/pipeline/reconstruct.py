"""Reconstruction of a video, a folder of images or a posed scene, in stages that a repeated call goes on with.

A long video is cut into segments, which are reconstructed each by itself and joined. Jobs are the stages that all
sub-maps of a segment need, and then those of each sub-map.

    python -m coliags_plugin.pipeline.reconstruct TASK

is a worker process for one job; TASK is a :class:`StageTask` as JSON.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from coliags_plugin.core.errors import (
    InputError,
    InterruptedRunError,
    NotFiniteError,
    NothingDrawnError,
    NotWritableError,
    ReportedError,
)
from coliags_plugin.core.files import refuse_overlap
from coliags_plugin.core.jobs import Progress, locked
from coliags_plugin.engine.data_formats import find_format, recognised
from coliags_plugin.engine.devices import choose_device
from coliags_plugin.engine.task_queue import Job, JobQueue, make_executor
from coliags_plugin.engine.tasks import Ending, ExecutionOptions, Executor, Task, run_worker
from coliags_plugin.geometry.poses.colmap import model_suffix, read_cameras, read_images
from coliags_plugin.pipeline.contents import figures_as
from coliags_plugin.pipeline.frame_sources import FrameSource, Span, frame_source, opened_recording
from coliags_plugin.pipeline.joins import find_joins
from coliags_plugin.pipeline.page import write_page
from coliags_plugin.pipeline.settings import FrameSettings, ReconstructionSettings
from coliags_plugin.pipeline.stages import (
    LOCK_FILE,
    LOCK_SECONDS,
    PAGE_FILE,
    Record,
    StageRecord,
    check_options,
    run_stages,
    wait_for_workers,
    worker_lock,
)
from coliags_plugin.pipeline.steps import StageContext, stages_of, survey_stage
from coliags_plugin.pipeline.survey import SURVEY_FILE, Survey, Video
from coliags_plugin.reconstruction.structure.sfm_settings import CameraSettings, SfmSettings, has_known_camera
from coliags_plugin.reporting.numbers import counted, duration, file_size

log = logging.getLogger(__name__)

#: Folder of the workers' messages.
LOGS = "logs"
#: In which the progress of jobs is told: thousandths of a video; and the share of the work before the sub-maps.
_UNITS, _SHARED_WORK = 1000, 0.2


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
    options = execution or ExecutionOptions(jobs=1, device=str(device))
    executor = None if execution is None else make_executor(options)
    if executor is not None:
        executor.check(out, context.places)
    with locked(out / LOCK_FILE, out):
        wait_for_workers(out)
        record = Record.of(out, context.places)
        record.write()  # so that the folder is known for one from now on, whatever happens in the first stage
        segments = [(context, _UNITS)] if data_format is not None else _segments(context, record, overwrite)
        if len(segments) > 1:
            executor = executor or make_executor(options)
        jobs = StageJobs(record, segments, overwrite, executor, options)
        jobs.run()
        if len(segments) != 1:
            joins = find_joins(out, figures_as(record.stages, "survey", Video, out).segments)
            summary = f"{sum(join.joined for join in joins)} of {counted(len(joins), 'join')}"
            figures = {"joins": [join.model_dump(mode="json") for join in joins]}
            record.put("joins", StageRecord(summary, figures=figures))
        write_page(out, record)
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


class StageJobs:
    """Jobs of segments, first those of one that tells the camera of the others if it is not known.

    Args:
        record: Record of the reconstruction.
        segments: Contexts and sizes; if the first gets no poses, the next one is tried.
        overwrite: Whether stages that were made with other options are removed.
        executor: Runs the jobs in worker processes; None: they are done in this one.
        options: Options of these processes.
    """

    def __init__(
        self,
        record: Record,
        segments: Sequence[tuple[StageContext, int]],
        overwrite: bool,
        executor: Executor | None,
        options: ExecutionOptions,
    ) -> None:
        self.record, self.executor, self.options, self._overwrite = record, executor, options, overwrite
        self.failures: list[tuple[StageContext, ReportedError]] = []
        self._segments = list(segments)  # that are not begun

    def run(self) -> None:
        """Do all jobs.

        Raises:
            InputError: A stage was made with other options, and may not be removed.
            InterruptedRunError: Ctrl-C; what is done is kept.
            NotWritableError: The disk is full, or cannot be written; likewise.
        """
        total, waiting = sum(size for _, size in self._segments), self._begin_segments()
        if self.executor is None:
            while waiting:
                waiting[:0] = waiting.pop(0).run_here()
            return
        queue = JobQueue(self.executor, self.options.retries, waiting, total)
        try:
            queue.run("reconstruct", lambda running: ", ".join(job.doing for job in running))
        except KeyboardInterrupt as error:
            raise InterruptedRunError("stopped; the same command goes on where it stopped") from error

    def _begin_segments(self, posed: Path | None = None) -> list[StageJob]:
        """Jobs of all segments that are left, if the camera is known or found from the scene ``posed``; else of one."""
        if not self._segments:
            return []
        camera = self._segments[0][0].settings.sfm.camera
        if posed is not None and not has_known_camera(camera):
            camera = _camera_of(posed) or camera
        count = len(self._segments) if has_known_camera(camera) else 1
        chosen, self._segments = self._segments[:count], self._segments[count:]
        jobs = list[StageJob]()
        for segment, size in sorted(chosen, key=lambda pair: pair[0].segment):
            sfm = segment.settings.sfm.model_copy(update={"camera": camera})
            context = replace(segment, settings=segment.settings.model_copy(update={"sfm": sfm}))
            check_options(stages_of(context), self.record, self._overwrite, self.record.of_submaps(context.prefix))
            shared = StageJob(self, context, round(_SHARED_WORK * size))
            jobs += self.end(shared) if shared.is_done else [shared]
        return jobs

    def _begin_submaps(self, shared: StageJob) -> list[StageJob]:
        """Jobs still to do of the sub-maps of a segment with poses."""
        contexts, size = shared.context.submaps(), shared.size / _SHARED_WORK - shared.size
        frames = [context.submap.frames or 1 for context in contexts if context.submap]
        jobs = list[StageJob]()
        for context, count in zip(contexts, frames, strict=True):
            check_options(stages_of(context), self.record, self._overwrite)
            jobs.append(StageJob(self, context, round(size * count / sum(frames))))
        return [job for job in jobs if not job.is_done]

    def end(self, job: StageJob, error: ReportedError | None = None) -> list[StageJob]:
        """Record the end of a job, or the reason for its failure; returns the jobs that come next.

        After the poses of a segment, that are its sub-maps, and the segments that have waited for its camera.
        """
        if error is not None:
            self.failures.append((job.context, error))
        if job.context.submap is not None:
            return []
        return [*(self._begin_submaps(job) if error is None else ()), *self._begin_segments(job.context.posed)]


def _camera_of(scene: Path) -> CameraSettings | None:
    """The camera of the largest model of a scene; None where there is none."""
    folder = scene / "sparse" / "0"
    suffix = model_suffix(folder, ("images", "cameras"))
    if suffix is None:
        return None
    number = read_images(folder / f"images{suffix}")[0].camera
    camera = read_cameras(folder / f"cameras{suffix}")[number]
    return CameraSettings(model=camera.model, params=tuple(map(float, camera.params)), refine=False)


class StageJob(Job):
    """The stages of one context."""

    def __init__(self, jobs: StageJobs, context: StageContext, size: int) -> None:
        self._jobs, self.context, self.size = jobs, context, size
        self.stages = stages_of(context)
        out, executor = context.root.resolve(), jobs.executor
        submap = None if context.submap is None else context.submap.number
        name = worker_name(context)
        self.task = StageTask(
            title=f"{context.out.resolve().name}, {'poses' if submap is None else f'sub-map {submap}'}",
            key=f"{out} {name}",
            device=jobs.options.device,
            folder=out,
            log=out / LOGS / f"{name}.log",
            threads=1 if executor is None else executor.threads,
            source=context.source.resolve(),
            segment=context.segment,
            submap=submap,
            settings=context.settings.model_dump_json(),
            mask=None if context.mask is None else context.mask.resolve(),
            data_format=context.data_format,
        )

    @property
    def is_done(self) -> bool:
        """True if all stages are done."""
        return all(self._jobs.record.is_done(stage.name) for stage in self.stages)

    def run_here(self) -> list[StageJob]:
        """Run a job in this process; returns the jobs that come next.

        Raises:
            NotWritableError: The disk is full, or cannot be written.
        """
        try:
            run_stages(self.stages, self._jobs.record)
        except NotWritableError:
            raise
        except (InputError, NotFiniteError, NothingDrawnError) as error:
            if len(self.context.submaps()) > 1:
                log.warning("%s; the others go on", str(error).rstrip("."))
            return self._jobs.end(self, error)
        return self._jobs.end(self)

    def progress(self) -> int:
        """Share of the stages that are done; the rest is over when the process has ended."""
        states = self._states()
        return self.size * sum(stage.state == "done" for stage in states.values()) // (len(states) + 1)

    @property
    def doing(self) -> str:
        """Title of the job, with the stage that its worker is at."""
        begun = [name for name, stage in self._states().items() if stage.state == "begun"]
        return " ".join([self.task.title, *(name.rpartition("/")[2] for name in begun)])

    def _states(self) -> dict[str, StageRecord]:
        """Records of its stages; of those that are not begun, failed ones without a word."""
        record = self._jobs.record
        record.refresh()
        return {stage.name: record.stages.get(stage.name, StageRecord(state="failed")) for stage in self.stages}

    def fail(self, reason: str, attempts: int, ending: Ending) -> Sequence[Job]:
        """Record the failure, and return the jobs after it; a disk that cannot be written ends all of them."""
        if ending == "unwritable":
            raise NotWritableError(f"{self.task.title}: {reason}", do="What is done is kept")
        return self.finish(InputError(reason or "it failed"))

    def finish(self, error: InputError | None = None) -> Sequence[Job]:
        """Log what the worker has written, and return the jobs after it; a stage at which it died has failed."""
        for name, stage in self._states().items() if error is not None else ():
            if stage.state == "begun":
                self._jobs.record.put(name, replace(stage, state="failed", summary=str(error)))
        for name, stage in self._states().items():
            if stage.summary:
                end = stage.state if stage.state != "done" else f"took {duration(stage.seconds)}"
                log.info("%s: %s; %s", name, stage.summary, end)
        return self._jobs.end(self, error)


def worker_name(context: StageContext) -> str:
    """The worker of a context, for keys and files."""
    return "-".join(filter(None, (context.segment, "plan" if context.submap is None else str(context.submap.number))))


@dataclass(frozen=True, kw_only=True)
class StageTask(Task):
    """The stages of one context, for a worker process; its folder is the root of the reconstruction."""

    source: Path
    segment: str
    submap: int | None  # number; None: the stages that all need
    settings: str  # JSON
    mask: Path | None
    data_format: str | None

    def complete(self) -> None:
        """Run the stages that are not done.

        Raises:
            InputError: One cannot be done; the message is in the record, too.
        """
        torch.set_num_threads(self.threads)
        settings = ReconstructionSettings.model_validate_json(self.settings, strict=False)  # of lists
        device = choose_device(self.device)
        context = StageContext(
            self.folder, self.source, settings, self.mask, self.data_format, device, segment=self.segment
        )
        if self.submap is not None:
            context = next(
                inside for inside in context.submaps() if inside.submap and inside.submap.number == self.submap
            )
        with locked(worker_lock(context.root, worker_name(context)), context.root, LOCK_SECONDS):
            run_stages(stages_of(context), Record.of(context.root, context.places))


if __name__ == "__main__":
    run_worker(StageTask)
