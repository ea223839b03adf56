"""Parts of a reconstruction as jobs for worker processes: what all sub-maps need, then each sub-map by itself.

    python -m coliags_plugin.pipeline.jobs TASK

is such a process; TASK is a :class:`PartTask` as JSON.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

from coliags_plugin.core.errors import InterruptedRunError, NotWritableError
from coliags_plugin.core.locks import locked
from coliags_plugin.execution.executors import ExecutionOptions, Executor
from coliags_plugin.execution.queue import Job, JobQueue
from coliags_plugin.execution.tasks import Ending, Task, TaskOutcome, attempt, run_worker
from coliags_plugin.pipeline.chain import stages_of
from coliags_plugin.pipeline.context import StageContext
from coliags_plugin.pipeline.page import write_index
from coliags_plugin.pipeline.settings import ReconstructionSettings
from coliags_plugin.pipeline.stages import (
    LOCK_FILE,
    LOCK_SECONDS,
    Part,
    Record,
    Stage,
    check_options,
    part_name,
    run_stages,
)
from coliags_plugin.reporting.numbers import duration

log = logging.getLogger(__name__)

#: Folder of the workers' messages.
LOGS = "logs"
#: Share of the work that comes before the sub-maps.
_PLAN_SHARE = 0.2


def run_jobs(executor: Executor, options: ExecutionOptions, jobs: Sequence[Job], total: int) -> None:
    """Do jobs, whose sizes are shares of ``total``, and tell which run.

    Raises:
        InterruptedRunError: Ctrl-C; what is done is kept.
        NotWritableError: The disk is full, or cannot be written; likewise.
    """
    queue = JobQueue(executor, options.retries, jobs, total)
    try:
        queue.run("reconstruct", lambda running: ", ".join(job.doing for job in running))
    except KeyboardInterrupt as error:
        raise InterruptedRunError("stopped; the same command goes on where it stopped") from error


class PartJobs:
    """A reconstruction whose parts are jobs; its page is written when the last has ended.

    Args:
        context: Of the reconstruction.
        executor: Where the jobs run.
        options: How.
        overwrite: Whether stages that were made with other options are removed.
        size: Of all jobs together, in the queue's unit.
        then: Gives other jobs that are to be done once the stages that all sub-maps need have ended.

    Raises:
        InputError: A stage was made with other options, and ``overwrite`` is not given; or a worker of an earlier call
            does not end.
    """

    def __init__(
        self,
        context: StageContext,
        executor: Executor,
        options: ExecutionOptions,
        overwrite: bool,
        size: int,
        then: Callable[[PartJobs], list[Job]] | None = None,
    ) -> None:
        self.context, self.executor, self.options, self._overwrite = context, executor, options, overwrite
        self.record = Record.of(context.out)
        self.record.places = context.places
        self.record.write()
        self.record.take_over_all()
        self.failures: dict[Part, str] = {}
        self._left, self._size, self._then = set[Part](), size, then
        check_options(stages_of(context), self.record, overwrite)

    def jobs(self) -> list[Job]:
        """What is to be done now: the stages that all need, or where these are done each sub-map.

        Their sizes are what is left of that of all jobs.
        """
        parts: dict[Part, list[Stage]] = {}
        for stage in stages_of(self.context):
            parts.setdefault(stage.part, []).append(stage)
        waiting = [
            part for part, stages in parts.items() if not all(self.record.is_done(stage.name) for stage in stages)
        ]
        if None in waiting:
            waiting = [None]
        self._left = set(waiting)
        others = [] if None in waiting else self._others()
        if not waiting:
            self.write_page()
            return others
        frames = {context.submap.number: context.submap.frames or 1 for context in self.context.submaps()}
        shares = {part: 1.0 if part is None else frames[part] / sum(frames.values()) for part in waiting}
        whole = self._size * (_PLAN_SHARE if None in waiting else 1.0)
        own = [PartJob(self, part, parts[part], round(shares[part] * whole)) for part in waiting]
        return [*own, *others]

    def _others(self) -> list[Job]:
        """Those that are to be done after the stages that all need, once."""
        then, self._then = self._then, None
        return [] if then is None else then(self)

    def end(self, job: PartJob, reason: str = "") -> list[Job]:
        """Take what the worker of a part has written, or why it failed; returns what is to be done after it."""
        self.record.take_over(part_name(job.part))
        for stage in job.stages:
            if (record := self.record.stages.get(stage.name)) is not None:
                if reason and record.state == "begun":  # its process died
                    record = replace(record, state="failed", summary=reason)
                    self.record.put(stage.name, record)
                what = record.state if record.state != "done" else f"took {duration(record.seconds)}"
                log.info("%s: %s; %s", stage.name, record.summary, what)
        self._left.discard(job.part)
        self._size -= job.size
        if reason:
            self.failures[job.part] = reason
        elif job.part is None:
            check_options(stages_of(self.context), self.record, self._overwrite)
            return self.jobs()
        if not self._left:
            self.write_page()
        return self._others() if job.part is None else []

    def write_page(self) -> None:
        """Write the page of the reconstruction, and the record in the order of its stages."""
        context, record = self.context, self.record
        places = {stage.name: place for place, stage in enumerate(stages_of(context))}
        record.stages = dict(sorted(record.stages.items(), key=lambda item: places.get(item[0], len(places))))
        record.write()
        write_index(record, context.posed, f"Reconstruction of {context.source.resolve().name}")


class PartJob(Job):
    """One part of a reconstruction."""

    def __init__(self, jobs: PartJobs, part: Part, stages: Sequence[Stage], size: int) -> None:
        self._jobs, self.part, self.stages, self.size = jobs, part, stages, size
        context, out = jobs.context, jobs.context.out.resolve()
        self.task = PartTask(
            title=f"{out.name}, {'poses' if part is None else f'sub-map {part}'}",
            key=f"{out} {part_name(part)}",
            device=jobs.options.device,
            log=str(out / LOGS / f"{part_name(part)}.log"),
            threads=jobs.executor.threads,
            source=str(context.source.resolve()),
            out=str(out),
            settings=context.settings.model_dump_json(),
            mask=None if context.mask is None else str(context.mask.resolve()),
            data_format=context.data_format,
            part=part,
        )

    def progress(self) -> int:
        """Share of the stages that are done; the rest is over when the process has ended."""
        record = Record.of(self._jobs.context.out)
        done = sum(record.is_done(stage.name) for stage in self.stages)
        return self.size * done // (len(self.stages) + 1)

    @property
    def doing(self) -> str:
        """See :class:`Job`: with the stage that its worker is at."""
        stages = Record.of(self._jobs.context.out).stages
        begun = [stage.name for stage in self.stages if stage.name in stages and stages[stage.name].state == "begun"]
        return " ".join([self.task.title, *(name.rpartition("/")[2] for name in begun)])

    def finish(self) -> Sequence[Job]:
        """See :class:`Job`."""
        return self._jobs.end(self)

    def fail(self, reason: str, attempts: int, ending: Ending) -> Sequence[Job]:
        """See :class:`Job`; a disk that cannot be written is that of the other parts, too."""
        if ending == "unwritable":
            raise NotWritableError(f"{self.task.title}: {reason}", do="What is done is kept")
        return self._jobs.end(self, reason or "it failed")


@dataclass(frozen=True, kw_only=True)
class PartTask(Task):
    """The stages of one part of a reconstruction."""

    worker: ClassVar[str] = "coliags_plugin.pipeline.jobs"
    source: str
    out: str
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
    mask, out = None if task.mask is None else Path(task.mask), Path(task.out)
    device = choose_device(task.device)
    context = StageContext(out, Path(task.source), settings, mask, task.data_format, device)
    name = part_name(task.part)
    with locked(out / f"{LOCK_FILE}-{name}", out, LOCK_SECONDS):
        record = Record.of(out, name)
        record.places = context.places
        failure = run_stages(stages_of(context), record, plan=lambda: stages_of(context), parts={task.part})
        if failure is not None:
            raise failure


if __name__ == "__main__":
    run_worker(lambda text: work(PartTask.from_json(text)))
