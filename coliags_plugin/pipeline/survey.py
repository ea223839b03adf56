"""Surveys a long video in one pass, cuts it into segments, and leaves out what cannot be posed."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, UInt8
from pydantic import BaseModel, ConfigDict, Field, model_validator
from scipy.ndimage import binary_fill_holes, binary_propagation
from typing_extensions import Self

from coliags_plugin.core.arrays import dilated, read_arrays
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import write_arrays
from coliags_plugin.core.jobs import Progress, with_progress
from coliags_plugin.pipeline.frame_sources import FrameSource
from coliags_plugin.pipeline.settings import FrameSettings
from coliags_plugin.pipeline.stages import MADE
from coliags_plugin.reconstruction.structure.point_tracks import sharpness
from coliags_plugin.reconstruction.structure.video import cut_where_lost

log = logging.getLogger(__name__)

#: Name of the file in the reconstruction's folder.
SURVEY_FILE = "survey.npz"
_ARRAYS = ("sharpness", "followed", "motion")
#: Brightness of all pixels below which frames show nothing, of 255: that of 12 bits in 16.
_FAINT = 16
#: Fewest frames of which something is believed to rest: in a few, moving things are alike by chance.
_FEWEST_STILL = 10
#: Larger side of the images that are measured, pixels.
_SIDE = 480
#: Corners that are followed, at most, and fewest for a motion.
_CORNERS, _FEWEST = 200, 12
#: Width of the surroundings of a corner, which have to be of the lens's image, pixels.
_RIM = 9
#: Largest distance between a corner and where following it there and back ends, pixels.
_RETURN = 0.5
#: Brightness (of 255) that a pixel outside of the lens's image never exceeds, and pixels by which that is widened.
_DARK, _MARGIN = 16, 3
#: Pixels that are connected: those that share an edge or a corner.
_NEIGHBOURS = np.ones((3, 3), bool)
#: Shares of the image between which a dark border is believed.
_BORDER = (0.002, 0.7)
#: A pixel that changes by less than this over the video, of 255, is still; the others change by at least twice as much
#: (median), or the camera rests. Largest share of them, and least gradient of the mean image at an overlay, per pixel:
#: what moves leaves up to 6.
_STILL, _OVERLAYS, _EDGE = 48, 0.3, 10.0
#: Most frames of a video: a day at 60 a second.
_MOST_FRAMES = 6_000_000


@dataclass(frozen=True, eq=False)
class Survey:
    """Measures of each frame of a video."""

    sharpness: Float[np.ndarray, "N"]  # RMS of the Laplacian over the mean brightness; 0 without any texture
    followed: Float32[np.ndarray, "N"]  # share of corners that were followed from the frame before
    motion: Float32[np.ndarray, "N"]  # their median displacement over the larger side; infinity: too few were followed
    size: tuple[int, int]  # height and width of the frames, pixels
    mask: Bool[np.ndarray, "H W"] | None  # False outside of the lens's image and on overlays; None where all counts
    first: int = 0  # number of the first frame
    times: Float64[np.ndarray, "N"] | None = None  # after the video's first frame, s; None: numbers over a rate

    def __len__(self) -> int:
        return len(self.sharpness)

    def part(self, first: int, last: int | None) -> Survey:
        """Some of the frames, by their numbers, both inclusive; without ``last`` up to the end."""
        place = slice(first - self.first, None if last is None else last + 1 - self.first)
        times = None if self.times is None else self.times[place]
        return replace(self, first=first, times=times, **{name: getattr(self, name)[place] for name in _ARRAYS})

    def write(self, folder: Path) -> None:
        """Write ``survey.npz``."""
        mask = np.zeros((0, 0), bool) if self.mask is None else self.mask
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        numbers = {"size": np.array(self.size), "first": np.array(self.first), "mask": mask}
        times = {} if self.times is None else {"times": self.times}
        write_arrays(folder / SURVEY_FILE, {**arrays, **numbers, **times})

    @classmethod
    def read(cls, folder: Path) -> Survey:
        """Read ``survey.npz``; InputError where it is damaged."""
        arrays = read_arrays(folder / SURVEY_FILE, MADE, (*_ARRAYS, "size", "first", "mask"), ["times"])
        by_frame, mask = {name: arrays[name] for name in (*_ARRAYS, "times") if name in arrays}, arrays["mask"]
        shapes = {name: array.shape for name, array in arrays.items() if name != "mask"}
        expected = dict.fromkeys(by_frame, (len(np.ravel(by_frame["sharpness"])),)) | {"size": (2,), "first": ()}
        are_numbers = all(array.dtype.kind in "fiu" for array in by_frame.values())
        if shapes != expected or not are_numbers or mask.dtype != bool:
            raise InputError(f"{folder / SURVEY_FILE} has {shapes}", "a number for each frame")
        height, width = arrays["size"].tolist()
        return cls(**by_frame, size=(height, width), mask=mask if mask.size else None, first=int(arrays["first"]))


def lens_mask(brightest: UInt8[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"] | None:
    """Mask of a lens's image within black surroundings; None where the image has none.

    False where a pixel is dark in every frame and connected to the image's edge. ``brightest`` is the largest value of
    each pixel in any channel of any frame.
    """
    outside = ~binary_fill_holes(brightest > _DARK, _NEIGHBOURS)
    share = float(outside.mean())
    return ~dilated(outside, _MARGIN) if _BORDER[0] <= share <= _BORDER[1] else None


def overlays(
    darkest: UInt8[np.ndarray, "H W 3"], brightest: UInt8[np.ndarray, "H W 3"], mean: Float32[np.ndarray, "H W 3"]
) -> Bool[np.ndarray, "H W"]:
    """Text, logos and frames within the picture: what never changes, with edges, while the rest does.

    True there. ``darkest`` and ``brightest`` are the extremes of each pixel over the frames, ``mean`` its mean.
    """
    change = (brightest - darkest).max(axis=2)
    dark = brightest.max(axis=2) <= _DARK
    still = (change <= _STILL) & ~dark
    others = change[~dark & ~still]
    if not still.any() or still.sum() > _OVERLAYS * (~dark).sum() or np.median(others) < 2 * _STILL:
        return np.zeros(still.shape, bool)
    slope = np.zeros(still.shape, np.float32)
    for number in range(3):  # one channel after the other, for the memory of large frames
        channel = np.ascontiguousarray(mean[..., number])
        slopes = (cv2.Sobel(channel, cv2.CV_32F, *axis, scale=1 / 8) for axis in ((1, 0), (0, 1)))
        np.maximum(slope, np.hypot(*slopes), out=slope)
    with_edges = binary_propagation(still & dilated(slope > _EDGE, 1), _NEIGHBOURS, dilated(still, 1))
    return dilated(with_edges, _MARGIN)


def reduced(image: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "h w"]:
    """The grey image at the size at which frames are measured."""
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    factor = _SIDE / max(gray.shape)
    if factor >= 1.0:
        return gray
    size = (max(1, round(gray.shape[1] * factor)), max(1, round(gray.shape[0] * factor)))
    return np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA))


def corner_motion(
    before: UInt8[np.ndarray, "h w"], after: UInt8[np.ndarray, "h w"], mask: Bool[np.ndarray, "H W"] | None = None
) -> tuple[float, float]:
    """Median displacement of corners as a share of the larger side, infinity for too few, and the share followed.

    ``mask``, of the frames before they were reduced, is False where corners do not count, as on text, which rests.
    """
    counted = None
    if mask is not None:
        counted = cv2.resize(mask.astype(np.uint8), before.shape[::-1], interpolation=cv2.INTER_NEAREST)
        counted = cv2.erode(counted, np.ones((_RIM, _RIM), np.uint8))
    # The colon's wall is smooth, and the lamp's brightness changes: local contrast is enhanced.
    first, second = (cv2.createCLAHE(4.0, (8, 8)).apply(gray) for gray in (before, after))
    corners = cv2.goodFeaturesToTrack(first, _CORNERS, 0.01, 8, mask=counted)
    if corners is None or len(corners) < _FEWEST:
        return float("inf"), 0.0
    moved, is_tracked, _ = cv2.calcOpticalFlowPyrLK(first, second, corners, None)
    back, is_tracked_back, _ = cv2.calcOpticalFlowPyrLK(second, first, moved, None)
    returned = np.linalg.norm(back - corners, axis=2)[:, 0] < _RETURN
    survived = (is_tracked[:, 0] > 0) & (is_tracked_back[:, 0] > 0) & returned
    if survived.sum() < _FEWEST:
        return float("inf"), float(survived.sum()) / _CORNERS
    lengths = np.linalg.norm(moved - corners, axis=2)[survived, 0]
    return float(np.median(lengths)) / max(before.shape), float(survived.sum()) / _CORNERS


class FrameSurvey:
    """Sharpness of all frames of a video, and the mask that they have in common."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.sharpnesses: list[float] = []
        self._extremes: list[UInt8[np.ndarray, "H W 3"]] = []
        self._sum: Float32[np.ndarray, "H W 3"] | None = None
        self._sizes: set[tuple[int, ...]] = set()

    def add(self, image: UInt8[np.ndarray, "H W 3"]) -> None:
        """Look at the next frame."""
        self._sizes.add(image.shape)
        if len(self._sizes) > 1:
            return
        self.sharpnesses.append(sharpness(reduced(image)))
        if self._sum is None:
            self._extremes, self._sum = [image.copy(), image.copy()], image.astype(np.float32)
            return
        for extreme, of_both in zip(self._extremes, (np.minimum, np.maximum), strict=True):
            of_both(extreme, image, out=extreme)
        self._sum += image

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the frames."""
        return self._extremes[0].shape[0], self._extremes[0].shape[1]

    def mask(self) -> Bool[np.ndarray, "H W"] | None:
        """False outside of the lens's image and on overlays; None without any, as of frames of several sizes."""
        if self._sum is None:
            raise InputError(f"no frames in {self.path}", "a video")
        darkest, brightest = self._extremes
        if 0 < (top := int(brightest.max())) < _FAINT:
            raise InputError(
                f"no pixel of the {len(self.sharpnesses)} frames of {self.path} is brighter than {top} of 255",
                "images that use the range of their 8 or 16 bits",
                "Multiply them by 16 if they are of 12 bits in 16",
            )
        inside, count = lens_mask(brightest.max(axis=2)), len(self.sharpnesses)
        mask = np.ones(self.size, bool) if inside is None else inside
        if count >= _FEWEST_STILL:
            mask &= ~overlays(darkest, brightest, self._sum / count)
        return None if mask.all() or len(self._sizes) > 1 else mask


