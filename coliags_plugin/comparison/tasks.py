"""What a worker process is told, and what it tells when it ends."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

#: How a worker ended. ``died``: without a word, killed or crashed; ``stopped``: asked to, with its state saved.
Ending = Literal["done", "failed", "stopped", "died"]

#: Exit status of a worker that was asked to stop.
STOPPED = 130


@dataclass(frozen=True)
class Task:
    """One cell, as a worker process is told of it."""

    title: str
    name: str  # of the method, in tables
    method: str  # name or path of the method config
    overrides: tuple[str, ...]  # ``key.path=value`` changes of it
    scene: str  # name of the scene, in tables
    data: str
    data_format: str | None
    seed: int
    device: str
    protocol: str
    run: str
    result: str  # where the results file goes
    result_key: str  # key that the result must have
    log: str  # file of the worker's messages
    threads: int  # CPU threads for a run that begins; one that goes on keeps its number
    variables: Mapping[str, str] = field(default_factory=dict)  # this package's, for machines without them
    save_seconds: float = 60.0  # largest time between two checkpoints
    lock_seconds: float = 120.0  # how long to wait for another process that has the run

    def to_json(self) -> str:
        """As the argument of a worker."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Task:
        """What :meth:`to_json` wrote."""
        values = json.loads(text)
        values["overrides"] = tuple(values["overrides"])
        return cls(**{each.name: values[each.name] for each in fields(cls)})

    def command(self) -> list[str]:
        """Command line of the worker process."""
        return [sys.executable, "-m", "coliags_plugin.comparison.worker", self.to_json()]

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
