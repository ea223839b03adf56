"""Points of tracks, triangulated from the poses of a model and adjusted with them; errors and rigidity by tracks.

Mapping keeps the points of which it is sure. Here every track that its rays agree on takes part, those at small angles
too, which tell the rotations, and each frame is held by two to three times as many points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Int, Int64

from coliags_plugin.reconstruction.structure.mapping import solve_bundle
from coliags_plugin.reconstruction.structure.point_tracks import FramePoints, shared_tracks

if TYPE_CHECKING:
    import pycolmap

#: Of so many tracks one is kept for the test of the poses, and fewest frames of such a track.
TEST_EVERY, _FEWEST_FRAMES = 5, 3
#: Smallest angle between the rays of a point that is adjusted, and of one that tests the poses, degrees.
_LEAST_ANGLE, _LEAST_TEST_ANGLE = 0.4, 0.5
#: Largest error of an observation that is adjusted, pixels: first, while poses are those of mapping, and then.
_MAX_ERRORS = (20.0, 6.0)
#: Error at which Cauchy's cost turns from squared to logarithmic, pixels.
_SCALE = 1.0
#: Steps of the triangulation's iteration, and of the adjustment's.
_STEPS, _ADJUSTMENT_STEPS = 8, 30


@dataclass(frozen=True, eq=False)
class Rays:
    """Viewing rays of the observations of N tracks in the posed frames of a model, sorted by track."""

    ids: Int64[np.ndarray, "N"]  # of the tracks
    tracks: Int[np.ndarray, "K"]  # which of the tracks
    images: Int[np.ndarray, "K"]  # image IDs
    rows: Int[np.ndarray, "K"]  # which of the points of the image
    pixels: Float[np.ndarray, "K 2"]
    centers: Float[np.ndarray, "K 3"]  # of the cameras, world
    directions: Float[np.ndarray, "K 3"]  # world, unit length

    @classmethod
    def of(cls, model: pycolmap.Reconstruction, ids: Sequence[Int64[np.ndarray, "P"]], pixels: Sequence[Any]) -> Rays:
        """Observations in the frames of the model; image i has ID i + 1, and its tracks and pixels are given at i."""
        parts = []
        for number in sorted(model.reg_image_ids()):
            image, here = model.images[number], np.asarray(pixels[number - 1], np.float64).reshape(-1, 2)
            local = np.asarray(image.camera.cam_from_img(here)).reshape(-1, 2)
            directions = np.concatenate([local, np.ones((len(local), 1))], axis=1)
            directions = directions @ image.cam_from_world().rotation.matrix()
            directions /= np.linalg.norm(directions, axis=1, keepdims=True)
            centers = np.tile(np.asarray(image.projection_center()), (len(local), 1))
            count = len(local)
            parts.append((ids[number - 1], np.full(count, number), np.arange(count), here, centers, directions))
        every, *columns = (np.concatenate(column) for column in zip(*parts, strict=True))
        order = np.argsort(every, kind="stable")
        tracked_ids, tracks = np.unique(every[order], return_inverse=True)
        return cls(tracked_ids, tracks, *(column[order] for column in columns))

    @classmethod
    def of_points(cls, model: pycolmap.Reconstruction) -> Rays:
        """Observations of the model's points, by their IDs."""
        ids: list[Any] = [None] * max(model.images)
        pixels = ids.copy()
        for number in model.reg_image_ids():
            observed = list(model.images[number].get_observation_points2D())
            ids[number - 1] = np.array([point.point3D_id for point in observed], np.int64)
            pixels[number - 1] = [point.xy for point in observed]
        return cls.of(model, ids, pixels)

    def only(self, is_kept: Bool[np.ndarray, "K"], fewest: int) -> Rays:
        """Subset of the observations, of tracks that keep ``fewest`` or more."""
        lengths = np.bincount(self.tracks, is_kept, len(self.ids))
        is_kept = is_kept & (lengths >= fewest)[self.tracks]
        number = np.cumsum(lengths >= fewest) - 1
        rows = (self.images, self.rows, self.pixels, self.centers, self.directions)
        return Rays(self.ids[lengths >= fewest], number[self.tracks[is_kept]], *(column[is_kept] for column in rows))

    @cached_property
    def starts(self) -> Int[np.ndarray, "N"]:
        """The first observation of each track."""
        return np.searchsorted(self.tracks, np.arange(len(self.ids)))

    @cached_property
    def spans(self) -> tuple[Int[np.ndarray, "N"], Int[np.ndarray, "N"]]:
        """The smallest and the largest image ID that sees each track."""
        first, last = (extreme.reduceat(self.images, self.starts) for extreme in (np.minimum, np.maximum))
        return first, last

    def sums(self, values: Float[np.ndarray, "K ..."]) -> Float[np.ndarray, "N ..."]:
        """Sums over the observations of each track."""
        return np.asarray(np.add.reduceat(values, self.starts)) if len(self.ids) else values[:0]

    def triangulated(self) -> Float[np.ndarray, "N 3"]:
        """The point of each track at the least angles to its rays, world; NaN where it is not in front of all cameras.

        From the point nearest to the rays, by Levenberg and Marquardt's method.
        """
        across = np.eye(3) - self.directions[:, :, None] * self.directions[:, None, :]
        normal = self.sums(across) + 1e-9 * np.eye(3)
        points = _solved(normal, self.sums(np.einsum("kij,kj->ki", across, self.centers)))
        damping = np.full(len(points), 1e-3)
        away, inverse_lengths = self._away(points)
        cost = self.sums(((away - self.directions) ** 2).sum(axis=1))
        for _ in range(_STEPS):
            slopes = (np.eye(3) - away[:, :, None] * away[:, None, :]) * inverse_lengths[:, None, None]
            normal = self.sums(np.einsum("kij,kil->kjl", slopes, slopes))
            normal += (damping[:, None] * np.einsum("nii->ni", normal) + 1e-15)[:, :, None] * np.eye(3)
            pull = self.sums(np.einsum("kij,ki->kj", slopes, away - self.directions))
            tried = points - _solved(normal, pull)
            tried_away, tried_lengths = self._away(tried)
            tried_cost = self.sums(((tried_away - self.directions) ** 2).sum(axis=1))
            better = tried_cost < cost
            points[better], cost[better] = tried[better], tried_cost[better]
            moved = better[self.tracks]
            away[moved], inverse_lengths[moved] = tried_away[moved], tried_lengths[moved]
            damping *= np.where(better, 0.1, 10.0)
        behind = (away * self.directions).sum(axis=1) <= 0.0
        points[self.tracks[behind]] = np.nan
        return points

    def angles(self, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N"]:
        """Upper bound of the widest angle between the lines from a point to its cameras, degrees.

        It is twice the largest angle to their mean; NaN at a NaN point.
        """
        mean, widest = np.zeros((len(self.ids), 3)), np.zeros(len(self.ids))
        with np.errstate(invalid="ignore"):
            away, _ = self._away(points)
            np.add.at(mean, self.tracks, away)
            mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
            np.maximum.at(widest, self.tracks, np.linalg.norm(np.cross(away, mean[self.tracks]), axis=1))
            return np.asarray(np.degrees(2.0 * np.arcsin(np.minimum(widest, 1.0))))

    def errors(self, model: pycolmap.Reconstruction, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "K"]:
        """Reprojection errors of the observations, pixels; infinite behind the camera."""
        errors = np.full(len(self.tracks), np.inf)
        for number in np.unique(self.images).tolist():
            here, image = np.flatnonzero(self.images == number), model.images[number]
            pose = image.cam_from_world().matrix()
            local = points[self.tracks[here]] @ pose[:, :3].T + pose[:, 3]
            front = local[:, 2] > 0.0
            projected = np.asarray(image.camera.img_from_cam(local[front])).reshape(-1, 2)
            errors[here[front]] = np.linalg.norm(projected - self.pixels[here[front]], axis=1)
        return errors

    def _away(self, points: Float[np.ndarray, "N 3"]) -> tuple[Float[np.ndarray, "K 3"], Float[np.ndarray, "K"]]:
        """Directions from the cameras to the points, and one over their distances."""
        offsets = points[self.tracks] - self.centers
        inverse_lengths = 1.0 / np.maximum(np.linalg.norm(offsets, axis=1), 1e-12)
        return offsets * inverse_lengths[:, None], inverse_lengths


def _solved(matrices: Float[np.ndarray, "N 3 3"], vectors: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    return np.asarray(np.linalg.solve(matrices, vectors[..., None])[..., 0])


def held_out_error(
    model: pycolmap.Reconstruction, tracks: Sequence[FramePoints], least_angle: float = _LEAST_TEST_ANGLE
) -> float | None:
    """Median reprojection error of tracks that mapping has not used, pixels; None without any.

    Each is triangulated from three or more frames of the model; its error is the median over these. Those at rays
    within ``least_angle``, degrees, do not count.
    """
    rays = Rays.of(model, [frame.ids for frame in tracks], [frame.pixels for frame in tracks])
    rays = rays.only((rays.ids % TEST_EVERY == 0)[rays.tracks], _FEWEST_FRAMES)
    points = rays.triangulated()
    counted = rays.angles(points) >= least_angle  # not NaN
    if not counted.any():
        return None
    return float(np.median(median_of_points(rays.errors(model, points), rays.tracks, len(rays.ids))[counted]))


def adjust(model: pycolmap.Reconstruction, ids: Sequence[Int64[np.ndarray, "P"]]) -> None:
    """Triangulate all tracks again and adjust them with the poses, twice, in place.

    ``ids`` are the tracks of the points2D of each image; image i has ID i + 1.
    """
    import pycolmap

    for max_error in _MAX_ERRORS:
        _triangulate(model, ids, max_error)
        solve_bundle(model, refine_camera=False, robust_scale=_SCALE, max_iterations=_ADJUSTMENT_STEPS)
    pycolmap.ObservationManager(model).filter_all_points3D(_MAX_ERRORS[-1], _LEAST_ANGLE)
    model.update_point_3d_errors()


def _triangulate(model: pycolmap.Reconstruction, ids: Sequence[Int64[np.ndarray, "P"]], max_error: float) -> None:
    """Replace a model's points by triangulated tracks with two or more observations within ``max_error``, pixels."""
    import pycolmap

    for number in list(model.points3D):
        model.delete_point3D(number)
    pixels: list[Any] = [None] * len(ids)
    for number in model.reg_image_ids():
        pixels[number - 1] = [point.xy for point in model.images[number].points2D]
    rays = Rays.of(model, ids, pixels)
    rays = rays.only(np.ones(len(rays.tracks), bool), 2)
    points = rays.triangulated()
    fits: Bool[np.ndarray, "K"] = rays.errors(model, points) <= max_error
    lengths = np.bincount(rays.tracks, fits, len(rays.ids))
    is_kept = (lengths >= 2) & (rays.angles(points) >= _LEAST_ANGLE)
    black = np.zeros(3, np.uint8)
    starts = np.append(rays.starts, len(rays.tracks))
    for index in np.flatnonzero(is_kept).tolist():
        track = pycolmap.Track()
        for row in range(starts[index], starts[index + 1]):
            if fits[row]:
                track.add_element(int(rays.images[row]), int(rays.rows[row]))
        model.add_point3D(points[index], track, black)


def median_of_points(
    values: Float[np.ndarray, "K"], points: Int[np.ndarray, "K"], count: int
) -> Float[np.ndarray, "N"]:
    """Lower median of each point's observations that are not NaN; 0 for a point without any."""
    is_known = ~np.isnan(values)
    values, points = values[is_known], points[is_known]
    order = np.lexsort((values, points))
    counts = np.bincount(points, minlength=count)
    middle = np.cumsum(counts) - counts + np.maximum(counts - 1, 0) // 2
    medians = np.zeros(count)
    medians[counts > 0] = values[order][middle[counts > 0]]
    return medians


#: Numbers of frames apart, most pairs of frames of each, and fewest, below which nothing is said.
_APART, _MOST_PAIRS, _FEWEST_PAIRS = (1, 2, 4, 8, 12, 16, 24, 32), 24, 4
#: Fewest tracks of a pair, and its tangents of angles to the axis up to which they count: farther out pixels stretch.
_FEWEST, _WIDEST = 40, 1.2
#: RANSAC inlier threshold, radians, and each so many of the tracks is kept from the fit and measured.
_MAX_ERROR, _TESTED = 0.01, 3
#: Residual beyond which a rigid model averages motion, times that of neighbours, and at least, radians: on a rigid
#: wall that is hard to track it stays below the second (docs/poses.md 9.4).
_LIMIT, _LEAST_LIMIT = 3.0, 0.007


def rigidity(model: pycolmap.Reconstruction, tracks: Sequence[FramePoints]) -> dict[int, float]:
    """Residual of the best rigid motion, pixels, by the number of frames that two frames of a model are apart.

    For pairs of frames spread over the model, an essential matrix is fitted to two thirds of their common tracks,
    whatever their poses; of the other third the median distance from its epipolar lines is taken, and of this the
    median over the pairs. Noise of the tracks alone grows slowly with the distance; a wall that moves adds to it.
    Distances over which fewer than four pairs have 40 tracks in common are left out. Image i has ID i + 1.
    """
    frames = sorted(number - 1 for number in model.reg_image_ids())
    if not frames:
        return {}
    camera = model.images[frames[0] + 1].camera
    directions = {frame: np.asarray(camera.cam_from_img(tracks[frame].pixels.astype(np.float64))) for frame in frames}
    measured = {}
    for apart in _APART:
        pairs = [(first, first + apart) for first in frames if first + apart in directions]
        values = []
        for first, second in pairs[:: 1 + len(pairs) // _MOST_PAIRS]:
            rows, partner_rows = shared_tracks(tracks[first], tracks[second]).T
            value = _residual(directions[first][rows], directions[second][partner_rows])
            values += [] if value is None else [value]
        if len(values) >= _FEWEST_PAIRS:
            measured[apart] = float(np.median(values)) * camera.mean_focal_length()
    return measured


def rigid_frames(model: pycolmap.Reconstruction, tracks: Sequence[FramePoints]) -> int | None:
    """Largest number of consecutive frames for which a model's scene counts as rigid; None: no limit.

    No frame is farther from the middle one than residuals take to reach three times that of neighbours and 0.007 of
    the focal length.
    """
    residuals = sorted(rigidity(model, tracks).items())
    for (near, below), (far, value) in pairwise(residuals):
        focal_length = next(iter(model.cameras.values())).mean_focal_length()
        limit = max(_LIMIT * residuals[0][1], _LEAST_LIMIT * focal_length)
        if value > limit:
            return 1 + 2 * int(near + (far - near) * max(0.0, limit - below) / (value - below))
    return None


def _residual(first: Float[np.ndarray, "K 2"], second: Float[np.ndarray, "K 2"]) -> float | None:
    """Median epipolar distance of a third of the tracks from the geometry of the others, tangents; None for too few."""
    import cv2

    inside = (np.linalg.norm(first, axis=1) < _WIDEST) & (np.linalg.norm(second, axis=1) < _WIDEST)
    homogeneous, partners = (np.column_stack([points[inside], np.ones(inside.sum())]) for points in (first, second))
    if len(homogeneous) < _FEWEST:
        return None
    tested = np.arange(len(homogeneous)) % _TESTED == 0
    fitted = homogeneous[~tested, :2], partners[~tested, :2]
    essential, _ = cv2.findEssentialMat(*fitted, np.eye(3), cv2.RANSAC, 0.999, _MAX_ERROR)
    if essential is None:
        return None
    lines, back = homogeneous[tested] @ essential[:3].T, partners[tested] @ essential[:3]
    slopes = np.hypot(np.linalg.norm(lines[:, :2], axis=1), np.linalg.norm(back[:, :2], axis=1))
    return float(np.median(np.abs((partners[tested] * lines).sum(axis=1)) / np.maximum(slopes, 1e-12)))