def survey_video(source: FrameSource, progress: Progress | None = None) -> Survey:
    """Look at every frame of a video once, two of them at a time.

    Raises:
        InputError: It has no frame that can be decoded, or frames of several sizes.
    """
    whole = FrameSurvey(source.path)
    followed, motions, last = list[float](), list[float](), None
    for _, image in with_progress(source, "look at frames", progress, source.expected):
        whole.add(image)
        gray = reduced(image)
        moved, share = (np.inf, 0.0) if last is None else corner_motion(last, gray)
        motions.append(moved)
        followed.append(share)
        last = gray
    first, sharpness, single = source.span.first, np.array(whole.sharpnesses), np.float32
    times = source.times[first : first + len(motions)] if source.is_variable and source.times is not None else None
    shares, motion_shares = np.array(followed, single), np.array(motions, single)
    return Survey(sharpness, shares, motion_shares, whole.size, whole.mask(), first, times)


#: Share of corners below which a frame shows nothing of the one before: wall contact, blur, wash, or a cut.
_NOTHING = 0.06
#: Share of the video's median sharpness below which corners are noise of the sensor and of compression, which may be
#: followed: wall contact has 0.10 to 0.13, the least sharp of a patient's frames of use 0.28.
_FLAT = 0.2
#: Frames without a break of which a stretch of such frames is left out; shorter ones stay within their segment.
_LONGEST_LOSS = 30
#: Frames that two segments share where a video is cut although points are followed, so that they can be joined.
OVERLAP = 24


