"""Work of a worker process: what it is told on its command line, how it runs, and what it tells when it ends.

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
import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal

from typing_extensions import Self

from coliags_plugin.core.errors import InterruptedRunError, NotWritableError, ReportedError

log = logging.getLogger(__name__)

#: How a worker ended. ``unwritable``: failed, as its folder cannot be written; ``died``: without a word, killed or
#: crashed; ``stopped``: asked to, with its state saved.
Ending = Literal["done", "failed", "unwritable", "stopped", "died"]

#: Exit status of a worker that was asked to stop.
STOPPED = 130
#: For a step, or what else cannot be interrupted, to end after the worker was asked to stop, seconds.
_GRACE = 30.0


def own_variables() -> dict[str, str]:
    """Environment variables of this package."""
    return {name: value for name, value in os.environ.items() if name.startswith("COLIAGS_")}


@dataclass(frozen=True, kw_only=True)
class Task:
    """Work as a worker process is told of it; each kind of work has fields of its own."""

    worker: ClassVar[str]  # module that is run
    title: str
    key: str  # that no other task of the same queue has
    device: str
    log: str  # file of the worker's messages
    threads: int  # CPU threads for work that begins; what goes on may keep its number
    variables: Mapping[str, str] = field(default_factory=own_variables)  # this package's, for machines without them

    def to_json(self) -> str:
        """As the argument of a worker."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Self:
        """What :meth:`to_json` wrote, lists as tuples."""
        values: Any = {name: tuple(each) if isinstance(each, list) else each for name, each in json.loads(text).items()}
        return cls(**values)

    def command(self) -> list[str]:
        """Command line of the worker process."""
        return [sys.executable, "-m", self.worker, self.to_json()]

    def environment(self, inherited: Mapping[str, str]) -> dict[str, str]:
        """Environment of the worker process: this package, and the number of threads of every library that asks."""
        package = str(Path(__file__).resolve().parents[2])
        search_path = os.pathsep.join(filter(None, [package, inherited.get("PYTHONPATH")]))
        names = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS")
        # A short spin of waiting threads, as on the command line (coliags_plugin.cli.main).
        own = {**self.variables, **dict.fromkeys(names, str(self.threads)), "PYTHONPATH": search_path}
        return {"GOMP_SPINCOUNT": "10000", **inherited, **own}


@dataclass(frozen=True)
class TaskOutcome:
    """How a worker ended."""

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
        known = {each.value: each.name for each in signal.Signals}
        hint = "; the system does so when memory runs out" if known.get(-returncode) == "SIGKILL" else ""
        return cls("died", f"the process was ended by {known.get(-returncode, f'signal {-returncode}')}{hint}")


def run_worker(work: Callable[[str], TaskOutcome]) -> None:
    """Work on the task of the command line and exit: 0, 1 for a failure, 130 where it was asked to stop."""
    with os.fdopen(os.dup(1), "w") as answers:
        os.dup2(2, 1)  # whatever a library prints is a message
        signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
        signal.signal(signal.SIGTERM, lambda *_: os.kill(os.getpid(), signal.SIGINT))
        if stat.S_ISFIFO(os.fstat(0).st_mode):
            threading.Thread(target=_stop_with_input, daemon=True).start()
        logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", stream=sys.stderr)
        outcome = work(sys.argv[1])
        log.info("%s%s", outcome.ending, f": {outcome.reason}" if outcome.reason else "")
        answers.write(outcome.line() + "\n")
    sys.exit({"done": 0, "stopped": STOPPED}.get(outcome.ending, 1))


def attempt(title: str, folder: str, work: Callable[[], None]) -> TaskOutcome:
    """How work in a folder ends: every error becomes the reason of its failure."""
    try:
        log.info("%s: process %d", title, os.getpid())
        work()
    except (InterruptedRunError, KeyboardInterrupt) as error:
        return TaskOutcome("stopped", str(error))
    except ReportedError as error:
        return TaskOutcome("unwritable" if isinstance(error, NotWritableError) else "failed", str(error))
    except Exception as error:
        log.exception("%s", title)
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            return TaskOutcome("unwritable", f"no space left for {folder}")
        first = str(error).strip().partition("\n")[0]
        return TaskOutcome("failed", f"{type(error).__name__}: {first}" if first else type(error).__name__)
    return TaskOutcome("done")


def _stop_with_input() -> None:
    """Wait for the end of standard input, then stop as Ctrl-C does, and at last at once."""
    while os.read(0, 4096):
        pass
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(_GRACE)
    os._exit(STOPPED)
