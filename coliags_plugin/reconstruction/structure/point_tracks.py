"""Point tracks through a video: corners of the wall's texture, followed from each frame to the next.

Each corner is moved by two candidates, dense DIS flow refined by Lucas-Kanade and pyramidal Lucas-Kanade alone. Of
those that come back when followed backwards, the one whose surroundings correlate better is kept, and both frames have
to satisfy an epipolar geometry.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Int64, UInt8

from coliags_plugin.core.arrays import dilated
from coliags_plugin.core.images import highlights
from coliags_plugin.core.jobs import Progress, with_progress
from coliags_plugin.reconstruction.structure.features import epipolar_inliers
from coliags_plugin.reconstruction.structure.image_files import Image, Mask, Masks, mask_of, read_image
from coliags_plugin.reconstruction.structure.mapping import brightness_at
from coliags_plugin.reconstruction.structure.sfm_settings import TrackSettings

#: A grey image, and points in an image: columns and rows.
Gray = UInt8[np.ndarray, "h w"]
Pixels = Float32[np.ndarray, "K 2"]
#: Brightness, of 255, that is added before the logarithm, so that noise in the dark is not amplified without bound.
_DARK_OFFSET = 4.0
#: Standard deviations of the local mean, for detail and for folds, of the highlights' fill, of the denoising, pixels.
_DETAIL, _FOLDS, _FILL, _DENOISING = 10.0, 30.0, 4.0, 0.7
#: Least local deviation of the log brightness: flatter regions stay flat.
_LEAST_DEVIATION = 0.012
#: Local deviation up to which there is only the noise of 8-bit images.
_NOISE = 0.003
#: Grey levels per local deviation.
_GAIN = 42.0
#: Green from which tissue is overexposed, and brightness up to which a pixel is black.
_OVEREXPOSED, _BLACK = 235, 8
#: Brightness (of 255) of highlights, whose edges are sharp in any frame, and pixels about them that do not count.
_HIGHLIGHT, _HIGHLIGHT_MARGIN = 240, 5
#: The same where coarse detail is measured too, as of black pixels.
_COARSE_MARGIN = 12
#: Pixels around highlights and without texture that are not usable, and at the image's edge.
_MARGIN, _EDGE = 2, 4


def wall_textures(image: Image, mask: Mask | None = None) -> tuple[Gray, Gray, Mask]:
    """Log brightness of an RGB image, normalised over short and over longer distances, and where it is of use.

    The first shows vessels and grain, to be located exactly; the second also folds, which tell large displacements.
    Both are 128 in the mean. Highlights are filled from around. Green and a little red are used: blood absorbs blue,
    and red saturates.
    """
    import cv2

    glints = dilated(highlights(image), _MARGIN)
    excluded = glints if mask is None else glints | ~mask
    log = np.log(0.7 * image[..., 1].astype(np.float32) + 0.3 * image[..., 0] + _DARK_OFFSET)
    weight = (~excluded).astype(np.float32)
    around = cv2.GaussianBlur(log * weight, (0, 0), _FILL) / np.maximum(cv2.GaussianBlur(weight, (0, 0), _FILL), 1e-3)
    log = cv2.GaussianBlur(np.where(excluded, around, log), (0, 0), _DENOISING)
    detail, deviation = _normalised(log, _DETAIL)
    flat = (deviation < _NOISE) | (image[..., 1] > _OVEREXPOSED) | (image.max(axis=2) < _BLACK)
    usable = ~(excluded | dilated(flat, _MARGIN))
    usable[:_EDGE] = usable[-_EDGE:] = usable[:, :_EDGE] = usable[:, -_EDGE:] = False
    return detail, _normalised(log, _FOLDS)[0], usable


def _normalised(log: Float32[np.ndarray, "H W"], reach: float) -> tuple[Gray, Float32[np.ndarray, "H W"]]:
    """Difference from the local mean in units of the local standard deviation, as grey levels; and that deviation."""
    import cv2

    difference = log - cv2.GaussianBlur(log, (0, 0), reach)
    deviation = np.sqrt(cv2.GaussianBlur(difference * difference, (0, 0), reach))
    texture = np.clip(128.0 + _GAIN * difference / (deviation + _LEAST_DEVIATION), 0.0, 255.0).astype(np.uint8)
    return texture, deviation


def correlation_at(first: Gray, second: Gray, pixels: Pixels, moved: Pixels) -> Float32[np.ndarray, "K"]:
    """Normalised cross-correlation of 11 x 11 pixels around pixels of one texture and around those of another. [K]

    ``moved`` are ``pixels``, columns and rows with pixel centres at integers, as the second texture shows them.
    """
    patches = [_patches(texture, at) for texture, at in ((first, pixels), (second, moved))]
    centred, partners = (patch - patch.mean(axis=1, keepdims=True) for patch in patches)
    power = np.sqrt((centred**2).sum(axis=1) * (partners**2).sum(axis=1))
    return np.asarray((centred * partners).sum(axis=1) / np.maximum(power, 1e-3))


def sharpness(gray: Gray) -> float:
    """Root mean square of the Laplacian of the smoothed image, relative to its mean brightness; 0 for a black image.

    Highlights do not count: they are sharp in a blurred frame too. Comparable between frames of one video only.
    """
    import cv2

    counted = ~dilated(gray >= _HIGHLIGHT, _HIGHLIGHT_MARGIN)
    brightness = float(gray[counted].mean()) if counted.any() else 0.0
    if brightness == 0.0:
        return 0.0
    edges = cv2.Laplacian(cv2.GaussianBlur(gray.astype(np.float32), (0, 0), 1.0), cv2.CV_32F)
    return float(np.sqrt(np.mean(np.square(edges[counted])))) / brightness


def fineness(gray: Gray) -> float:
    """Fine detail relative to coarse: root mean square Laplacians of log brightness, smoothed by 2 px and by 4 px.

    2 to 3.5 where an image is sharp; at a blur of 3 px 1.7, of 6 px 1.2; infinity without coarse detail. It does not
    depend on brightness or contrast, so that it tells a video that is blurred throughout.
    """
    import cv2

    counted = ~dilated((gray >= _HIGHLIGHT) | (gray < _BLACK), _COARSE_MARGIN)
    log = np.log(gray.astype(np.float32) + _DARK_OFFSET)
    smoothed = (cv2.GaussianBlur(log, (0, 0), sigma) for sigma in (2.0, 4.0))
    fine, coarse = (np.square(cv2.Laplacian(smooth, cv2.CV_32F)[counted]).sum() for smooth in smoothed)
    return float(np.sqrt(fine / coarse)) if coarse > 0.0 else float("inf")


def _patches(texture: np.ndarray, at: np.ndarray) -> Float32[np.ndarray, "K 121"]:
    import cv2

    offset = np.arange(-5, 6, dtype=np.float32)
    column, row = (grid.ravel() for grid in np.meshgrid(offset, offset))
    # cv2.remap takes at most 32,767 rows.
    parts = [
        cv2.remap(texture, part[:, :1] + column, part[:, 1:] + row, cv2.INTER_LINEAR).astype(np.float32)
        for part in np.array_split(at.astype(np.float32), len(at) // 30_000 + 1)
    ]
    return np.concatenate(parts)


#: Least strength of a new corner, relative to the strongest, and its least distance from other points, pixels.
_QUALITY, _SPACING = 0.004, 6
#: Largest distance between a point and where following it back ends, pixels; least normalised cross-correlation of 11 x
#: 11 pixels around a point, and that from which it is clearly found.
_MAX_RETURN, _MIN_CORRELATION, _CLEAR = 0.7, 0.6, 0.8
#: RANSAC inlier threshold of the epipolar geometry of neighbours, pixels.
_MAX_ERROR = 2.5
#: Where fewer points survive, those lost are searched for again; number of frames in which they are.
_BRIDGE_BELOW, _LONGEST_BRIDGE = 150, 4
#: Least share of the points found again that satisfy one epipolar geometry.
_LEAST_SHARE = 0.5
#: Fewest points that are followed.
_FEWEST = 20


@dataclass(frozen=True, eq=False)
class FramePoints:
    """Tracked points of one frame."""

    ids: Int64[np.ndarray, "K"]  # numbers of the tracks, ascending
    pixels: Pixels  # column and row in the frame, pixel centres at integers + 0.5
    brightness: Float32[np.ndarray, "K"]  # mean of red, green and blue around them, 0 to 255
    followed: int  # number of points that came from the frame before
    shift: float  # their median displacement, as a share of the larger side
    sharpness: float  # of the frame
    fineness: float  # of the frame at the size that is tracked


def shared_tracks(first: FramePoints, second: FramePoints) -> Int64[np.ndarray, "M 2"]:
    """Rows of the points that two frames have in common, in the order of their tracks."""
    _, *rows = np.intersect1d(first.ids, second.ids, assume_unique=True, return_indices=True)
    return np.stack(rows, axis=1)


def track_between(
    images: Sequence[Image], masks: Sequence[Mask | None], settings: TrackSettings | None = None
) -> tuple[Float[np.ndarray, "K 2"], Float[np.ndarray, "K 2"]]:
    """Track points through consecutive RGB images of one size; their pixels in the first and in the last.

    Masks are False where a pixel is ignored; pixel centres are at integers + 0.5. Points that are lost on the way are
    not searched for again.
    """
    tracker = PointTracker(settings or TrackSettings(), bridge_below=0)
    frames = [tracker.advance(image, mask) for image, mask in zip(images, masks, strict=True)]
    rows = shared_tracks(frames[0], frames[-1]).T
    first, last = (
        frame.pixels[row].astype(np.float64) for frame, row in zip((frames[0], frames[-1]), rows, strict=True)
    )
    return first, last


def track_points(
    images: Sequence[Path], settings: TrackSettings, masks: Masks = None, progress: Progress | None = None
) -> list[FramePoints]:
    """Track points through the frames of a video, of one size and in order, holding a few frames at a time.

    Around frames in which most points are lost, corners are also followed backwards: what is seen well after a fast
    turn is often found in the blurred frames before it. Masks are False where a pixel is ignored.
    """
    forward = PointTracker(settings)
    points = []
    for path in with_progress(images, "track points", progress):
        points.append(forward.advance(read_image(path), mask_of(path, masks)))
    near = np.zeros(len(points), bool)
    for index, frame in enumerate(points):
        if index and frame.followed < _BRIDGE_BELOW:
            near[max(0, index - 2 * _LONGEST_BRIDGE) : index + 2 * _LONGEST_BRIDGE] = True
    edges = np.flatnonzero(np.diff(np.concatenate([[0], near, [0]])))
    next_id = forward.next_id
    for first, end in with_progress(edges.reshape(-1, 2).tolist(), "track backwards", progress):
        backward = PointTracker(settings, next_id)
        for index in reversed(range(first, end)):
            more = backward.advance(read_image(images[index]), mask_of(images[index], masks))
            points[index] = replace(
                points[index],
                ids=np.concatenate([points[index].ids, more.ids]),
                pixels=np.concatenate([points[index].pixels, more.pixels]),
                brightness=np.concatenate([points[index].brightness, more.brightness]),
            )
        next_id = backward.next_id
    return points


@dataclass(frozen=True, eq=False)
class View:
    """A reduced image prepared for tracking, with points in it (pixel centres at integers)."""

    detail: Gray
    folds: Gray
    usable: Mask
    ids: Int64[np.ndarray, "K"]
    pixels: Pixels
    stretch: Float32[np.ndarray, "2"]  # factors from the reduced image to the whole one
    sharpness: float
    fineness: float
    age: int = 0

    def in_image(self, pixels: Pixels) -> Pixels:
        """Pixels of the view in the whole image, pixel centres at integers + 0.5."""
        return (pixels + 0.5) * self.stretch

    def from_image(self, pixels: Float[np.ndarray, "N 2"]) -> Pixels:
        """Pixels of the whole image, centres at integers + 0.5, in the view."""
        return (pixels / self.stretch - 0.5).astype(np.float32)

    def only(self, rows: Int64[np.ndarray, "N"] | Bool[np.ndarray, "K"]) -> View:
        """The view with some of its points, in the order given."""
        return replace(self, ids=self.ids[rows], pixels=self.pixels[rows])

    def with_points(self, ids: Int64[np.ndarray, "N"], pixels: Pixels) -> View:
        """The view with further points."""
        return replace(self, ids=np.concatenate([self.ids, ids]), pixels=np.concatenate([self.pixels, pixels]))


class PointFinder:
    """Search for the points of one image in another, by correlation of their surroundings alone."""

    def __init__(self, settings: TrackSettings) -> None:
        import cv2

        self.settings = settings
        self.flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        self.flow.setFinestScale(1)

    def view(self, image: Image, mask: Mask | None) -> View:
        """Textures of an image, reduced to the side of the settings, without points."""
        import cv2

        scale = min(1.0, self.settings.side / max(image.shape[:2]))
        size = (round(image.shape[1] * scale), round(image.shape[0] * scale))
        small = image if scale == 1.0 else cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        if mask is not None and scale < 1.0:
            mask = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
        stretch = np.array([image.shape[1] / size[0], image.shape[0] / size[1]], np.float32)
        gray = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY)
        none = np.empty(0, np.int64), np.empty((0, 2), np.float32)
        return View(*wall_textures(small, mask), *none, stretch, sharpness(gray), fineness(gray))

    def find(self, before: View, after: View) -> tuple[Int64[np.ndarray, "N"], Pixels]:
        """Rows and new pixels of the points of one view that another shows, by correlation alone."""
        if not len(before.ids):
            return np.empty(0, np.int64), np.empty((0, 2), np.float32)
        flows = self.flow.calc(before.folds, after.folds, None), self.flow.calc(after.folds, before.folds, None)
        moved, scores = before.pixels.copy(), np.full(len(before.ids), -1.0, np.float32)
        for guess in (flows, None):
            # The second candidate is for points that the first has not clearly found.
            rows = np.flatnonzero(scores < _CLEAR)
            start = before.pixels[rows]
            if not len(rows):
                break
            candidate, returned = _there_and_back(before.detail, after.detail, start, guess)
            column, row = np.clip(np.rint(candidate), 0, np.array(after.detail.shape[::-1]) - 1).astype(np.int64).T
            is_back = np.linalg.norm(returned - start, axis=1) < _MAX_RETURN
            correlation = correlation_at(before.detail, after.detail, start, candidate)
            score = np.where(is_back & after.usable[row, column], correlation, -1.0)
            better = score > scores[rows]
            moved[rows[better]], scores[rows[better]] = candidate[better], score[better]
        alike = np.flatnonzero(scores > _MIN_CORRELATION)
        return alike, moved[alike].astype(np.float32)


class PointTracker:
    """Point tracker with the last view, and the views before frames in which most points were lost."""

    def __init__(self, settings: TrackSettings, first_id: int = 0, bridge_below: int = _BRIDGE_BELOW) -> None:
        self.settings, self.bridge_below = settings, bridge_below
        self.finder = PointFinder(settings)
        self.last: View | None = None
        self.bridges: list[View] = []
        self.next_id = first_id

    def advance(self, image: Image, mask: Mask | None) -> FramePoints:
        """Follow the points into the next image, and add corners."""
        view = self.finder.view(image, mask)
        shift = 0.0
        if self.last is not None:
            rows, moved = self._followed(self.last, view)
            if len(rows):
                lengths = np.linalg.norm(moved - self.last.pixels[rows], axis=1)
                shift = float(np.median(lengths)) / max(view.detail.shape)
            view = view.with_points(self.last.ids[rows], moved)
            # Points that were lost a few frames before may be found again.
            aged = [replace(bridge, age=bridge.age + 1) for bridge in self.bridges]
            self.bridges = [bridge for bridge in aged if bridge.age <= _LONGEST_BRIDGE]
            for bridge in self.bridges:
                lost = bridge.only(~np.isin(bridge.ids, view.ids))
                again, places = self._followed(lost, view)
                view = view.with_points(lost.ids[again], places)
            if len(rows) < self.bridge_below:
                self.bridges.append(self.last)
        # Without points that have met an older track.
        order = np.argsort(view.ids)
        cells = np.floor(view.pixels[order] / 4.0).astype(np.int64)
        _, first = np.unique(cells[:, 1] * 100_000 + cells[:, 0], return_index=True)
        view = view.only(order[np.sort(first)])
        followed = len(view.ids)
        view = self._with_corners(view)
        self.last = view
        order = np.argsort(view.ids)
        pixels = view.in_image(view.pixels[order])
        brightness = brightness_at(image, pixels.astype(np.float64)).astype(np.float32)
        return FramePoints(view.ids[order], pixels, brightness, followed, shift, view.sharpness, view.fineness)

    def _followed(self, before: View, after: View) -> tuple[Int64[np.ndarray, "N"], Pixels]:
        """Rows and new pixels of the points of one view that another shows, with the epipolar check.

        All or none: half of those that come back, and 20 at least, have to satisfy one epipolar geometry. Where both
        views of a patient showed the same wall, 23 or more did; between unrelated views at most 17, by chance.
        """
        alike, moved = self.finder.find(before, after)
        consistent = epipolar_inliers(before.pixels[alike], moved, after.detail.shape, _MAX_ERROR)
        if consistent.sum() < max(_FEWEST, _LEAST_SHARE * len(alike)):
            return alike[:0], moved[:0]
        return alike[consistent], moved[consistent]

    def _with_corners(self, view: View) -> View:
        import cv2

        missing = self.settings.corners - len(view.ids)
        if missing <= 0:
            return view
        free = view.usable.astype(np.uint8)
        for column, row in np.rint(view.pixels).astype(int).tolist():
            cv2.circle(free, (column, row), _SPACING, 0, -1)
        corners = cv2.goodFeaturesToTrack(view.detail, missing, _QUALITY, _SPACING, mask=free, blockSize=7)
        if corners is None:
            return view
        ids = np.arange(self.next_id, self.next_id + len(corners))
        self.next_id += len(corners)
        return view.with_points(ids, corners.reshape(-1, 2))


def _there_and_back(
    before: Gray,
    after: Gray,
    pixels: Pixels,
    flows: tuple[Float32[np.ndarray, "h w 2"], Float32[np.ndarray, "h w 2"]] | None,
) -> tuple[Pixels, Pixels]:
    """Track points by Lucas-Kanade, from dense flow or coarse to fine, and back again; infinity if lost."""
    import cv2

    options: dict[str, Any] = {"winSize": (21, 21), "criteria": (3, 20, 0.02), "maxLevel": 3 if flows is None else 1}
    ends = []
    status = np.ones(len(pixels), bool)
    start = pixels
    for index, (source, target) in enumerate(((before, after), (after, before))):
        guess = None
        if flows is not None:
            guess = start + _sampled(flows[index], start)
            options["flags"] = cv2.OPTFLOW_USE_INITIAL_FLOW
        end, tracked, _ = cv2.calcOpticalFlowPyrLK(source, target, start, guess, **options)
        status &= tracked.ravel() > 0
        ends.append(end)
        start = end
    limit = np.array(after.shape[::-1], np.float32) - 6.0
    status &= ((ends[0] > 5.0) & (ends[0] < limit)).all(axis=1)
    return ends[0], np.where(status[:, None], ends[1], np.float32(np.inf))


def _sampled(flow: Float32[np.ndarray, "h w 2"], pixels: Pixels) -> Pixels:
    import cv2

    channels = [cv2.remap(flow[..., k], pixels[:, 0], pixels[:, 1], cv2.INTER_LINEAR).ravel() for k in (0, 1)]
    return np.stack(channels, axis=1)
