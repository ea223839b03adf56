"""Matching of the frames of two trajectories, and errors of one against the other: ATE and RPE.

Absolute trajectory error and relative pose error: J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM
systems", IROS 2012. Alignment: S. Umeyama, "Least-squares estimation of transformation parameters between two point
patterns", IEEE TPAMI 13(4), 1991.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int

from coliags_plugin.core.errors import InputError
from coliags_plugin.geometry.poses.endogslam import image_indices
from coliags_plugin.geometry.poses.trajectory import Trajectory, inverse, rigid, rotation_angles_deg

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
        "The counts are those of EndoGSLAM's training frames: pass `match=endogslam-train`"
        if fits_training
        else "Give trajectories of the same frames, or formats that keep names or timestamps",
    )


def nearest_in_time(
    times: Float[np.ndarray, "N"], others: Float[np.ndarray, "M"], tolerance: float
) -> Int[np.ndarray, "N"]:
    """Match timestamps, in any order, one to one, closest pairs first, as TUM's tools do.

    Returns indices into ``others``, -1 without a match within the tolerance. [N]
    """
    order = np.argsort(others, kind="stable")
    low = np.searchsorted(others[order], times - tolerance, side="left")
    high = np.searchsorted(others[order], times + tolerance, side="right")
    first = np.repeat(np.arange(len(times)), high - low)
    ranges = [np.arange(0), *(np.arange(a, b) for a, b in zip(low, high, strict=True))]
    second = order[np.concatenate(ranges)]
    partner = np.full(len(times), -1, np.int64)
    is_matched = np.zeros(len(others), bool)
    for pair in np.argsort(np.abs(times[first] - others[second]), kind="stable"):
        here, there = first[pair], second[pair]
        if partner[here] < 0 and not is_matched[there]:
            partner[here] = there
            is_matched[there] = True
    return partner


_Pairs = tuple[np.ndarray, str]
_NO_PAIRS = np.empty((0, 2), np.int64)


def _by_name(first: Trajectory, second: Trajectory, tolerance: float) -> _Pairs:
    if first.names is None or second.names is None:
        return _NO_PAIRS, "not both have names"
    for of in (str, lambda name: PurePosixPath(name.replace("\\", "/")).stem):
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
    why_few = f"{len(matched)} within {tolerance:g} s"
    if not len(matched):
        ranges = [f"{times.min():.6f} to {times.max():.6f}" for times in (first.timestamps, second.timestamps)]
        why_few += f" of {' and '.join(ranges)}: seconds of one clock are expected, not nanoseconds"
    return np.column_stack([matched, partner[matched]]), why_few


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


@dataclass(frozen=True, eq=False)
class Similarity:
    """Transform x -> scale * rotation @ x + translation."""

    scale: float  # 1 for a rigid transform
    rotation: Float[np.ndarray, "3 3"]  # rotation matrix, det 1
    translation: Float[np.ndarray, "3"]  # units of the target

    def points(self, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
        """Transformed points. [N, 3]"""
        return self.scale * points @ self.rotation.T + self.translation

    @property
    def matrix(self) -> Float[np.ndarray, "3 4"]:
        """Scale times rotation, and translation, side by side."""
        return np.column_stack([self.scale * self.rotation, self.translation])


#: Extents below this share of the coordinates are rounding errors.
_ROUNDING = 1e-9


def umeyama(source: Float[np.ndarray, "N 3"], target: Float[np.ndarray, "N 3"], with_scale: bool = False) -> Similarity:
    """Least-squares rigid or similarity transform between corresponding points (Umeyama's method).

    Points on a line leave the rotation about it undetermined: any of those that fit equally well is returned.
    """
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    centered, target_centered = source - source_mean, target - target_mean
    if with_scale and any(
        np.abs(offsets).max() <= _ROUNDING * np.abs(points).max()
        for offsets, points in ((centered, source), (target_centered, target))
    ):
        raise InputError(
            "a scale cannot be estimated: the camera of one trajectory does not move",
            "two cameras that move",
            "Align without `scale`",
        )
    u, values, vt = np.linalg.svd(target_centered.T @ centered / len(source))
    sign = 1.0 if np.linalg.det(u) * np.linalg.det(vt) > 0.0 else -1.0
    rotation = u @ np.diag([1.0, 1.0, sign]) @ vt
    scale = float((values * (1.0, 1.0, sign)).sum() / (centered**2).sum(axis=1).mean()) if with_scale else 1.0
    return Similarity(scale, rotation, target_mean - scale * rotation @ source_mean)


@dataclass(frozen=True)
class ErrorStatistics:
    """Summary statistics of errors."""

    rmse: float
    mean: float
    median: float
    max: float

    @classmethod
    def of(cls, errors: Float[np.ndarray, "N"]) -> ErrorStatistics:
        """Statistics of N errors, N > 0."""
        return cls(
            float(np.sqrt(np.mean(errors**2))), float(errors.mean()), float(np.median(errors)), float(errors.max())
        )


@dataclass(frozen=True, eq=False)
class Alignment:
    """Matched frames of an estimate aligned with a reference, and their errors."""

    matches: FrameMatches  # matched frames; ``first`` is the estimate's
    transform: Similarity  # from the estimate's world to the reference's, by the positions
    with_scale: bool  # whether the scale was estimated
    delta: int  # matched frames between the two poses of a relative error
    path_length: float  # of the reference over the matched frames, units of the reference as all lengths here
    position_errors: Float[np.ndarray, "M"]  # distances of the centres after alignment
    ate: ErrorStatistics  # absolute trajectory error: of the position errors
    rpe_translation: ErrorStatistics  # translation part of the relative pose error
    rpe_rotation_deg: ErrorStatistics  # rotation part of the relative pose error, degrees

    @property
    def ate_share(self) -> float | None:
        """RMSE of the absolute trajectory error relative to the length of the path; None where there is no path."""
        return self.ate.rmse / self.path_length if self.path_length > 0.0 else None

    def to_json(self, unit: str) -> dict[str, Any]:
        """All results as JSON values; ``unit`` names the reference's unit of length."""
        return {
            "unit": unit,
            "matched": len(self.matches),
            "matched_by": self.matches.by,
            "alignment": "Sim(3)" if self.with_scale else "SE(3)",
            "scale": self.transform.scale,
            "rotation": self.transform.rotation.tolist(),
            "translation": self.transform.translation.tolist(),
            "ate": vars(self.ate),
            "path_length": self.path_length,
            "ate_share_of_path": self.ate_share,
            "rpe_delta_frames": self.delta,
            "rpe_translation": vars(self.rpe_translation),
            "rpe_rotation_deg": vars(self.rpe_rotation_deg),
            "frames": {
                "estimate": self.matches.first.tolist(),
                "reference": self.matches.second.tolist(),
                "position_error": self.position_errors.tolist(),
            },
        }


def align(
    estimate: Trajectory, reference: Trajectory, matches: FrameMatches, with_scale: bool = False, delta: int = 1
) -> Alignment:
    """Align the matched frames of an estimate with a reference, estimate first, and compute the errors.

    With ``with_scale`` by Sim(3) instead of SE(3), for an estimate of arbitrary scale; the two poses of a relative
    error are ``delta`` matched frames apart.
    """
    if not 1 <= delta < len(matches):
        raise InputError(
            f"a relative error over {delta} frames, and {len(matches)} matched frames",
            f"1 to {len(matches) - 1} frames",
            "Choose `delta` accordingly",
        )
    estimated, true = estimate.camera_to_world[matches.first], reference.camera_to_world[matches.second]
    transform = umeyama(estimated[:, :3, 3], true[:, :3, 3], with_scale)
    aligned = rigid(transform.rotation @ estimated[:, :3, :3], transform.points(estimated[:, :3, 3]))
    # Relative motions in the camera frame: world frames cancel, the scale does not.
    difference = inverse(_motion(true, delta)) @ _motion(aligned, delta)
    errors = np.linalg.norm(aligned[:, :3, 3] - true[:, :3, 3], axis=1)
    return Alignment(
        matches,
        transform,
        with_scale,
        delta,
        path_length=float(np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1).sum()),
        position_errors=errors,
        ate=ErrorStatistics.of(errors),
        rpe_translation=ErrorStatistics.of(np.linalg.norm(difference[:, :3, 3], axis=1)),
        rpe_rotation_deg=ErrorStatistics.of(rotation_angles_deg(difference[:, :3, :3])),
    )


def _motion(camera_to_world: np.ndarray, delta: int) -> np.ndarray:
    return np.asarray(inverse(camera_to_world[:-delta]) @ camera_to_world[delta:])
