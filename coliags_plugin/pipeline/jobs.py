"""Parts of a reconstruction as jobs: of each segment what all its sub-maps need, then each sub-map by itself.

    python -m coliags_plugin.pipeline.jobs TASK

is a worker process for one; TASK is a :class:`PartTask` as JSON.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

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
from coliags_plugin.engine.tasks import Ending, ExecutionOptions, Executor, Task, TaskOutcome, attempt, run_worker
from coliags_plugin.geometry.poses.colmap import model_suffix, read_cameras, read_images
from coliags_plugin.pipeline.context import StageContext
from coliags_plugin.pipeline.settings import ReconstructionSettings
from coliags_plugin.pipeline.stages import (
    LOCK_SECONDS,
    Part,
    Record,
    Stage,
    StageRecord,
    check_options,
    run_stages,
    worker_lock,
)
from coliags_plugin.pipeline.steps import stages_of
from coliags_plugin.reconstruction.structure.sfm_settings import CameraSettings, has_known_camera
from coliags_plugin.reporting.numbers import duration

log = logging.getLogger(__name__)

#: Folder of the workers' messages.
LOGS = "logs"
#: Share of the work that comes before the sub-maps.
_PLAN_SHARE = 0.2


@dataclass(frozen=True)
class Workers:
    """Processes that do jobs, and how."""

    executor: Executor
    options: ExecutionOptions


class Reconstruction:
    """Jobs of segments, first those of one that tells the camera of the others if it is not known.

    Args:
        record: Of the reconstruction.
        segments: Contexts and sizes; if the first gets no poses, the next one is tried.
        overwrite: Whether stages that were made with other options are removed.
        workers: Processes that do the jobs; None: this one.
    """

    def __init__(
        self, record: Record, segments: Sequence[tuple[StageContext, int]], overwrite: bool, workers: Workers | None
    ) -> None:
        self.record, self.workers, self._overwrite = record, workers, overwrite
        self.failures: dict[tuple[str, Part], ReportedError] = {}
        self._left = list(segments)  # not begun

    def run(self) -> None:
        """Do all jobs.

        Raises:
            InputError: A stage was made with other options, and may not be removed.
            InterruptedRunError: Ctrl-C; what is done is kept.
            NotWritableError: The disk is full, or cannot be written; likewise.
        """
        total, waiting = sum(size for _, size in self._left), self._next()
        if self.workers is None:
            while waiting:
                waiting[:0] = waiting.pop(0).run_here()
            return
        queue = JobQueue(self.workers.executor, self.workers.options.retries, waiting, total)
        try:
            queue.run("reconstruct", lambda running: ", ".join(job.doing for job in running))
        except KeyboardInterrupt as error:
            raise InterruptedRunError("stopped; the same command goes on where it stopped") from error

    def _next(self, before: StageContext | None = None) -> list[PartJob]:
        """Jobs of all segments that are left, by the camera that is known or ``before`` has found, or else of one."""
        if not self._left:
            return []
        camera = self._left[0][0].settings.sfm.camera
        if before is not None and not has_known_camera(camera):
            camera = _camera_of(before.posed) or camera
        count = len(self._left) if has_known_camera(camera) else 1
        chosen, self._left = self._left[:count], self._left[count:]
        found = list[PartJob]()
        for context, size in sorted(chosen, key=lambda one: one[0].segment):
            sfm = context.settings.sfm.model_copy(update={"camera": camera})
            found += self._begin(replace(context, settings=context.settings.model_copy(update={"sfm": sfm})), size)
        return found

    def _begin(self, context: StageContext, size: int) -> list[PartJob]:
        """Jobs of a segment: the stages that all its sub-maps need, or where these are done each sub-map."""
        stages = stages_of(context)
        check_options(stages, self.record, self._overwrite)
        waiting = list(dict.fromkeys(stage.part for stage in stages if not self.record.is_done(stage.name)))
        if None in waiting:
            waiting = [None]
        frames = {inside.submap.number: inside.submap.frames or 1 for inside in context.submaps()}
        shares = {part: _PLAN_SHARE if part is None else frames[part] / sum(frames.values()) for part in waiting}
        own = [PartJob(self, context, part, stages, round(shares[part] * size)) for part in waiting]
        return own if None in waiting else [*own, *self._next(context)]

    def end(self, job: PartJob, error: ReportedError | None = None) -> list[PartJob]:
        """Take that a job has ended, or why it failed; returns what is to be done after it."""
        context = job.context
        if error is not None:
            self.failures[context.segment, job.part] = error
        elif job.part is None:
            return self._begin(context, round(job.size / _PLAN_SHARE) - job.size)
        return self._next(context) if job.part is None else []


def _camera_of(scene: Path) -> CameraSettings | None:
    """The camera of the largest model of a scene; None where there is none."""
    folder = scene / "sparse" / "0"
    suffix = model_suffix(folder, ("images", "cameras"))
    if suffix is None:
        return None
    number = read_images(folder / f"images{suffix}")[0].camera
    camera = read_cameras(folder / f"cameras{suffix}")[number]
    return CameraSettings(model=camera.model, params=tuple(map(float, camera.params)), refine=False)


class PartJob(Job):
    """One part of a segment."""

    def __init__(
        self, work: Reconstruction, context: StageContext, part: Part, stages: Sequence[Stage], size: int
    ) -> None:
        self._work, self.context, self.part, self.stages, self.size = work, context, part, stages, size
        out, workers = context.out.resolve(), work.workers
        self.task = PartTask(
            title=f"{out.name}, {'poses' if part is None else f'sub-map {part}'}",
            key=f"{out} {worker_name(context, part)}",
            device=str(context.device) if workers is None else workers.options.device,
            log=str(out / LOGS / f"{_part_name(part)}.log"),
            threads=1 if workers is None else workers.executor.threads,
            source=str(context.source.resolve()),
            out=str(out),
            segment=context.segment,
            settings=context.settings.model_dump_json(),
            mask=None if context.mask is None else str(context.mask.resolve()),
            data_format=context.data_format,
            part=part,
        )

    def run_here(self) -> list[PartJob]:
        """Do it in this process; returns what is to be done after it.

        Raises:
            NotWritableError: The disk is full, or cannot be written.
        """
        try:
            run_stages(self.stages, self._work.record, self.part)
        except NotWritableError:
            raise
        except (InputError, NotFiniteError, NothingDrawnError) as error:
            if any(stage.part not in (None, self.part) for stage in self.stages):
                log.warning("%s; the others go on", str(error).rstrip("."))
            return self._work.end(self, error)
        return self._work.end(self)

    def progress(self) -> int:
        """Share of the stages that are done; the rest is over when the process has ended."""
        states = self._states()
        return self.size * sum(stage.state == "done" for stage in states.values()) // (len(states) + 1)

    @property
    def doing(self) -> str:
        """Title of the part, with the stage that its worker is at."""
        begun = [name for name, stage in self._states().items() if stage.state == "begun"]
        return " ".join([self.task.title, *(name.rpartition("/")[2] for name in begun)])

    def _states(self) -> dict[str, StageRecord]:
        """Its stages, as far as they are recorded; else failed ones without a word."""
        record = self._work.record
        record.refresh()
        names = [stage.name for stage in self.stages if stage.part == self.part]
        return {name: record.stages.get(name, StageRecord({}, "failed")) for name in names}

    def finish(self) -> Sequence[Job]:
        """Take up what the worker has written, and return the jobs after it."""
        return self._end()

    def fail(self, reason: str, attempts: int, ending: Ending) -> Sequence[Job]:
        """Record the failure, and return the jobs after it; a disk that cannot be written ends all of them."""
        if ending == "unwritable":
            raise NotWritableError(f"{self.task.title}: {reason}", do="What is done is kept")
        return self._end(InputError(reason or "it failed"))

    def _end(self, error: InputError | None = None) -> Sequence[Job]:
        """Tell what the worker has written; a stage at which its process died has failed."""
        for name, stage in self._states().items() if error is not None else ():
            if stage.state == "begun":
                self._work.record.put(name, replace(stage, state="failed", summary=str(error)))
        for name, stage in self._states().items():
            if stage.summary:
                what = stage.state if stage.state != "done" else f"took {duration(stage.seconds)}"
                log.info("%s: %s; %s", name, stage.summary, what)
        return self._work.end(self, error)


def worker_name(context: StageContext, part: Part) -> str:
    """The worker of a part, for keys and files."""
    return "-".join(filter(None, (context.segment, _part_name(part))))


def _part_name(part: Part) -> str:
    return "plan" if part is None else str(part)


@dataclass(frozen=True, kw_only=True)
class PartTask(Task):
    """The stages of one part of a segment."""

    worker: ClassVar[str] = "coliags_plugin.pipeline.jobs"
    source: str
    out: str
    segment: str
    settings: str  # JSON
    mask: str | None
    data_format: str | None
    part: Part


def work(task: PartTask) -> TaskOutcome:
    """Run the stages that are not done."""
    return attempt(task.title, task.out, lambda: complete(task))


def complete(task: PartTask) -> None:
    """Run the stages that are not done.

    Raises:
        InputError: One cannot be done; what it says is in the record, too.
    """
    import torch

    from coliags_plugin.engine.devices import choose_device

    torch.set_num_threads(task.threads)
    settings = ReconstructionSettings.model_validate_json(task.settings, strict=False)  # of lists
    mask = None if task.mask is None else Path(task.mask)
    device = choose_device(task.device)
    context = StageContext(
        Path(task.out), Path(task.source), settings, mask, task.data_format, device, segment=task.segment
    )
    name = worker_name(context, task.part)
    with locked(worker_lock(context.root, name), context.root, LOCK_SECONDS):
        record = Record.of(context.root)
        record.places = context.places
        run_stages(stages_of(context), record, task.part)


if __name__ == "__main__":
    run_worker(lambda text: work(PartTask.from_json(text)))
