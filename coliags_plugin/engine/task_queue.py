"""A queue of jobs, each a task of a worker process: choice of the executor, retries, failures, and a clean stop."""

from __future__ import annotations

import logging
import os
import signal
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from coliags_plugin.core.errors import InputError, check_name, check_number
from coliags_plugin.engine.devices import find_device
from coliags_plugin.engine.progress import ProgressReport, log_console
from coliags_plugin.engine.ray_executor import RayExecutor
from coliags_plugin.engine.tasks import Ending, ExecutionOptions, Executor, LocalExecutor, Task, TaskOutcome

log = logging.getLogger(__name__)

#: Time between two reports of progress, seconds.
POLL_INTERVAL_S = 1.0
#: Time between lines of progress besides those of the jobs, where there is neither a terminal nor a notebook, seconds.
_PLAIN_LINE_EVERY_S = 60.0


def make_executor(options: ExecutionOptions) -> Executor:
    """The executor that options name."""
    check_number("jobs", options.jobs)
    check_number("threads", options.threads)
    check_number("retries", options.retries, least=0)
    check_name("executor", options.executor, ("local", "ray"))
    if options.executor == "ray":
        return RayExecutor(options.ray_address, options.jobs, options.threads or 1, options.device)
    cpus, gpus = available_cpus(), _gpus(options.device)
    jobs = options.jobs or len(gpus) or cpus
    return LocalExecutor(jobs, options.threads or max(1, cpus // jobs), gpus)


def available_cpus() -> int:
    """CPUs that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _gpus(device: str) -> list[str]:
    """Identifiers of the GPUs to use, as in ``CUDA_VISIBLE_DEVICES``: all, or the one that ``device`` numbers."""
    import torch

    chosen = find_device(device)
    if chosen.type != "cuda":
        return []
    visible = [each for each in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if each]
    gpus = (visible or list(map(str, range(torch.cuda.device_count()))))[: torch.cuda.device_count()]
    return [gpus[chosen.index]] if ":" in device else gpus


class Job(ABC):
    """Work of a queue."""

    task: Task  # whose key no other job of the queue has
    size: int  # its share of the whole, in a unit of its queue

    @abstractmethod
    def progress(self) -> int:
        """Share of its size that is over while it runs."""

    @property
    def doing(self) -> str:
        """Words for it in messages while it runs."""
        return self.task.title

    @abstractmethod
    def finish(self) -> Sequence[Job]:
        """Take what the task has made; returns jobs that are now to be done.

        Raises:
            InputError: It is not what it should be.
        """

    @abstractmethod
    def fail(self, reason: str, attempts: int, ending: Ending) -> Sequence[Job]:
        """Record that it cannot be done; returns jobs that are now to be done, or ends the queue with an error."""


class JobQueue:
    """Jobs that are waiting or running, and how many have ended.

    Args:
        executor: Where tasks run.
        retries: How often a task is tried again whose process died.
        total: Size of all jobs together, those that are done before and those found later included.
        size_done: Size of those done before.
    """

    def __init__(self, executor: Executor, retries: int, jobs: Sequence[Job], total: int, size_done: int = 0) -> None:
        self._executor, self._retries, self._total, self._over = executor, retries, total, size_done
        self._waiting, self._running = deque(jobs), dict[str, Job]()
        self._attempts: Counter[str] = Counter()

    def run(self, title: str, facts: Callable[[Sequence[Job]], str]) -> None:
        """Do all jobs; ``facts`` of those that run stand beside the progress.

        Raises:
            KeyboardInterrupt: Ctrl-C, or the system's request to end; all tasks have saved their state.
        """
        with (
            _sigterm_as_interrupt(),
            ProgressReport(title, self._total, self._over, _PLAIN_LINE_EVERY_S, log_console()) as report,
        ):
            try:
                while self._waiting or self._running:
                    self._start()
                    running = tuple(self._running.values())
                    report.update(self._over + sum(job.progress() for job in running), facts(running))
                    for task, outcome in self._executor.wait(POLL_INTERVAL_S) if running else ():
                        self._take(self._running.pop(task.key), outcome)
                report.update(self._over, facts(()))
            except KeyboardInterrupt:
                log.info("stopping: the state is saved; Ctrl-C again to stop at once")
                raise
            finally:
                self._executor.stop()

    def _start(self) -> None:
        """Start what can be started."""
        while self._waiting and len(self._running) < self._executor.slots:
            job = self._waiting.popleft()
            self._attempts[job.task.key] += 1
            log.info("%s: started", job.task.title)
            try:
                self._executor.start(job.task)
            except OSError as error:
                self._fail(job, f"cannot be started: {error.strerror or error}")
            else:
                self._running[job.task.key] = job

    def _take(self, job: Job, outcome: TaskOutcome) -> None:
        """Take the result of a job whose worker has ended; retry or fail it, or take up what comes after it."""
        attempts = self._attempts[job.task.key]
        if outcome.ending == "done":
            try:
                self._waiting.extendleft(reversed(job.finish()))
                self._over += job.size
            except InputError as error:
                self._fail(job, str(error))
        elif outcome.ending in ("failed", "unwritable"):
            self._fail(job, outcome.reason, outcome.ending)
        elif attempts > self._retries:
            self._fail(job, f"{outcome.reason or outcome.ending}, {attempts} times")
        else:
            log.warning("%s: %s; trying again", job.task.title, outcome.reason or outcome.ending)
            self._waiting.appendleft(job)

    def _fail(self, job: Job, reason: str, ending: Ending = "failed") -> None:
        self._over += job.size
        self._waiting.extendleft(reversed(job.fail(reason, self._attempts[job.task.key], ending)))


@contextmanager
def _sigterm_as_interrupt() -> Iterator[None]:
    """Have the system's request to end (SIGTERM) do as Ctrl-C does."""
    try:
        before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    except ValueError:  # not the main thread
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
