"""Tasks for worker processes, the executor that runs them on this machine, and the outcome that a worker prints.

The last line that a worker prints is its :class:`TaskOutcome`; messages go to standard error. When standard input is a
pipe, the worker stops when it is closed, with its state saved: so it ends with whatever started it, however that ends.
"""

from __future__ import annotations

import errno
import json
import logging
import os
import signal
import stat
import subprocess
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from pydantic import TypeAdapter
from typing_extensions import Self

from coliags_plugin.core.errors import InterruptedRunError, NotWritableError, ReportedError

log = logging.getLogger(__name__)

#: How a worker ended. ``unwritable``: failed, as its folder cannot be written; ``died``: without a word, killed or
#: crashed; ``stopped``: asked to, with its state saved.
Ending = Literal["done", "failed", "unwritable", "stopped", "died"]

#: Exit status of a worker that was asked to stop.
STOPPED = 130
#: Time for a step, or what else cannot be interrupted, to end after the worker was asked to stop, seconds.
_GRACE = 30.0
#: Time for workers to save and end once they were asked to, seconds; then they are killed.
STOPPING = 45.0
_PAUSE = 0.1


@dataclass(frozen=True)
class TaskOutcome:
    """End of a worker."""

    ending: Ending
    reason: str = ""  # why it failed, died or stopped; empty where it is done

    def line(self) -> str:
        """One line of JSON, which a worker prints last."""
        return json.dumps(asdict(self))

    @classmethod
    def read(cls, returncode: int, printed: str) -> TaskOutcome:
        """The outcome of a worker that has ended; a negative status is the signal that ended it."""
        try:
            values: dict[str, Any] = json.loads(printed.strip().splitlines()[-1])
            return cls(**values)
        except (IndexError, ValueError, TypeError):
            pass
        if returncode >= 0:
            return cls("died", f"the process ended with status {returncode} without a message")
        names = {each.value: each.name for each in signal.Signals}
        hint = "; the system does so when memory runs out" if names.get(-returncode) == "SIGKILL" else ""
        return cls("died", f"the process was ended by {names.get(-returncode, f'signal {-returncode}')}{hint}")


