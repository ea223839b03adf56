"""Results of checks, their text, and the exceptions that end a check which has not passed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

Status = Literal["passed", "failed", "skipped"]

_TICKS: dict[Status, str] = {"passed": "\u2713", "failed": "\u2717", "skipped": "-"}
_WORDS: dict[Status, str] = {"passed": "ok  ", "failed": "FAIL", "skipped": "-   "}


@dataclass(frozen=True)
class CheckResult:
    """Outcome of one check."""

    name: str  # of the check
    status: Status  # how it ended
    detail: str  # one line: what was measured, what is wrong, or why it was skipped
    seconds: float = 0.0  # how long it took
    traceback: str = ""  # of an exception that ended it; empty without


class CheckFailedError(Exception):
    """A check found a fault; the message says which."""


class CheckSkippedError(Exception):
    """The check does not apply to the method; the message says why."""


def line(result: CheckResult, width: int, encoding: str) -> str:
    """One result: tick, cross or dash, name padded to ``width``, seconds and detail.

    Words stand for ticks, and escapes for characters, that the encoding of where it is printed does not have.
    """
    try:
        "".join(_TICKS.values()).encode(encoding)
        mark = _TICKS[result.status]
    except UnicodeEncodeError:
        mark = _WORDS[result.status]
    seconds = f"{result.seconds:6.1f} s" if result.status != "skipped" else 8 * " "
    return _printable(f"{mark} {result.name:<{width}} {seconds}  {result.detail}".rstrip(), encoding)


def summary(results: Sequence[CheckResult]) -> str:
    """How many passed, failed and were skipped, and in what time."""
    counts = {status: sum(result.status == status for result in results) for status in _TICKS}
    told = ", ".join(f"{count} {status}" for status, count in counts.items() if count or status != "skipped")
    return f"{told} in {sum(result.seconds for result in results):.1f} s"


def tracebacks(results: Sequence[CheckResult], encoding: str) -> list[str]:
    """Name and traceback of every check that ended with an exception."""
    return [_printable(f"\n{result.name}:\n{result.traceback}", encoding) for result in results if result.traceback]


def _printable(text: str, encoding: str) -> str:
    return text.encode(encoding, errors="backslashreplace").decode(encoding)
