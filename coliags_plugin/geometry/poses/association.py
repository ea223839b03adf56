"""Matching of the frames of two trajectories: by name, time or index."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from coliags_plugin.core.errors import InputError
from coliags_plugin.geometry.poses.endogslam import image_indices
from coliags_plugin.geometry.poses.trajectory import Trajectory

Match = Literal["auto", "name", "time", "index", "endogslam-train"]

#: Least number of matched frames for an alignment.
FEWEST_MATCHES = 3


@dataclass(frozen=True, eq=False)
class FrameMatches:
    """Matched frames of two trajectories."""

    # Indices into the two, in the order of the first
    first: Int[np.ndarray, "M"]
    second: Int[np.ndarray, "M"]
    by: str  # ``name``, ``time``, ``index`` or ``endogslam-train``
    skipped: tuple[str, ...] = ()  # criteria tried before, and why they failed

    def __len__(self) -> int:
        return len(self.first)


def associate(first: Trajectory, second: Trajectory, match: Match = "auto", tolerance: float = 0.02) -> FrameMatches:
    """Match at least three frames of two trajectories, the estimate usually first.

    ``name``: equal image names, or equal file stems. ``time``: timestamps within ``tolerance`` (s), nearest pairs
    first, each frame once. ``index``: by index, for equal counts. ``endogslam-train``: the k-th pose of the first with
    the k-th training frame of the second by EndoGSLAM's split, all but 7, 15, 23, ... ``auto``: the first of name,
    time and index that matches at least three frames.
    """
    has = {
        "name": first.names is not None and second.names is not None,
        "time": first.timestamps is not None and second.timestamps is not None,
        "index": True,
    }
    tried: list[str] = []
    for by in [by for by in has if has[by]] if match == "auto" else [match]:
        pairs, why_not = _ASSOCIATIONS[by](first, second, tolerance)
        if len(pairs) >= FEWEST_MATCHES:
            order = np.argsort(pairs[:, 0])
            return FrameMatches(pairs[order, 0], pairs[order, 1], by, tuple(tried))
        tried.append(f"by {by}: {why_not or f'{len(pairs)} frames match'}")
    training = image_indices(len(first), len(second))
    fits_training = match == "auto" and training is not None and len(first) != len(second)
    raise InputError(
        f"frames cannot be matched ({'; '.join(tried)})",
        f"at least {FEWEST_MATCHES} matching frames",
        "The counts are those of EndoGSLAM's training frames: pass --match endogslam-train"
        if fits_training
        else "Give trajectories of the same frames, or formats that keep names or timestamps",
    )


def nearest_in_time(
    wanted: Float[np.ndarray, "N"], known: Float[np.ndarray, "M"], tolerance: float
) -> Int[np.ndarray, "N"]:
    """Match timestamps, in any order, one to one, closest pairs first, as TUM's tools do.

    Returns indices into ``known``, -1 without a match within the tolerance. [N]
    """
    order = np.argsort(known, kind="stable")
    low = np.searchsorted(known[order], wanted - tolerance, side="left")
    high = np.searchsorted(known[order], wanted + tolerance, side="right")
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


_Pairs = tuple[np.ndarray, str]
_NO_PAIRS = np.empty((0, 2), np.int64)


def _by_name(first: Trajectory, second: Trajectory, tolerance: float) -> _Pairs:
    if first.names is None or second.names is None:
        return _NO_PAIRS, "not both have names"
    for of in (str, _stem):
        names, others = [of(name) for name in first.names], [of(name) for name in second.names]
        common = set(names) & set(others)
        repeated = [name for counts in (Counter(names), Counter(others)) for name in common if counts[name] > 1]
        if repeated:
            return _NO_PAIRS, f"'{min(repeated)}' names several frames"
        if common:
            indices = {name: index for index, name in enumerate(others)}
            return np.array([(index, indices[name]) for index, name in enumerate(names) if name in common]), ""
    return _NO_PAIRS, "no name in common"


def _by_time(first: Trajectory, second: Trajectory, tolerance: float) -> _Pairs:
    if first.timestamps is None or second.timestamps is None:
        return _NO_PAIRS, "not both have timestamps"
    if any(len(np.unique(times)) < len(times) for times in (first.timestamps, second.timestamps)):
        return _NO_PAIRS, "timestamps are repeated"
    partner = nearest_in_time(first.timestamps, second.timestamps, tolerance)
    matched = np.flatnonzero(partner >= 0)
    return np.column_stack([matched, partner[matched]]), f"{len(matched)} within {tolerance:g} s"


def _by_index(first: Trajectory, second: Trajectory, tolerance: float) -> _Pairs:
    if len(first) != len(second):
        return _NO_PAIRS, f"{len(first)} and {len(second)} poses"
    return np.repeat(np.arange(len(first))[:, None], 2, axis=1), ""


def _by_training_frame(first: Trajectory, second: Trajectory, tolerance: float) -> _Pairs:
    indices = image_indices(len(first), len(second))
    if indices is None or len(first) == len(second):
        return _NO_PAIRS, f"{len(first)} poses are not the training frames of {len(second)}"
    return np.column_stack([np.arange(len(first)), indices]), ""


_ASSOCIATIONS = {"name": _by_name, "time": _by_time, "index": _by_index, "endogslam-train": _by_training_frame}


def _stem(name: str) -> str:
    return PurePosixPath(name.replace("\\", "/")).stem
