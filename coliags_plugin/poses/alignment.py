"""Evaluation of an estimated trajectory against a reference: association, alignment, ATE and RPE.

- Alignment in closed form: S. Umeyama, "Least-squares estimation of transformation parameters between two point
  patterns", IEEE TPAMI 13(4), 1991.
- Absolute trajectory error and relative pose error: J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM
  systems", IROS 2012.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int

from coliags_plugin.core.errors import InputError
from coliags_plugin.poses.endogslam import image_indices
from coliags_plugin.poses.rigid import inverse, rigid, rotation_angles_deg
from coliags_plugin.poses.trajectory import Trajectory

Match = Literal["auto", "name", "time", "index", "endogslam-train"]

#: Least number of matched frames for an alignment.
FEWEST_MATCHES = 3
#: Least ratio of the paths' extents (standard deviations) across and along their main direction for which the rotation
#: about that direction is determined.
OFF_LINE_SHARE = 1e-3
#: Extents below this share of the coordinates are rounding errors.
_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class Matches:
    """Matched frames of two trajectories.

    Attributes:
        first, second: Indices into the two, in the order of the first. [M]
        by: ``name``, ``time``, ``index`` or ``endogslam-train``.
        skipped: Criteria tried before, and why they failed.
    """

    first: Int[np.ndarray, "M"]
    second: Int[np.ndarray, "M"]
    by: str
    skipped: tuple[str, ...] = ()

    def __len__(self) -> int:
        """Number of pairs."""
        return len(self.first)


@dataclass(frozen=True, eq=False)
class Similarity:
    """x -> scale * rotation @ x + translation.

    Attributes:
        scale: 1 for a rigid transform.
        rotation: Rotation matrix, det 1. [3, 3]
        translation: Units of the target. [3]
        undetermined: Why the points do not determine the rotation, or an empty string. The rotation is then the
            smallest among those that fit equally well.
    """

    scale: float
    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]
    undetermined: str = ""

    def points(self, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
        """Transformed points. [N, 3]"""
        return self.scale * points @ self.rotation.T + self.translation

    def poses(self, camera_to_world: Float[np.ndarray, "N 4 4"]) -> Float[np.ndarray, "N 4 4"]:
        """Transformed camera-to-world poses; they stay rigid, the scale acts on the centres. [N, 4, 4]"""
        return rigid(self.rotation @ camera_to_world[:, :3, :3], self.points(camera_to_world[:, :3, 3]))


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
    """Matched frames of an estimate aligned with a reference, and their errors.

    Attributes:
        matches: Matched frames; ``first`` is the estimate's.
        transform: From the estimate's world to the reference's.
        with_scale: Whether the scale was estimated.
        estimate: The estimate after alignment, camera-to-world. [M, 4, 4]
        reference: The reference, camera-to-world. [M, 4, 4]
        delta: Frames between the two poses of a relative error.
        position_errors: Distance of the centres, in units of the reference. [M]
        rotation_errors_deg: Angle between the cameras; None if the alignment's rotation is undetermined. [M]
        relative_translation_errors: RPE over ``delta`` matched frames, units of the reference. [M - delta]
        relative_rotation_errors_deg: RPE over ``delta`` matched frames, degrees. [M - delta]
    """

    matches: Matches
    transform: Similarity
    with_scale: bool
    estimate: Float[np.ndarray, "M 4 4"]
    reference: Float[np.ndarray, "M 4 4"]
    delta: int
    position_errors: Float[np.ndarray, "M"]
    rotation_errors_deg: Float[np.ndarray, "M"] | None
    relative_translation_errors: Float[np.ndarray, "P"]
    relative_rotation_errors_deg: Float[np.ndarray, "P"]

    @property
    def ate(self) -> ErrorStatistics:
        """Absolute trajectory error, units of the reference."""
        return ErrorStatistics.of(self.position_errors)

    @property
    def rotation_deg(self) -> ErrorStatistics | None:
        """Rotation error after alignment, degrees; None if undetermined."""
        return None if self.rotation_errors_deg is None else ErrorStatistics.of(self.rotation_errors_deg)

    @property
    def rpe_translation(self) -> ErrorStatistics:
        """Translation part of the relative pose error, units of the reference."""
        return ErrorStatistics.of(self.relative_translation_errors)

    @property
    def rpe_rotation_deg(self) -> ErrorStatistics:
        """Rotation part of the relative pose error, degrees."""
        return ErrorStatistics.of(self.relative_rotation_errors_deg)

    def to_json(self, unit: str) -> dict[str, Any]:
        """All results as JSON values; null and a reason for undetermined ones.

        Args:
            unit: Name of the reference's unit of length.
        """
        rotation = self.rotation_deg
        return {
            "unit": unit,
            "matched": len(self.matches),
            "matched_by": self.matches.by,
            "alignment": "Sim(3)" if self.with_scale else "SE(3)",
            "scale": self.transform.scale,
            "rotation": self.transform.rotation.tolist(),
            "translation": self.transform.translation.tolist(),
            "ate": vars(self.ate),
            "rotation_deg": None if rotation is None else vars(rotation),
            "rpe_delta_frames": self.delta,
            "rpe_translation": vars(self.rpe_translation),
            "rpe_rotation_deg": vars(self.rpe_rotation_deg),
            "reasons": {"rotation_deg": self.transform.undetermined} if self.transform.undetermined else {},
            "frames": {
                "estimate": self.matches.first.tolist(),
                "reference": self.matches.second.tolist(),
                "position_error": self.position_errors.tolist(),
                "rotation_error_deg": None if self.rotation_errors_deg is None else self.rotation_errors_deg.tolist(),
            },
        }


def associate(first: Trajectory, second: Trajectory, match: Match = "auto", tolerance: float = 0.02) -> Matches:
    """Match the frames of two trajectories.

    Args:
        first: One trajectory, usually the estimate.
        second: The other.
        match: ``name``: equal image names, or equal file stems. ``time``: timestamps within ``tolerance``, nearest
            pairs first, each frame once. ``index``: by index, for equal counts. ``endogslam-train``: the k-th pose of
            the first with the k-th training frame of the second by EndoGSLAM's split, all but 7, 15, 23, ...
            ``auto``: the first of name, time and index that matches at least three frames.
        tolerance: s.

    Raises:
        InputError: Fewer than three frames match.
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
            return Matches(pairs[order, 0], pairs[order, 1], by, tuple(tried))
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


