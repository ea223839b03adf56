"""Surveys a long video in one pass, cuts it into segments, and leaves out what cannot be posed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated
from zlib import crc32

import numpy as np
from jaxtyping import Bool, Float32, UInt8, UInt32
from pydantic import Field

from coliags_plugin.core.files import write_arrays
from coliags_plugin.core.progress import Progress
from coliags_plugin.pipeline.frame_selection import motion_and_survival, reduced
from coliags_plugin.pipeline.frame_sources import FrameSource, watched
from coliags_plugin.pipeline.frames import FrameSurvey
from coliags_plugin.pipeline.settings import FrameSettings
from coliags_plugin.reconstruction.structure.video import cut_where_lost

#: Name of the file in the procedure's folder.
SURVEY_FILE = "survey.npz"


@dataclass(frozen=True, eq=False)
class Survey:
    """What is known of each frame of a video.

    Attributes:
        sharpness: Root mean square of the Laplacian over the mean brightness; 0 without any texture. [N]
        followed: Share of corners that were followed from the frame before. [N]
        motion: Their median displacement, as a share of the larger side; infinity where too few were followed. [N]
        checksums: Of the pixels, to know a frame again. [N]
        size: Height and width of the frames, pixels.
        mask: False outside of the lens's image and on overlays; None where all counts. [H, W]
    """

    sharpness: Float32[np.ndarray, "N"]
    followed: Float32[np.ndarray, "N"]
    motion: Float32[np.ndarray, "N"]
    checksums: UInt32[np.ndarray, "N"]
    size: tuple[int, int]
    mask: Bool[np.ndarray, "H W"] | None

    def __len__(self) -> int:
        return len(self.sharpness)

    def write(self, folder: Path) -> None:
        """Write ``survey.npz``."""
        mask = np.zeros((0, 0), bool) if self.mask is None else self.mask
        arrays = {name: getattr(self, name) for name in ("sharpness", "followed", "motion", "checksums")}
        write_arrays(folder / SURVEY_FILE, {**arrays, "size": np.array(self.size), "mask": mask})

    @classmethod
    def read(cls, folder: Path) -> Survey:
        """Read ``survey.npz``."""
        with np.load(folder / SURVEY_FILE) as arrays:
            own = {name: arrays[name] for name in ("sharpness", "followed", "motion", "checksums")}
            height, width = arrays["size"].tolist()
            return cls(**own, size=(height, width), mask=arrays["mask"] if arrays["mask"].size else None)


def checksum(gray: UInt8[np.ndarray, "h w"]) -> int:
    """Checksum of a reduced frame."""
    return crc32(gray.tobytes())


def survey_video(source: FrameSource, progress: Progress | None = None) -> Survey:
    """Look at every frame of a video once, two of them at a time.

    Raises:
        InputError: It has no frame that can be decoded, or frames of several sizes.
    """
    whole = FrameSurvey(source.path)
    followed, motions, checksums, last = list[float](), list[float](), list[int](), None
    for _, image in watched(source, "look at frames", progress):
        whole.add(image)
        gray = reduced(image)
        moved, share = (np.inf, 0.0) if last is None else motion_and_survival(last, gray)
        motions.append(moved)
        followed.append(share)
        checksums.append(checksum(gray))
        last = gray
    mask, single = whole.mask(), np.float32
    return Survey(
        np.array(whole.sharpnesses, single), np.array(followed, single), np.array(motions, single),
        np.array(checksums, np.uint32), whole.size, mask,
    )  # fmt: skip


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

    name: Annotated[str, Field(pattern=r"^\w[\w.-]*$")]  # of the folder


@dataclass(frozen=True)
class Skipped(Stretch):
    """Frames that are left out."""

    why: str = ""


def cut(survey: Survey, settings: FrameSettings, least: int) -> tuple[list[Segment], list[Skipped]]:
    """Segments in order, and what is left out: where nothing is followed for long, and what is shorter than ``least``.

    Segments that follow each other without a gap share at most ``OVERLAP`` frames, times ``settings.every``.
    """
    flat = survey.sharpness <= _FLAT * np.median(survey.sharpness)
    lost = flat | (survey.followed < _NOTHING)
    lost[0] = flat[0]
    edges = np.flatnonzero(np.diff(np.concatenate([[0], lost.astype(np.int8), [0]])))
    gaps = [(first, stop) for first, stop in edges.reshape(-1, 2).tolist() if stop - first > _LONGEST_LOSS]
    bounds = [0, *(place for gap in gaps for place in gap), len(survey)]
    skipped = [(first, stop - 1, "nothing of the frame before is seen, or no texture") for first, stop in gaps]
    kept: list[tuple[int, int]] = []
    for start, stop in zip(bounds[::2], bounds[1::2], strict=True):
        if 0 < stop - start < least * settings.every:
            skipped.append((start, stop - 1, f"fewer than {least} frames of use between such stretches"))
        elif stop > start:
            kept += _split(survey, start, stop, settings)
    began = settings.first  # of the survey, in the video
    return (
        [Segment(began + one, began + last, f"segment-{number:03d}") for number, (one, last) in enumerate(kept)],
        [Skipped(began + one, began + last, why) for one, last, why in sorted(skipped)],
    )


def _split(survey: Survey, start: int, stop: int, settings: FrameSettings) -> list[tuple[int, int]]:
    # Stretches are not shorter than a quarter of the longest, so that no frame is in more than two segments.
    shared = min(OVERLAP, settings.segment // 8) * settings.every
    longest = settings.segment * settings.every - shared
    windows = cut_where_lost(survey.followed[start:stop].tolist(), longest)
    half = shared // 2
    return [(max(start, start + window.start - half), min(stop, start + window.stop + half) - 1) for window in windows]
