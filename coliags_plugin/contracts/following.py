"""Base classes of observers of a training run."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

from coliags_plugin.core.json_files import JsonObject


class Follower:
    """Observer of a training run, called after every step and every row of the log; it changes nothing of the run."""

    def logged(self, row: JsonObject) -> None:
        """A row has been added to the training log (docs/results_files.md)."""

    def stepped(self, step: int) -> None:
        """A training step is done; the model stays as it is until this returns."""

    def close(self) -> None:
        """Training has ended, however it did."""


class Logger(Follower, ABC):
    """Base class of loggers, which copy the rows of the training log to another service or format.

    Args:
        run: The run folder.
        title: Method, scene and seed.
        config: The method config as plain values.
        step: Of the checkpoint that training goes on from; 0 at the start. Later rows of an earlier attempt are void.
    """

    #: A library that may not be installed.
    library: ClassVar[str]

    @abstractmethod
    def __init__(self, run: Path, title: str, config: Mapping[str, Any], step: int) -> None: ...


def scalars(row: JsonObject) -> dict[str, float]:
    """Numbers of a row of the training log but its step, those of the loss terms as ``terms/NAME``."""
    flat = {name: value for name, value in row.items() if name != "step"}
    terms = flat.pop("terms", {})
    flat |= {f"terms/{name}": value for name, value in terms.items()}
    return {name: float(value) for name, value in flat.items() if isinstance(value, (int, float))}
