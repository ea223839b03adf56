"""Sub-maps of a video: models of the stretches in which the camera can be followed, and what is known between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int

from coliags_plugin.reconstruction.structure.point_tracks import FramePoints
from coliags_plugin.reconstruction.structure.video import TEST_EVERY

if TYPE_CHECKING:
    import pycolmap

#: Points seen on both sides of a frame gap below which a model's two sides have to prove that they fit together.
_STRONG_LINK = 30
#: Points below which the two sides are never taken to hold together.
_FEWEST_LINKING = 8
#: Fewest points triangulated from either side alone that tell how the scales of the sides compare, largest difference
#: of the scales, and largest uncertainty of it, as natural logarithms.
_FEWEST_COMMON, _SAME_SCALE, _LEAST_CERTAIN = 5, 0.25, 0.15
#: Smallest angle between rays at a point of which the depth counts, degrees.
_LEAST_ANGLE = 0.5


@dataclass(frozen=True)
class Link:
    """A weak place of a model: between two frames, few points are seen from both sides.

    ``log_scale`` is the natural logarithm of the ratio of the depths that either side gives by itself to the same
    points, and ``uncertainty`` its standard error; None where too few points can be compared.
    """

    after: int  # last frame before it
    points: int
    log_scale: float | None
    uncertainty: float | None

    @property
    def holds(self) -> bool:
        """Whether enough points link the sides and, as far as can be measured, both have the same scale."""
        if self.points < _FEWEST_LINKING or self.log_scale is None or self.uncertainty is None:
            return self.points >= _FEWEST_LINKING
        return abs(self.log_scale) < _SAME_SCALE and self.uncertainty < _LEAST_CERTAIN

    @property
    def reason(self) -> str:
        """Why it holds, or not, in words."""
        if self.log_scale is None:
            return f"{self.points} points are seen from both sides, too few to compare the scales of the sides"
        factor, spread = np.exp(self.log_scale), 100.0 * (self.uncertainty or 0.0)
        return f"{self.points} points seen from both sides; scales differ by a factor of {factor:.2f} +- {spread:.0f} %"


def weak_links(model: pycolmap.Reconstruction) -> list[Link]:
    """Places of a model, image i having ID i + 1, at which few points are seen from both sides."""
    frames = np.array(sorted(model.reg_image_ids()), np.int64) - 1
    points, first, last = _spans(model)
    links = []
    for after, before in zip(frames[:-1].tolist(), frames[1:].tolist(), strict=True):
        common = np.flatnonzero((first <= after) & (last >= before))
        if len(common) < _STRONG_LINK:
            links.append(_measured(model, after, points[common].tolist()))
    return links


def _spans(
    model: pycolmap.Reconstruction,
) -> tuple[Int[np.ndarray, "N"], Int[np.ndarray, "N"], Int[np.ndarray, "N"]]:
    """IDs of the points, ascending, and the first and last frame of each."""
    points = sorted(model.points3D)
    seen = [[element.image_id for element in model.points3D[point].track.elements] for point in points]
    return np.array(points), np.array([min(ids) for ids in seen]) - 1, np.array([max(ids) for ids in seen]) - 1


def _measured(model: pycolmap.Reconstruction, after: int, common: Sequence[int]) -> Link:
    """The link by points seen from both sides, with the ratio of their depths triangulated from either side alone."""
    ratios = []
    for point in common:
        sides: tuple[list[Any], list[Any]] = ([], [])
        for element in model.points3D[point].track.elements:
            sides[element.image_id - 1 > after].append(_ray(model, element.image_id, element.point2D_idx))
        positions = [_triangulated(side) for side in sides]
        if positions[0] is None or positions[1] is None:
            continue
        origin = sides[0][-1][0]
        ratios.append(float(np.log(np.linalg.norm(positions[1] - origin) / np.linalg.norm(positions[0] - origin))))
    if len(ratios) < _FEWEST_COMMON:
        return Link(after, len(common), None, None)
    middle = float(np.median(ratios))
    spread = 1.4826 * float(np.median(np.abs(np.array(ratios) - middle)))
    return Link(after, len(common), middle, max(spread, 0.02) / np.sqrt(len(ratios)))


def _ray(
    model: pycolmap.Reconstruction, image_id: int, index: int
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Camera centre and direction of an observation, world, unit length."""
    image = model.images[image_id]
    x, y = image.camera.cam_from_img(image.points2D[index].xy)
    direction = image.cam_from_world().rotation.matrix().T @ np.array([x, y, 1.0])
    return np.asarray(image.projection_center()), direction / np.linalg.norm(direction)


def _triangulated(rays: Sequence[tuple[np.ndarray, np.ndarray]]) -> Float[np.ndarray, "3"] | None:
    """The point nearest to two or more rays; None where they are nearly parallel or it lies behind a camera."""
    if len(rays) < 2:
        return None
    centers, directions = (np.array(column) for column in zip(*rays, strict=True))
    if np.degrees(np.arccos(np.clip(directions @ directions.T, -1.0, 1.0))).max() < _LEAST_ANGLE:
        return None
    projectors = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    point = np.linalg.solve(projectors.sum(axis=0), np.einsum("nij,nj->i", projectors, centers))
    return point if (np.einsum("ni,ni->n", point - centers, directions) > 0.0).all() else None


def part_of(model: pycolmap.Reconstruction, frames: Sequence[int]) -> pycolmap.Reconstruction:
    """The model with some of its frames alone, image i having ID i + 1, and with the points that two of them see."""
    import pycolmap

    part = pycolmap.Reconstruction(model)
    kept = {frame + 1 for frame in frames}
    for number in sorted(model.reg_image_ids()):
        if number not in kept:
            part.deregister_frame(part.images[number].frame_id)
    for point in [number for number, point in part.points3D.items() if point.track.length() < 2]:
        part.delete_point3D(point)
    return part


def held_out_error(model: pycolmap.Reconstruction, tracks: Sequence[FramePoints]) -> float | None:
    """Median distance of tracks that mapping has not used from where the model sees them, pixels; None without any.

    Each is triangulated from three or more frames of the model; its error is the median over these.
    """
    rays: dict[int, list[Any]] = {}
    for number in sorted(model.reg_image_ids()):
        frame, image = tracks[number - 1], model.images[number]
        test = frame.ids % TEST_EVERY == 0
        local = np.asarray(image.camera.cam_from_img(frame.pixels[test].astype(np.float64))).reshape(-1, 2)
        rays_here = np.concatenate([local, np.ones((len(local), 1))], axis=1)
        directions = rays_here @ image.cam_from_world().rotation.matrix()
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        for track, direction in zip(frame.ids[test].tolist(), directions, strict=True):
            rays.setdefault(track, []).append((np.asarray(image.projection_center()), direction))
    focal_length = next(iter(model.cameras.values())).mean_focal_length()
    errors = []
    for observations in rays.values():
        point = _triangulated(observations) if len(observations) >= 3 else None
        if point is None:
            continue
        offsets = np.array([point - center for center, _ in observations])
        directions = np.array([direction for _, direction in observations])
        angles = np.arctan2(np.linalg.norm(np.cross(offsets, directions), axis=1), (offsets * directions).sum(axis=1))
        errors.append(float(np.median(angles)) * focal_length)
    return float(np.median(errors)) if errors else None
