"""Executors: where worker processes run."""

from __future__ import annotations

import os
import subprocess
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from coliags_plugin.execution.tasks import Task, TaskOutcome

#: For workers to save and end once they were asked to, seconds; then they are killed.
STOPPING = 45.0
_PAUSE = 0.1


@dataclass(frozen=True)
class ExecutionOptions:
    """Where and how tasks are run."""

    jobs: int | None = None  # tasks at a time; None: one per CPU, or per GPU
    threads: int | None = None  # CPU threads of each; None: the CPUs divided by the tasks at a time
    device: str = "auto"
    executor: str = "local"
    ray_address: str | None = None  # HOST:PORT of the head; None: RAY_ADDRESS, or the cluster of this machine
    retries: int = 2  # how often a task whose process died is tried again
    save_seconds: float = 60.0  # largest time between two checkpoints of training


class Executor(ABC):
    """Runs tasks, each in a worker process of its own."""

    slots: int  # how many run at once
    threads: int  # CPU threads of each

    def check(self, folder: Path, inputs: Sequence[Path]) -> None:  # noqa: B027
        """Refuse a folder that tasks will not see or cannot write, and inputs that they will not see."""

    @abstractmethod
    def start(self, task: Task) -> None:
        """Start a task.

        Raises:
            OSError: It cannot be started.
        """

    @abstractmethod
    def wait(self, seconds: float) -> list[tuple[Task, TaskOutcome]]:
        """Tasks that have ended, after so many seconds at most."""

    @abstractmethod
    def stop(self) -> None:
        """Have all tasks save their state and end."""


class LocalExecutor(Executor):
    """Processes on this machine, spread over the GPUs with these identifiers, as in ``CUDA_VISIBLE_DEVICES``."""

    def __init__(self, slots: int, threads: int, gpus: Sequence[str] = ()) -> None:
        self.slots, self.threads = slots, threads
        self._gpus = tuple(gpus)
        self._workers: dict[int, LocalWorker] = {}  # by slot

    def start(self, task: Task) -> None:
        """See :class:`Executor`."""
        slot = min(set(range(self.slots)) - self._workers.keys())
        gpu = self._gpus[slot % len(self._gpus)] if self._gpus else None
        self._workers[slot] = LocalWorker(task, gpu)

    def wait(self, seconds: float) -> list[tuple[Task, TaskOutcome]]:
        """See :class:`Executor`."""
        until = time.monotonic() + seconds
        while not (ended := [slot for slot, worker in self._workers.items() if worker.ended]):
            if time.monotonic() >= until:
                break
            time.sleep(_PAUSE)
        return [(worker.task, worker.outcome()) for worker in map(self._workers.pop, ended)]

    def stop(self) -> None:
        """See :class:`Executor`."""
        until = time.monotonic() + STOPPING
        try:
            for worker in self._workers.values():
                worker.ask_to_stop()
            for worker in self._workers.values():
                worker.wait_or_kill(until - time.monotonic())
        except KeyboardInterrupt:
            for worker in self._workers.values():
                worker.wait_or_kill(0.0)
            raise
        finally:
            self._workers.clear()


class LocalWorker:
    """A worker process on this machine, which ends when this object's process does; it sees one GPU, or all."""

    def __init__(self, task: Task, gpu: str | None = None) -> None:
        self.task = task
        environment = task.environment(os.environ)
        if gpu is not None:  # the only one that the worker sees, whatever its number was
            task, environment["CUDA_VISIBLE_DEVICES"] = replace(task, device="cuda"), gpu
        Path(task.log).parent.mkdir(parents=True, exist_ok=True)
        with Path(task.log).open("a", encoding="utf-8") as messages:
            self._process = subprocess.Popen(
                task.command(),
                stdin=subprocess.PIPE,  # never written: the worker stops when it is closed
                stdout=subprocess.PIPE,
                stderr=messages,
                env=environment,
                encoding="utf-8",
                errors="replace",
                start_new_session=True,  # Ctrl-C reaches this process alone, which then asks its workers to stop
            )

    @property
    def ended(self) -> bool:
        """Whether the process has."""
        return self._process.poll() is not None

    def outcome(self) -> TaskOutcome:
        """How it ended; waits until it has."""
        printed, _ = self._process.communicate()
        return TaskOutcome.read(self._process.returncode, printed)

    def ask_to_stop(self) -> None:
        """Have it save its state and end."""
        with suppress(BrokenPipeError):
            if self._process.stdin is not None:
                self._process.stdin.close()

    def wait_or_kill(self, seconds: float) -> None:
        """Wait until it has ended, or kill it."""
        with self._process:
            try:
                self._process.wait(max(0.0, seconds))
            except subprocess.TimeoutExpired:
                self._process.kill()