def umeyama(source: Float[np.ndarray, "N 3"], target: Float[np.ndarray, "N 3"], with_scale: bool = False) -> Similarity:
    """Least-squares rigid or similarity transform between corresponding points (Umeyama's method).

    The rotation is unique only if d2 + s d3 > 0, with d1 >= d2 >= d3 the singular values of the covariance and s the
    sign of its determinant (Umeyama 1991, section III). Otherwise, as for points on a line, the smallest rotation that
    fits is returned, and :attr:`Similarity.undetermined` gives the reason.

    Args:
        source: Points to transform. [N, 3]
        target: Corresponding target points. [N, 3]
        with_scale: Also estimate a scale.

    Raises:
        InputError: A scale is requested, and the points of one side coincide or the two are uncorrelated.
    """
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    centered, wanted = source - source_mean, target - target_mean
    covariance = wanted.T @ centered / len(source)
    left, values, right = np.linalg.svd(covariance)
    sign = 1.0 if np.linalg.det(left) * np.linalg.det(right) > 0.0 else -1.0
    still = _still(source, centered) or _still(target, wanted)
    rotation = left @ np.diag([1.0, 1.0, sign]) @ right
    undetermined = ""
    if still or values[0] <= _ROUNDING * np.sqrt((centered**2).sum() * (wanted**2).sum()) / len(source):
        rotation = np.eye(3)
        undetermined = (
            "the camera does not move, so that positions determine no rotation"
            if still
            else "the two paths are uncorrelated, so that positions determine no rotation"
        )
    elif values[1] + sign * values[2] <= OFF_LINE_SHARE**2 * values[0]:
        rotation = _shortest_rotation(right[0], left[:, 0], right[1])
        undetermined = (
            "the positions lie on a line, about which the rotation is undetermined"
            if values[1] <= 2.0 * OFF_LINE_SHARE**2 * values[0]
            else "one path is the mirror image of the other, so that several rotations fit equally well"
        )
    scale = 1.0
    if with_scale:
        if still or not values[0] > 0.0:
            raise InputError(
                "a scale cannot be estimated: the camera of one trajectory does not move",
                "two cameras that move",
                "Align without --scale",
            )
        scale = float((values * (1.0, 1.0, sign)).sum() / (centered**2).sum(axis=1).mean())
    return Similarity(scale, rotation, target_mean - scale * rotation @ source_mean, undetermined)


