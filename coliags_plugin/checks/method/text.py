"""Results of the checks as lines of text."""

from __future__ import annotations

from collections.abc import Sequence

from coliags_plugin.checks.method.results import Result, Status

_TICKS: dict[Status, str] = {"passed": "\u2713", "failed": "\u2717", "skipped": "-"}
_WORDS: dict[Status, str] = {"passed": "ok  ", "failed": "FAIL", "skipped": "-   "}


def line(result: Result, width: int, encoding: str) -> str:
    """One result: tick, cross or dash, name, seconds and detail.

    Args:
        result: What to write.
        width: Of the names.
        encoding: Of where it is printed; words stand for ticks, and escapes for characters, that it does not have.
    """
    try:
        "".join(_TICKS.values()).encode(encoding)
        mark = _TICKS[result.status]
    except UnicodeEncodeError:
        mark = _WORDS[result.status]
    seconds = f"{result.seconds:6.1f} s" if result.status != "skipped" else 8 * " "
    return _printable(f"{mark} {result.name:<{width}} {seconds}  {result.detail}".rstrip(), encoding)


def summary(results: Sequence[Result]) -> str:
    """How many passed, failed and were skipped, and in what time."""
    counts = {status: sum(result.status == status for result in results) for status in _TICKS}
    told = ", ".join(f"{count} {status}" for status, count in counts.items() if count or status != "skipped")
    return f"{told} in {sum(result.seconds for result in results):.1f} s"


def tracebacks(results: Sequence[Result], encoding: str) -> list[str]:
    """Name and traceback of every check that ended with an exception."""
    return [_printable(f"\n{result.name}:\n{result.traceback}", encoding) for result in results if result.traceback]


def _printable(text: str, encoding: str) -> str:
    return text.encode(encoding, errors="backslashreplace").decode(encoding)