@dataclass(frozen=True)
class Stretch:
    """Frames of a video by their numbers, both inclusive."""

    first: int
    last: int

    @property
    def count(self) -> int:
        """Number of frames."""
        return self.last - self.first + 1


@dataclass(frozen=True)
class Segment(Stretch):
    """Frames that are reconstructed by themselves."""

    name: Annotated[str, Field(pattern=r"^(segment-[0-9]{1,6})?$")]  # of the folder; empty: of the whole video


@dataclass(frozen=True)
class Skipped(Stretch):
    """Frames that are left out."""

    why: str = ""


class Video(BaseModel):
    """A video and its segments, as the record has them; numbers of frames are those of the video."""

    model_config = ConfigDict(extra="ignore", frozen=True, allow_inf_nan=False)

    source: str  # name of the video's file, or of the folder
    rate: Annotated[float, Field(gt=0.0, lt=1e4)] | None = None  # frames a second; None: unknown
    frames: Annotated[int, Field(gt=0, lt=_MOST_FRAMES)]  # that were looked at
    size: tuple[int, int] | None = None  # width and height, pixels
    first: Annotated[int, Field(ge=0, lt=_MOST_FRAMES)] = 0  # that was looked at
    deinterlace: bool | None = False  # whether they were read so; None: those that are flagged
    segments: tuple[Segment, ...]
    skipped: tuple[Skipped, ...] = ()

    @model_validator(mode="after")
    def _within_the_video(self) -> Self:
        stretches: list[Stretch] = [*self.segments, *self.skipped]
        for stretch in stretches:
            if not self.first <= stretch.first <= stretch.last < self.stop:
                raise ValueError(f"frames {stretch.first} to {stretch.last}, not of {self.first} to {self.stop - 1}")
        if len({segment.name for segment in self.segments}) < len(self.segments):
            raise ValueError("two segments have the same name")
        return self

    @property
    def stop(self) -> int:
        """Number of the last frame that was looked at, plus one."""
        return self.first + self.frames