def align(
    estimate: Trajectory, reference: Trajectory, matches: Matches, with_scale: bool = False, delta: int = 1
) -> Alignment:
    """Align the matched frames of an estimate with a reference, and compute the errors.

    Args:
        estimate: The estimated trajectory.
        reference: The reference trajectory.
        matches: From :func:`associate`, estimate first.
        with_scale: Sim(3) instead of SE(3), for an estimate of arbitrary scale.
        delta: Matched frames between the two poses of a relative error.

    Raises:
        InputError: ``delta`` is not between 1 and the number of matches less one; or as :func:`umeyama`.
    """
    if not 1 <= delta < len(matches):
        raise InputError(
            f"a relative error over {delta} frames, and {len(matches)} matched frames",
            f"1 to {len(matches) - 1} frames",
            "Choose --delta accordingly",
        )
    estimated, true = estimate.camera_to_world[matches.first], reference.camera_to_world[matches.second]
    transform = umeyama(estimated[:, :3, 3], true[:, :3, 3], with_scale)
    aligned = transform.poses(estimated)
    # Relative motions in the camera frame: world frames cancel, the scale does not.
    difference = inverse(_motion(true, delta)) @ _motion(aligned, delta)
    rotation_errors = rotation_angles_deg(true[:, :3, :3].transpose(0, 2, 1) @ aligned[:, :3, :3])
    return Alignment(
        matches=matches,
        transform=transform,
        with_scale=with_scale,
        estimate=aligned,
        reference=true,
        delta=delta,
        position_errors=np.linalg.norm(aligned[:, :3, 3] - true[:, :3, 3], axis=1),
        rotation_errors_deg=None if transform.undetermined else rotation_errors,
        relative_translation_errors=np.linalg.norm(difference[:, :3, 3], axis=1),
        relative_rotation_errors_deg=rotation_angles_deg(difference[:, :3, :3]),
    )


def _shortest_rotation(start: np.ndarray, end: np.ndarray, beside: np.ndarray) -> np.ndarray:
    """The smallest rotation from one unit vector to another; ``beside`` is perpendicular to the first.

    The product of two half turns, about the first vector and about the bisector of both. (scipy 1.17's
    ``align_vectors`` of one vector is off by degrees if the two are nearly opposite.)
    """
    if start @ end < -0.9999:
        about = _half_turn(beside)
        return np.asarray(_shortest_rotation(-start, end, beside) @ about)
    middle = (start + end) / np.linalg.norm(start + end)
    return np.asarray(_half_turn(middle) @ _half_turn(start))


def _half_turn(axis: np.ndarray) -> np.ndarray:
    return 2.0 * np.outer(axis, axis) - np.eye(3)


def _motion(camera_to_world: np.ndarray, delta: int) -> np.ndarray:
    return np.asarray(inverse(camera_to_world[:-delta]) @ camera_to_world[delta:])


def _still(points: np.ndarray, centered: np.ndarray) -> bool:
    return bool(np.abs(centered).max() <= _ROUNDING * np.abs(points).max())


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
            places = {name: index for index, name in enumerate(others)}
            return np.array([(index, places[name]) for index, name in enumerate(names) if name in common]), ""
    return _NO_PAIRS, "no name in common"


def _by_time(first: Trajectory, second: Trajectory, tolerance: float) -> _Pairs:
    if first.timestamps is None or second.timestamps is None:
        return _NO_PAIRS, "not both have timestamps"
    if any(len(np.unique(times)) < len(times) for times in (first.timestamps, second.timestamps)):
        return _NO_PAIRS, "timestamps are repeated"
    # All pairs within the tolerance, by binary search; then the nearest first, each frame once.
    order = np.argsort(second.timestamps, kind="stable")
    times = second.timestamps[order]
    low = np.searchsorted(times, first.timestamps - tolerance, side="left")
    high = np.searchsorted(times, first.timestamps + tolerance, side="right")
    candidates = [
        (abs(first.timestamps[index] - times[place]), index, int(order[place]))
        for index in range(len(first))
        for place in range(low[index], high[index])
    ]
    taken_first: set[int] = set()
    taken_second: set[int] = set()
    pairs = []
    for _, index, other in sorted(candidates):
        if index not in taken_first and other not in taken_second:
            taken_first.add(index)
            taken_second.add(other)
            pairs.append((index, other))
    return np.array(pairs, np.int64).reshape(-1, 2), f"{len(pairs)} within {tolerance:g} s"


def _by_index(first: Trajectory, second: Trajectory, tolerance: float) -> _Pairs:
    if len(first) != len(second):
        return _NO_PAIRS, f"{len(first)} and {len(second)} poses"
    return np.repeat(np.arange(len(first))[:, None], 2, axis=1), ""


def _by_training_frame(first: Trajectory, second: Trajectory, tolerance: float) -> _Pairs:
    indices = image_indices(len(first), len(second))
    if indices is None or len(first) == len(second):
        return _NO_PAIRS, f"{len(first)} poses are not the training frames of {len(second)}"
    return np.column_stack([np.arange(len(first)), indices]), ""


_ASSOCIATIONS = {
    "name": _by_name,
    "time": _by_time,
    "index": _by_index,
    "endogslam-train": _by_training_frame,
}


def _stem(name: str) -> str:
    return PurePosixPath(name.replace("\\", "/")).stem
