"""Exceptions that are reported to the user."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from difflib import get_close_matches


class ReportedError(Exception):
    """Error that the command line and notebooks print without a traceback; the former exits with ``exit_status``."""

    exit_status = 1

    def _render_traceback_(self) -> list[str]:
        """Text that IPython shows instead of a traceback."""
        return [f"{type(self).__name__}: {self}"]


class InputError(ReportedError):
    """Invalid input: a file, option or value that cannot be used.

    Args:
        seen: What was found, naming the file, key or value.
        expected: What would have been valid.
        do: What the user can do about it.
    """

    exit_status = 2

    def __init__(self, seen: str, expected: str = "", do: str = "") -> None:
        self.seen, self.expected, self.do = seen, expected, do
        parts = (seen, f"Expected {expected}" if expected else "", do)
        text = ". ".join(part.rstrip(".") for part in parts if part)
        super().__init__(text if text.endswith("?") else f"{text}.")


class NotWritableError(InputError):
    """A folder that cannot be written: a full disk, or no permission."""


class InterruptedRunError(ReportedError):
    """Training was interrupted by the user, after its state was saved."""

    exit_status = 130


class NotFiniteError(ReportedError):
    """A loss or parameter became NaN or infinite."""


class NothingDrawnError(ReportedError):
    """No Gaussian was drawn for many steps: the field is not where the cameras look."""


class DeviceMemoryError(ReportedError):
    """The memory of a device ran out."""


class UnavailableError(Exception):
    """A quantity cannot be computed (missing weights, missing ground truth); the message is the reason.

    Not a failure: the caller records null with the reason.
    """


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Hint with the known word most similar to an unknown one; empty where none is similar."""
    close = get_close_matches(word, list(known), n=1, cutoff=0.5)
    return f"Did you mean '{close[0]}'?" if close else ""


def check_number(option: str, number: int | None, least: int = 1) -> None:
    """Refuse a number of an option that is too small; None is none."""
    if number is not None and number < least:
        raise InputError(f"`{option}={number}`", f"at least {least}")


def check_name(noun: str, name: str, known: Collection[str]) -> None:
    """Refuse a name that is none of those known."""
    if name not in known:
        expected = f"one of {', '.join(known)}" if known else f"none, as there is no {noun} here"
        raise InputError(f"no {noun} '{name}'", expected, did_you_mean(name, known))