def cut(survey: Survey, settings: FrameSettings, least: int) -> tuple[list[Segment], list[Skipped]]:
    """Segments in order, and what is left out: where nothing is followed for long, and what is shorter than ``least``.

    A video that is not longer than a segment is one, whatever it shows. Segments that follow each other without a gap
    share at most ``OVERLAP`` frames, times ``settings.every``.
    """
    first_frame = survey.first
    if len(survey) <= settings.segment * settings.every:
        return [Segment(first_frame, first_frame + len(survey) - 1, "")], []
    flat = survey.sharpness <= _FLAT * np.median(survey.sharpness)
    lost = flat | (survey.followed < _NOTHING)
    lost[0] = flat[0]
    edges = np.flatnonzero(np.diff(np.concatenate([[0], lost.astype(np.int8), [0]])))
    gaps = [(first, stop) for first, stop in edges.reshape(-1, 2).tolist() if stop - first > _LONGEST_LOSS]
    bounds = [0, *(place for gap in gaps for place in gap), len(survey)]
    skipped = [(first, stop - 1, "nothing of the frame before is seen, or no texture") for first, stop in gaps]
    used: list[tuple[int, int]] = []
    for start, stop in zip(bounds[::2], bounds[1::2], strict=True):
        if 0 < stop - start < least * settings.every:
            skipped.append((start, stop - 1, f"fewer than {least} frames of use between such stretches"))
        elif stop > start:
            used += _split(survey, start, stop, settings)
    log.info("%d frames in %d segments, %d stretches left out", len(survey), len(used), len(skipped))
    return (
        [Segment(first_frame + a, first_frame + b, f"segment-{number:03d}") for number, (a, b) in enumerate(used)],
        [Skipped(first_frame + a, first_frame + b, why) for a, b, why in sorted(skipped)],
    )


def _split(survey: Survey, start: int, stop: int, settings: FrameSettings) -> list[tuple[int, int]]:
    # Stretches are not shorter than a quarter of the longest, so that no frame is in more than two segments.
    shared = min(OVERLAP, settings.segment // 8) * settings.every
    longest = settings.segment * settings.every - shared
    windows = cut_where_lost(survey.followed[start:stop].tolist(), longest)
    half = shared // 2
    return [(max(start, start + window.start - half), min(stop, start + window.stop + half) - 1) for window in windows]
