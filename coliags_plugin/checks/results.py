"""Outcomes of checks, and their text: the lines of ``coliags check method`` and ``installation``."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal
from unittest import SkipTest

from coliags_plugin.core.errors import InterruptedRunError

Status = Literal["passed", "failed", "skipped"]

_TICKS: dict[Status, str] = {"passed": "\u2713", "failed": "\u2717", "skipped": "-"}


class CheckFailedError(AssertionError):
    """A check found a fault; the message says which."""


class CheckSkippedError(SkipTest):
    """The check does not apply, or lacks what it needs; the message says why. pytest skips the test."""


def fail_if(faults: str | Sequence[str], what: str, advice: str = "") -> None:
    """Fail the check if there are faults: a difference, or names that share the fault ``what``."""
    if faults:
        names = faults if isinstance(faults, str) else ", ".join(faults)
        raise CheckFailedError(f"{what}: {names}{'; ' if advice else ''}{advice}")


@dataclass(frozen=True)
class CheckResult:
    """Outcome of one check."""

    name: str  # short and unique
    status: Status
    detail: str  # one line: what holds, what is wrong, or why the check was skipped
    seconds: float = 0.0  # duration of the check
    traceback: str = ""  # of an exception that ended it; empty without


def run_check(name: str, check: Callable[[], str], describe: Callable[[Exception], str] = str) -> CheckResult:
    """Run a check, which returns what holds or raises; ``describe`` puts an unexpected exception into one line."""
    start = time.monotonic()
    status: Status = "failed"
    trace = ""
    try:
        status, detail = "passed", check()
    except CheckSkippedError as reason:
        status, detail = "skipped", str(reason)
    except CheckFailedError as error:
        detail, trace = "; ".join(str(error).split("\n")), traceback.format_exc() if error.__cause__ else ""
    except InterruptedRunError as error:
        raise KeyboardInterrupt from error
    except Exception as error:
        detail, trace = describe(error), traceback.format_exc()
    return CheckResult(name, status, detail, time.monotonic() - start, trace)


def line(result: CheckResult, width: int) -> str:
    """One result: tick, cross or dash, name padded to ``width``, seconds and detail."""
    seconds = f"{result.seconds:6.1f} s" if result.status != "skipped" else 8 * " "
    return f"{_TICKS[result.status]} {result.name:<{width}} {seconds}  {result.detail}".rstrip()


def summary(results: Sequence[CheckResult]) -> str:
    """Numbers of checks that passed, failed and were skipped, and their time."""
    counts = {status: sum(result.status == status for result in results) for status in _TICKS}
    parts = ", ".join(f"{count} {status}" for status, count in counts.items() if count or status != "skipped")
    return f"{parts} in {sum(result.seconds for result in results):.1f} s"


def tracebacks(results: Sequence[CheckResult]) -> list[str]:
    """Name and traceback of every check that ended with an exception."""
    return [f"\n{result.name}:\n{result.traceback}" for result in results if result.traceback]
