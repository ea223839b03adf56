"""Matching of the frames of two trajectories, and evaluation of one against the other: ATE, rotation error, RPE.

Absolute trajectory error and relative pose error: J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM
systems", IROS 2012. Transforms: S. Umeyama, "Least-squares estimation of transformation parameters between two point
patterns", IEEE TPAMI 13(4), 1991. Chordal mean: R. Hartley et al., "Rotation averaging", International Journal of
Computer Vision 103, 2013.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import PurePosixPath
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from coliags_plugin.core.errors import InputError
from coliags_plugin.geometry.poses.endogslam import image_indices
from coliags_plugin.geometry.poses.rigid import FLIP_Y_AND_Z, inverse, rigid, rotation_angles_deg, w_first
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
        "The counts are those of EndoGSLAM's training frames: pass `match=endogslam-train`"
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


def _stem(name: str) -> str:
    return PurePosixPath(name.replace("\\", "/")).stem


#: Least ratio of the paths' extents (standard deviations) across and along their main direction for which the rotation
#: about that direction is determined.
OFF_LINE_SHARE = 1e-3
#: Extents below this share of the coordinates are rounding errors.
_ROUNDING = 1e-9
#: Spread of a path (:attr:`Similarity.spread`) below which it is nearly straight: the rotation about it is taken from
#: orientations, as errors of positions are a large part of what little they deviate from a line.
NEARLY_STRAIGHT = 0.1

By = Literal["positions", "orientations about the path", "orientations"]


@dataclass(frozen=True, eq=False)
class Similarity:
    """x -> scale * rotation @ x + translation."""

    scale: float  # 1 for a rigid transform
    rotation: Float[np.ndarray, "3 3"]  # rotation matrix, det 1
    translation: Float[np.ndarray, "3"]  # units of the target
    # Why the points do not determine the rotation, or an empty string. The rotation is then the smallest among those
    # that fit equally well.
    undetermined: str = ""
    # Main direction of the target's points, unit length; zero where they do not determine one
    axis: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    # Extent of the points across that direction relative to that along it (standard deviations), 0 to 1.
    spread: float = 1.0

    def points(self, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
        """Transformed points. [N, 3]"""
        return self.scale * points @ self.rotation.T + self.translation


def umeyama(source: Float[np.ndarray, "N 3"], target: Float[np.ndarray, "N 3"], with_scale: bool = False) -> Similarity:
    """Least-squares rigid or similarity transform between corresponding points (Umeyama's method).

    The rotation is unique only if d2 + s d3 > 0, with d1 >= d2 >= d3 the singular values of the covariance and s the
    sign of its determinant (Umeyama 1991, section III). Otherwise, as for points on a line, the smallest rotation that
    fits is returned, and :attr:`Similarity.undetermined` gives the reason.
    """
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    centered, wanted = source - source_mean, target - target_mean
    covariance = wanted.T @ centered / len(source)
    left, values, right = np.linalg.svd(covariance)
    sign = 1.0 if np.linalg.det(left) * np.linalg.det(right) > 0.0 else -1.0
    still = _still(source, centered) or _still(target, wanted)
    rotation = left @ np.diag([1.0, 1.0, sign]) @ right
    undetermined, axis = "", left[:, 0]
    if still or values[0] <= _ROUNDING * np.sqrt((centered**2).sum() * (wanted**2).sum()) / len(source):
        rotation, axis = np.eye(3), np.zeros(3)
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
                "Align without `scale`",
            )
        scale = float((values * (1.0, 1.0, sign)).sum() / (centered**2).sum(axis=1).mean())
    spread = float(np.sqrt(max(values[1] + sign * values[2], 0.0) / values[0])) if axis.any() else 0.0
    translation = target_mean - scale * rotation @ source_mean
    return Similarity(scale, rotation, translation, undetermined, axis, spread)


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


def _still(points: np.ndarray, centered: np.ndarray) -> bool:
    return bool(np.abs(centered).max() <= _ROUNDING * np.abs(points).max())


@dataclass(frozen=True, eq=False)
class WorldRotation:
    """Rotation from the estimate's world to the reference's, with which rotation errors are computed."""

    rotation: Float[np.ndarray, "3 3"]  # rotation matrix, det 1
    # What determined it. ``positions``: those alone. ``orientations about the path``: positions determined the
    # direction of the path, the cameras' orientations the rotation about it. ``orientations``: those alone.
    by: By
    reason: str = ""  # why positions alone did not, or an empty string


def world_rotation(
    estimated: Float[np.ndarray, "N 3 3"], true: Float[np.ndarray, "N 3 3"], transform: Similarity
) -> WorldRotation:
    """The rotation between two worlds, of the camera-to-world rotations of the same cameras in both.

    The rotation of ``transform``, from positions, if the path is not nearly straight; else that rotation, turned about
    the path by the angle that minimises the chordal distances of the orientations; and without any path the chordal
    mean of the relative orientations.
    """
    total = np.einsum("nij,nkj->ik", true, estimated)
    if not transform.axis.any():
        return WorldRotation(_nearest_rotation(total), "orientations", transform.undetermined)
    if transform.spread >= NEARLY_STRAIGHT:
        return WorldRotation(transform.rotation, "positions")
    # tr(R(angle)^T M) = constant + cos(angle) (tr M - a^T M a) + sin(angle) a . w, with w the antisymmetric part of M.
    rest, axis = total @ transform.rotation.T, transform.axis
    antisymmetric = np.array([rest[2, 1] - rest[1, 2], rest[0, 2] - rest[2, 0], rest[1, 0] - rest[0, 1]])
    angle = np.arctan2(axis @ antisymmetric, np.trace(rest) - axis @ rest @ axis)
    about = Rotation.from_rotvec(angle * axis).as_matrix()
    reason = transform.undetermined or (
        f"the path is nearly straight: its extent across is {100.0 * transform.spread:.2g} % of that along it"
    )
    return WorldRotation(about @ transform.rotation, "orientations about the path", reason)


def _nearest_rotation(matrix: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation with the largest tr(R^T M)."""
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right)


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
    # Rotation between the worlds for the rotation error; that of ``transform`` unless the path is nearly straight.
    world_rotation: WorldRotation
    with_scale: bool  # whether the scale was estimated
    # The estimate after alignment, camera-to-world: positions by ``transform``, orientations by ``world_rotation``.
    estimate: Float[np.ndarray, "M 4 4"]
    reference: Float[np.ndarray, "M 4 4"]  # the reference, camera-to-world
    delta: int  # matched frames between the two poses of a relative error
    position_errors: Float[np.ndarray, "M"]  # distance of the centres, units of the reference as all lengths here
    rotation_errors_deg: Float[np.ndarray, "M"]  # angle between the cameras
    # RPE, P = M - delta.
    relative_translation_errors: Float[np.ndarray, "P"]
    relative_rotation_errors_deg: Float[np.ndarray, "P"]

    @property
    def ate(self) -> ErrorStatistics:
        """Absolute trajectory error, units of the reference."""
        return ErrorStatistics.of(self.position_errors)

    @property
    def path_length(self) -> float:
        """Length of the reference's path over the matched frames, units of the reference."""
        return float(np.linalg.norm(np.diff(self.reference[:, :3, 3], axis=0), axis=1).sum())

    @property
    def ate_share(self) -> float | None:
        """RMSE of the absolute trajectory error relative to the length of the path; None where there is no path."""
        length = self.path_length
        return self.ate.rmse / length if length > 0.0 else None

    @property
    def rotation_deg(self) -> ErrorStatistics:
        """Rotation error after alignment, degrees."""
        return ErrorStatistics.of(self.rotation_errors_deg)

    @property
    def rpe_translation(self) -> ErrorStatistics:
        """Translation part of the relative pose error, units of the reference."""
        return ErrorStatistics.of(self.relative_translation_errors)

    @property
    def rpe_rotation_deg(self) -> ErrorStatistics:
        """Rotation part of the relative pose error, degrees."""
        return ErrorStatistics.of(self.relative_rotation_errors_deg)

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
            "rotation_deg": vars(self.rotation_deg),
            "world_rotation": vars(self.world_rotation) | {"rotation": self.world_rotation.rotation.tolist()},
            "rpe_delta_frames": self.delta,
            "rpe_translation": vars(self.rpe_translation),
            "rpe_rotation_deg": vars(self.rpe_rotation_deg),
            "frames": {
                "estimate": self.matches.first.tolist(),
                "reference": self.matches.second.tolist(),
                "position_error": self.position_errors.tolist(),
                "rotation_error_deg": self.rotation_errors_deg.tolist(),
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
    rotation = world_rotation(estimated[:, :3, :3], true[:, :3, :3], transform)
    aligned = rigid(rotation.rotation @ estimated[:, :3, :3], transform.points(estimated[:, :3, 3]))
    # Relative motions in the camera frame: world frames cancel, the scale does not.
    difference = inverse(_motion(true, delta)) @ _motion(aligned, delta)
    return Alignment(
        matches=matches,
        transform=transform,
        world_rotation=rotation,
        with_scale=with_scale,
        estimate=aligned,
        reference=true,
        delta=delta,
        position_errors=np.linalg.norm(aligned[:, :3, 3] - true[:, :3, 3], axis=1),
        rotation_errors_deg=rotation_angles_deg(true[:, :3, :3].transpose(0, 2, 1) @ aligned[:, :3, :3]),
        relative_translation_errors=np.linalg.norm(difference[:, :3, 3], axis=1),
        relative_rotation_errors_deg=rotation_angles_deg(difference[:, :3, :3]),
    )


#: Other readings of poses, by what these are in them.
_READINGS: Mapping[str, Callable[[np.ndarray], np.ndarray]] = {
    "quaternions with w first": w_first,
    "camera axes y up, z backward": lambda poses: poses @ FLIP_Y_AND_Z,
    "world-to-camera": inverse,
}
#: Rotation error from which on others are tried, degrees; and the share of it that another must leave at most.
_SUSPICIOUS_DEG, _CLEARLY_BETTER = 15.0, 0.3


def better_reading(estimate: Trajectory, reference: Trajectory, result: Alignment) -> str:
    """Name another pose convention of one trajectory that explains the rotation error; empty if there is none."""
    errors: dict[str, float] = {}
    for name, change in _READINGS.items() if result.rotation_deg.rmse > _SUSPICIOUS_DEG else ():
        for which, pair in (
            ("estimate", (_changed(estimate, change), reference)),
            ("reference", (estimate, _changed(reference, change))),
        ):
            with suppress(InputError):  # a camera that does not move, in that reading
                found = align(*pair, result.matches, result.with_scale, result.delta).rotation_deg.rmse
                errors[f"the poses of the {which} are read as {name}, the rotation error is {found:.3g} deg"] = found
    best = min(errors, key=lambda text: errors[text], default="")
    return best if best and errors[best] < _CLEARLY_BETTER * result.rotation_deg.rmse else ""


def _changed(trajectory: Trajectory, change: Callable[[np.ndarray], np.ndarray]) -> Trajectory:
    return replace(trajectory, camera_to_world=change(trajectory.camera_to_world))


def _motion(camera_to_world: np.ndarray, delta: int) -> np.ndarray:
    return np.asarray(inverse(camera_to_world[:-delta]) @ camera_to_world[delta:])
