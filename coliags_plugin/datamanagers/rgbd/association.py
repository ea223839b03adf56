"""Association of images, poses and depth files by timestamps or by order."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from coliags_plugin.core.errors import InputError
from coliags_plugin.geometry.poses.trajectory import natural_order

#: A file stem that is a timestamp in seconds with a fraction, as TUM's, with an optional suffix.
_TIME = re.compile(r"(\d+\.\d+)(?:_[a-z]+)?", re.IGNORECASE)


def is_time(name: str) -> bool:
    """Whether a file stem is a timestamp in seconds; unlike a frame number it has a decimal point."""
    return _TIME.fullmatch(name) is not None


def times(paths: Sequence[Path]) -> Float[np.ndarray, "N"]:
    """Timestamps from file names; integers are accepted too. [N]

    Raises:
        InputError: A name is not a number.
    """
    return np.array([_time(path) for path in paths])


def numbers(name: str) -> tuple[int, ...]:
    """All integers in a name, which identify the frame of images and depth files regardless of padding."""
    return tuple(int(digits) for digits in re.findall(r"\d+", name))


def by_number(paths: Sequence[Path]) -> dict[tuple[int, ...], Path]:
    """Files in natural order, 2 before 10, by the numbers in their names.

    Raises:
        InputError: A name has no number, or two have the same.
    """
    found: dict[tuple[int, ...], Path] = {}
    for index in natural_order([path.name for path in paths]):
        path = paths[index]
        key = numbers(path.stem)
        if not key:
            raise InputError(f"{path}: no number in its name", "names that count the frames", "Move other files away")
        if key in found:
            raise InputError(f"{found[key]} and {path.name} have the same number", "one file per frame", "Remove one")
        found[key] = path
    return found


def nearest_in_time(
    wanted: Float[np.ndarray, "N"], known: Float[np.ndarray, "M"], tolerance: float
) -> Int[np.ndarray, "N"]:
    """Match timestamps one to one, closest pairs first, as TUM's tools do.

    Args:
        wanted: Timestamps, in any order. [N]
        known: Timestamps to match them with, in any order. [M]
        tolerance: Largest difference.

    Returns:
        Indices into ``known``, -1 without a match within the tolerance. [N]
    """
    order = np.argsort(known, kind="stable")
    # Names are rounded to microseconds; pairs exactly at the tolerance must match.
    reach = tolerance + 1e-6
    low = np.searchsorted(known[order], wanted - reach, side="left")
    high = np.searchsorted(known[order], wanted + reach, side="right")
    first = np.repeat(np.arange(len(wanted)), high - low)
    ranges = [np.arange(0), *(np.arange(a, b) for a, b in zip(low, high, strict=True))]
    second = order[np.concatenate(ranges)]
    partner = np.full(len(wanted), -1, np.int64)
    taken = np.zeros(len(known), bool)
    for pair in np.argsort(np.abs(wanted[first] - known[second]), kind="stable"):
        here, there = first[pair], second[pair]
        if partner[here] < 0 and not taken[there]:
            partner[here] = there
            taken[there] = True
    return partner


def _time(path: Path) -> float:
    match = _TIME.fullmatch(path.stem)
    if match is not None:
        return float(match.group(1))
    if path.stem.isdecimal():
        return float(path.stem)
    raise InputError(
        f"{path}: its name is not a timestamp", "a name in seconds, for instance 1305031102.175304.png", "Rename it"
    )
