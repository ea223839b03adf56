"""Results of the checks, and the exceptions by which a check ends otherwise than well."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Status = Literal["passed", "failed", "skipped"]


@dataclass(frozen=True)
class Result:
    """Outcome of one check.

    Attributes:
        name: Of the check.
        status: How it ended.
        seconds: How long it took.
        detail: One line: what was found, what is wrong, or why it was skipped.
        traceback: Of an exception that ended it; empty without.
    """

    name: str
    status: Status
    seconds: float
    detail: str
    traceback: str = ""


class CheckFailedError(Exception):
    """The method breaks what the check is about; the message says how."""


class CheckSkippedError(Exception):
    """The check does not apply to the method; the message says why."""
