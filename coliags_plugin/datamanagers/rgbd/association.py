"""Which image, pose and depth file belong together, by the times in their names or by their order."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from coliags_plugin.core.errors import InputError
from coliags_plugin.poses.trajectory import natural_order

#: A name that is a time: seconds with a fraction, as TUM's are, and perhaps a word behind it.
_TIME = re.compile(r"(\d+\.\d+)(?:_[a-z]+)?", re.IGNORECASE)


def is_time(name: str) -> bool:
    """Whether a file's stem is a time in seconds, told from a frame number by its decimal point."""
    return _TIME.fullmatch(name) is not None


def times(paths: Sequence[Path]) -> Float[np.ndarray, "N"]:
    """The times that files are named by; whole numbers are taken as times too. [N]

    Raises:
        InputError: A name is neither.
    """
    return np.array([_time(path) for path in paths])


def numbers(name: str) -> tuple[int, ...]:
    """All whole numbers in a name: images and depth files of one frame have the same, however they are padded."""
    return tuple(int(digits) for digits in re.findall(r"\d+", name))


def by_number(paths: Sequence[Path]) -> dict[tuple[int, ...], Path]:
    """Files in the order that people count in, 2 before 10, by the numbers in their names.

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
    """For every wanted time the known one that belongs to it.

    Closest pairs are made first, and nothing belongs to two, as TUM's own tools do it: where poses are fewer than
    images, a pose goes to the image it was taken with and not to that one's neighbours too.

    Args:
        wanted: Times, in any order. [N]
        known: Times, in any order. [M]
        tolerance: The largest difference.

    Returns:
        Indices into ``known``, -1 where none is left within the tolerance. [N]
    """
    order = np.argsort(known, kind="stable")
    # Names carry microseconds: rounding must not decide about a pair exactly as far apart as allowed.
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
        f"{path}: its name is no time", "names that are seconds, for instance 1305031102.175304.png", "Rename it"
    )