@dataclass(frozen=True, kw_only=True)
class Task(ABC):
    """Work of one process, which its module, run as a program, does; subclasses add what it has to know."""

    title: str
    key: str  # that no other task of the same queue has
    folder: Path  # where its work is, for messages
    device: str
    log: Path  # file of the worker's messages
    threads: int  # CPU threads for work that begins; what goes on may keep its number
    variables: Mapping[str, str] = field(  # of this package, for machines without them
        default_factory=lambda: {name: value for name, value in os.environ.items() if name.startswith("COLIAGS_")}
    )

    @abstractmethod
    def complete(self) -> None:
        """Do the work, as far as it has not been done."""

    def attempt(self) -> TaskOutcome:
        """Do the work, and return how it ended: every error becomes the reason of its failure."""
        try:
            log.info("%s: process %d", self.title, os.getpid())
            self.complete()
        except (InterruptedRunError, KeyboardInterrupt) as error:
            return TaskOutcome("stopped", str(error))
        except ReportedError as error:
            return TaskOutcome("unwritable" if isinstance(error, NotWritableError) else "failed", str(error))
        except Exception as error:
            log.exception("%s", self.title)
            if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
                return TaskOutcome("unwritable", f"no space left for {self.folder}")
            first = str(error).strip().partition("\n")[0]
            return TaskOutcome("failed", f"{type(error).__name__}: {first}" if first else type(error).__name__)
        return TaskOutcome("done")

    def to_json(self) -> str:
        """The task as the argument of a worker."""
        return TypeAdapter(type(self)).dump_json(self).decode()

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Read what :meth:`to_json` wrote."""
        return TypeAdapter(cls).validate_json(text)

    def command(self) -> list[str]:
        """Command line of the worker process."""
        return [sys.executable, "-m", type(self).__module__, self.to_json()]

    def environment(self, inherited: Mapping[str, str]) -> dict[str, str]:
        """Environment of the worker process: this package, and the number of threads of every library that asks."""
        package = str(Path(__file__).resolve().parents[2])
        search_path = os.pathsep.join(filter(None, [package, inherited.get("PYTHONPATH")]))
        names = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS")
        changes = {**self.variables, **dict.fromkeys(names, str(self.threads)), "PYTHONPATH": search_path}
        # A short spin of waiting threads, as on the command line (coliags_plugin.cli.main).
        return {"GOMP_SPINCOUNT": "10000", **inherited, **changes}


def run_worker(kind: type[Task]) -> None:
    """Work on the task of the command line and exit: 0, 1 for a failure, 130 where it was asked to stop."""
    with os.fdopen(os.dup(1), "w") as answers:
        os.dup2(2, 1)  # whatever a library prints is a message
        signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
        signal.signal(signal.SIGTERM, lambda *_: os.kill(os.getpid(), signal.SIGINT))
        if stat.S_ISFIFO(os.fstat(0).st_mode):
            threading.Thread(target=_stop_with_input, daemon=True).start()
        logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", stream=sys.stderr)
        outcome = kind.from_json(sys.argv[1]).attempt()
        log.info("%s%s", outcome.ending, f": {outcome.reason}" if outcome.reason else "")
        answers.write(outcome.line() + "\n")
    sys.exit({"done": 0, "stopped": STOPPED}.get(outcome.ending, 1))


def _stop_with_input() -> None:
    """Wait for the end of standard input, then stop as Ctrl-C does, and at last at once."""
    while os.read(0, 4096):
        pass
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(_GRACE)
    os._exit(STOPPED)


class LocalWorker:
    """A worker process on this machine, which ends when this object's process does; it sees one GPU, or all."""

    def __init__(self, task: Task, gpu: str | None = None) -> None:
        self.task = task
        environment = task.environment(os.environ)
        if gpu is not None:  # the only one that the worker sees, whatever its number was
            task, environment["CUDA_VISIBLE_DEVICES"] = replace(task, device="cuda"), gpu
        task.log.parent.mkdir(parents=True, exist_ok=True)
        with task.log.open("a", encoding="utf-8") as messages:
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
        """Tell whether the process has ended."""
        return self._process.poll() is not None

    def outcome(self) -> TaskOutcome:
        """Outcome of the process; waits until it has ended."""
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


@dataclass(frozen=True)
class ExecutionOptions:
    """Options of running tasks: where, and how many."""

    jobs: int | None = None  # tasks at a time; None: one per CPU, or per GPU
    threads: int | None = None  # CPU threads of each; None: the CPUs divided by the tasks at a time
    device: str = "auto"
    executor: str = "local"
    ray_address: str | None = None  # HOST:PORT of the head; None: RAY_ADDRESS, or the cluster of this machine
    retries: int = 2  # how often a task whose process died is tried again


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
        self.slots, self.threads, self._gpus = slots, threads, tuple(gpus)
        self._workers: dict[int, LocalWorker] = {}  # by slot

    def start(self, task: Task) -> None:
        """Start a task in the first free slot."""
        slot = min(set(range(self.slots)) - self._workers.keys())
        self._workers[slot] = LocalWorker(task, self._gpus[slot % len(self._gpus)] if self._gpus else None)

    def wait(self, seconds: float) -> list[tuple[Task, TaskOutcome]]:
        """Wait for processes that end; returns their tasks with the outcomes."""
        until = time.monotonic() + seconds
        while not (ended := [slot for slot, worker in self._workers.items() if worker.ended]):
            if time.monotonic() >= until:
                break
            time.sleep(_PAUSE)
        return [(worker.task, worker.outcome()) for worker in map(self._workers.pop, ended)]

    def stop(self) -> None:
        """Have all processes save their state and end; kill those that need too long."""
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
