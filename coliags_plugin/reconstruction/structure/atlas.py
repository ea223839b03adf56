"""Sub-maps of a video: models of the stretches in which the camera can be followed, and what is known between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Int64
from scipy.spatial.transform import Rotation

from coliags_plugin.reconstruction.structure.adjustment import Rays
from coliags_plugin.reconstruction.structure.mapping import depths_of

if TYPE_CHECKING:
    import pycolmap

#: Points seen on both sides of a frame gap below which a model's two sides have to prove that they fit together; and
#: points seen from three frames or farther on both sides, as only these carry the scale across a turn: below the first
#: number they have to prove it, below the second they do not fit where nothing can be measured.
_STRONG_LINK, _SPANNING, _FEWEST_SPANNING = 30, 20, 4
_REACH = 3
#: Points below which the two sides are never taken to hold together, and below which they are not unless their scales
#: can be compared: across a cut to another patient, eight tracks fit by chance.
_FEWEST_LINKING, _FEWEST_ALONE = 8, 20
#: Fewest points triangulated from either side alone that tell how the scales of the sides compare, largest difference
#: of the scales, and largest uncertainty of it, as natural logarithms.
_FEWEST_COMMON, _SAME_SCALE, _LEAST_CERTAIN = 5, 0.25, 0.15
#: Scales of the sides of a place, as natural logarithms, and standard errors of this, from which they contradict each
#: other although many points link them; frames over which such places are one; and points that are compared.
_OTHER_SIZE, _SURE, _ONE_PLACE, _COMPARED = 0.6, 3.0, 6, 120
#: Points of a model that one of its images sees at least, and factor by which their median depth differs at most from
#: that of the median image.
_FEWEST_SEEN, _OTHER_SCALE = 15, 20.0
#: Turn of an image from those before and after it beyond which its pose is not believed, degrees, if these differ by
#: less than half of it: no camera turns so far and back in one frame.
_LEAP = 30.0
#: Smallest angle between rays at a point of which the depth counts, degrees.
_LEAST_ANGLE = 0.5


@dataclass(frozen=True)
class Again:
    """Record that the wall seen before a place was found again after it.

    ``similarity``, where the models were not made one, leads from the world of the later to that of the earlier one:
    three rows of scale times rotation, and translation.
    """

    before: int  # first frame of the stretch that shows it again
    agreeing: int  # comparisons of frames that tell the same similarity
    spread: float  # standard deviation of the natural logarithm of its scale
    similarity: tuple[tuple[float, ...], ...] | None = None


@dataclass(frozen=True)
class Link:
    """Link between the frames before and after a weak, joined or split place of a model.

    ``log_scale`` is the natural logarithm of the ratio of the depths that either side gives by itself to the same
    points, and ``uncertainty`` its standard error; None where too few points can be compared.
    """

    after: int  # last frame before it
    points: int
    log_scale: float | None
    uncertainty: float | None
    spanning: int | None = None  # of them seen from three frames or farther on both sides; None: not mapped together
    again: Again | None = None
    moves: bool = False  # what is seen moves too far for one rigid model of both sides

    @property
    def holds(self) -> bool:
        """True if enough points link the sides and, as far as can be measured, both have the same scale."""
        if self.log_scale is None or self.uncertainty is None:
            return self.points >= _FEWEST_ALONE and (self.spanning or 0) >= _FEWEST_SPANNING
        return (
            self.points >= _FEWEST_LINKING and abs(self.log_scale) < _SAME_SCALE and self.uncertainty < _LEAST_CERTAIN
        )

    @property
    def reason(self) -> str:
        """Reason for holding or not, as a sentence."""
        if self.moves:
            return f"what is seen moves too far for one rigid model; {self.points} points are seen from both sides"
        if self.again is not None:
            return (
                f"the wall is seen again from frame {self.again.before}: {self.again.agreeing} comparisons of frames "
                f"agree, in scale to {100.0 * self.again.spread:.0f} %"
            )
        if self.spanning is None and self.points >= _STRONG_LINK:
            return f"{self.points} points are followed across it, but the sides were not mapped together"
        if self.log_scale is None:
            few = "too few" if not self.spanning else f"{self.spanning} of them for long, too few"
            return f"{self.points} points are seen from both sides, {few} to compare the scales of the sides"
        factor, spread = np.exp(self.log_scale), 100.0 * (self.uncertainty or 0.0)
        return f"{self.points} points seen from both sides; scales differ by a factor of {factor:.2f} +- {spread:.0f} %"


def weak_links(model: pycolmap.Reconstruction) -> list[Link]:
    """Places of a model at which few points are observed on both sides; image i has ID i + 1.

    And those that do not hold, though many points are seen from both sides, as few of these are seen for long.
    """
    frames = np.array(sorted(model.reg_image_ids()), np.int64) - 1
    rays = Rays.of_points(model)
    links = [_link(rays, frames, after) for after in frames[:-1].tolist()]
    return [link for link in links if link.points < _STRONG_LINK or not link.holds]


def contradictions(model: pycolmap.Reconstruction, excluded: Sequence[Link] = ()) -> list[Link]:
    """Places at which many points link the sides of a model, but triangulate to very different depths from either side.

    A part of the model is too large or too small there. Of neighbouring places the worst, and none near those that are
    ``excluded``; image i has ID i + 1.
    """
    rays = Rays.of_points(model)
    first, last = rays.spans
    links: list[Link] = []
    for after in (number - 1 for number in sorted(model.reg_image_ids())[:-1]):
        common = np.flatnonzero((first <= after + 1) & (last > after + 1))
        compared = np.isin(rays.tracks, common[:: 1 + len(common) // _COMPARED])
        link = replace(_measured(rays.only(compared, 2), after), points=len(common))
        if link.log_scale is None or abs(link.log_scale) < max(_OTHER_SIZE, _SURE * (link.uncertainty or 0.0)):
            continue
        if any(abs(after - other.after) <= _ONE_PLACE for other in excluded):
            continue
        if links and after - links[-1].after <= _ONE_PLACE:
            link = max(links.pop(), link, key=lambda one: abs(one.log_scale or 0.0))
        links.append(link)
    return links


def link_at(model: pycolmap.Reconstruction, after: int) -> Link:
    """Link of a model after one of its frames; image i has ID i + 1."""
    frames = np.array(sorted(model.reg_image_ids()), np.int64) - 1
    return _link(Rays.of_points(model), frames, after, always_measured=True)


def _link(rays: Rays, frames: Int64[np.ndarray, "M"], after: int, always_measured: bool = False) -> Link:
    """Link after one of a model's frames; scales are compared where few points carry it, or always."""
    first, last = rays.spans
    common, place = (first <= after + 1) & (last > after + 1), int(np.searchsorted(frames, after))
    far = frames[max(0, place + 1 - _REACH)], frames[min(len(frames) - 1, place + _REACH)]
    spanning = int(((first <= far[0] + 1) & (last >= far[1] + 1)).sum())
    link = Link(after, int(common.sum()), None, None)
    if always_measured or link.points < _STRONG_LINK or spanning < _SPANNING:
        link = _measured(rays.only(common[rays.tracks], 2), after)
    return replace(link, spanning=spanning)


