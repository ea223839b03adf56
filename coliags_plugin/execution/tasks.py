"""What a worker process is told, and what it tells when it ends."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal

from typing_extensions import Self

#: How a worker ended. ``unwritable``: failed, as its folder cannot be written; ``died``: without a word, killed or
#: crashed; ``stopped``: asked to, with its state saved.
Ending = Literal["done", "failed", "unwritable", "stopped", "died"]

#: Exit status of a worker that was asked to stop.
STOPPED = 130


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
        count = str(self.threads)
        package = str(Path(__file__).resolve().parents[2])
        search_path = os.pathsep.join(filter(None, [package, inherited.get("PYTHONPATH")]))
        names = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS")
        # A short spin of waiting threads, as on the command line (coliags_plugin.cli.main).
        own = {**self.variables, **dict.fromkeys(names, count), "PYTHONPATH": search_path}
        return {"GOMP_SPINCOUNT": "10000", **inherited, **own}


@dataclass(frozen=True)
class TaskOutcome:
    """How a worker ended."""

    ending: Ending
    reason: str = ""  # why it failed, died or stopped; empty where it is done


def outcome_line(outcome: TaskOutcome) -> str:
    """One line of JSON, which a worker prints last."""
    return json.dumps(asdict(outcome))


def read_outcome(returncode: int, printed: str) -> TaskOutcome:
    """The outcome of a worker that has ended; a negative status is the signal that ended it."""
    try:
        values: dict[str, Any] = json.loads(printed.strip().splitlines()[-1])
        return TaskOutcome(**values)
    except (IndexError, ValueError, TypeError):
        return TaskOutcome("died", _how_it_died(returncode))


def _how_it_died(returncode: int) -> str:
    import signal

    if returncode >= 0:
        return f"the process ended with status {returncode} without a message"
    try:
        name = signal.Signals(-returncode).name
    except ValueError:
        name = f"signal {-returncode}"
    hint = "; the system does so when memory runs out" if name == "SIGKILL" else ""
    return f"the process was ended by {name}{hint}"
