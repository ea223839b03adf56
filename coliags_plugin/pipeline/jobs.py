"""Stages of a reconstruction as jobs: of each segment those that all its sub-maps need, then those of each sub-map.

    python -m coliags_plugin.pipeline.jobs TASK

is a worker process for one; TASK is a :class:`StageTask` as JSON.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from coliags_plugin.core.errors import (
    InputError,
    InterruptedRunError,
    NotFiniteError,
    NothingDrawnError,
    NotWritableError,
    ReportedError,
)
from coliags_plugin.core.jobs import locked
from coliags_plugin.engine.task_queue import Job, JobQueue
from coliags_plugin.engine.tasks import Ending, ExecutionOptions, Executor, Task, run_worker
from coliags_plugin.geometry.poses.colmap import model_suffix, read_cameras, read_images
from coliags_plugin.pipeline.settings import ReconstructionSettings
from coliags_plugin.pipeline.stages import (
    LOCK_SECONDS,
    Record,
    StageRecord,
    check_options,
    run_stages,
    worker_lock,
)
from coliags_plugin.pipeline.steps import StageContext, stages_of
from coliags_plugin.reconstruction.structure.sfm_settings import CameraSettings, has_known_camera
from coliags_plugin.reporting.numbers import duration

log = logging.getLogger(__name__)

#: Folder of the workers' messages.
LOGS = "logs"
#: Share of the work that comes before the sub-maps.
_SHARED_WORK = 0.2


class Workers(NamedTuple):
    """Processes that do jobs, and how."""

    executor: Executor
    options: ExecutionOptions


class StageJobs:
    """Jobs of segments, first those of one that tells the camera of the others if it is not known.

    Args:
        record: Record of the reconstruction.
        segments: Contexts and sizes; if the first gets no poses, the next one is tried.
        overwrite: Whether stages that were made with other options are removed.
        workers: Processes that do the jobs; None: this one.
    """

    def __init__(
        self, record: Record, segments: Sequence[tuple[StageContext, int]], overwrite: bool, workers: Workers | None
    ) -> None:
        self.record, self.workers, self._overwrite = record, workers, overwrite
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
        if self.workers is None:
            while waiting:
                waiting[:0] = waiting.pop(0).run_here()
            return
        queue = JobQueue(self.workers.executor, self.workers.options.retries, waiting, total)
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
            jobs += self._begin_submaps(shared) if shared.is_done else [shared]
        return jobs

    def _begin_submaps(self, shared: StageJob) -> list[StageJob]:
        """Jobs of the sub-maps of a segment that has poses, and of the segments that have waited for them."""
        contexts, size = shared.context.submaps(), shared.size / _SHARED_WORK - shared.size
        frames = [context.submap.frames or 1 for context in contexts if context.submap]
        jobs = list[StageJob]()
        for context, count in zip(contexts, frames, strict=True):
            check_options(stages_of(context), self.record, self._overwrite)
            jobs.append(StageJob(self, context, round(size * count / sum(frames))))
        return [*(job for job in jobs if not job.is_done), *self._begin_segments(shared.context.posed)]

    def end(self, job: StageJob, error: ReportedError | None = None) -> list[StageJob]:
        """Take that a job has ended, or why it failed; returns what is to be done after it."""
        if error is not None:
            self.failures.append((job.context, error))
            return self._begin_segments(job.context.posed) if job.context.submap is None else []
        return self._begin_submaps(job) if job.context.submap is None else []


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
        out, workers = context.root.resolve(), jobs.workers
        submap = None if context.submap is None else context.submap.number
        name = worker_name(context)
        self.task = StageTask(
            title=f"{context.out.resolve().name}, {'poses' if submap is None else f'sub-map {submap}'}",
            key=f"{out} {name}",
            device=str(context.device) if workers is None else workers.options.device,
            folder=out,
            log=out / LOGS / f"{name}.log",
            threads=1 if workers is None else workers.executor.threads,
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
        """Do it in this process; returns what is to be done after it.

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

    def finish(self) -> Sequence[Job]:
        """Take up what the worker has written, and return the jobs after it."""
        return self._end()

    def fail(self, reason: str, attempts: int, ending: Ending) -> Sequence[Job]:
        """Record the failure, and return the jobs after it; a disk that cannot be written ends all of them."""
        if ending == "unwritable":
            raise NotWritableError(f"{self.task.title}: {reason}", do="What is done is kept")
        return self._end(InputError(reason or "it failed"))

    def _end(self, error: InputError | None = None) -> Sequence[Job]:
        """Log what the worker has written; a stage at which its process died has failed."""
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
        import torch

        from coliags_plugin.engine.devices import choose_device

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