def _measured(rays: Rays, after: int) -> Link:
    """Link with the ratio of the depths to which common points triangulate from either side alone."""
    is_before = rays.images - 1 <= after
    if not len(rays.ids):
        return Link(after, 0, None, None)
    origin = rays.centers[np.argmax(np.where(is_before, rays.images, 0))]
    log_depths = np.full((2, len(rays.ids)), np.nan)
    for row, side in enumerate((is_before, ~is_before)):
        here = rays.only(side, 2)
        points = here.triangulated()
        depths = np.where(here.angles(points) >= _LEAST_ANGLE, np.linalg.norm(points - origin, axis=1), np.nan)
        log_depths[row, np.searchsorted(rays.ids, here.ids)] = np.log(depths)
    ratios = log_depths[1] - log_depths[0]
    ratios = ratios[~np.isnan(ratios)]
    if len(ratios) < _FEWEST_COMMON:
        return Link(after, len(rays.ids), None, None)
    middle = float(np.median(ratios))
    spread = 1.4826 * float(np.median(np.abs(ratios - middle)))
    return Link(after, len(rays.ids), middle, max(spread, 0.02) / np.sqrt(len(ratios)))


def part_of(model: pycolmap.Reconstruction, frames: Sequence[int]) -> pycolmap.Reconstruction:
    """Copy of a model with some of its frames and the points that two of these observe; image i has ID i + 1."""
    import pycolmap

    part = pycolmap.Reconstruction(model)
    numbers = {frame + 1 for frame in frames}
    for number in sorted(model.reg_image_ids()):
        if number not in numbers:
            part.deregister_frame(part.images[number].frame_id)
    for point in [number for number, point in part.points3D.items() if point.track.length() < 2]:
        part.delete_point3D(point)
    return part


def held_part(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """Model without images of implausible pose, itself if there are none; image i has ID i + 1.

    These see too few of its points, or points at a depth that is another by orders: a part whose scale nothing holds;
    or they are turned far from those before and after them, which agree.
    """
    while True:
        depths = {number: depth for number, (_, depth) in depths_of(model).items() if len(depth) >= _FEWEST_SEEN}
        medians = {number: float(np.median(depth)) for number, depth in depths.items()}
        middle = float(np.median(list(medians.values()))) if medians else 0.0
        leaps = _leaps(model)
        credible = [
            number
            for number, median in medians.items()
            if middle / _OTHER_SCALE <= median <= middle * _OTHER_SCALE and number not in leaps
        ]
        if len(credible) == model.num_reg_images():
            return model
        model = part_of(model, [number - 1 for number in credible])


def _leaps(model: pycolmap.Reconstruction) -> set[int]:
    """IDs of images turned by more than :data:`_LEAP` from those before and after, which differ by half at most."""
    numbers = sorted(model.reg_image_ids())
    if len(numbers) < 3:
        return set()
    poses = Rotation.from_matrix([model.images[number].cam_from_world().rotation.matrix() for number in numbers])
    before, after, across = (
        np.degrees((one * other.inv()).magnitude())
        for one, other in ((poses[:-2], poses[1:-1]), (poses[1:-1], poses[2:]), (poses[:-2], poses[2:]))
    )
    leaps = np.minimum(before, after) > np.maximum(_LEAP, 2.0 * across)
    return {number for number, leap in zip(numbers[1:-1], leaps, strict=True) if leap}
