"""Survey of a long video: one pass over its frames, of which a few numbers each are kept."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from zlib import crc32

import numpy as np
from jaxtyping import Bool, Float32, UInt8, UInt32

from coliags_plugin.core.files import write_arrays
from coliags_plugin.core.progress import Progress
from coliags_plugin.pipeline.frame_selection import motion_and_survival, reduced
from coliags_plugin.pipeline.frame_sources import FrameSource
from coliags_plugin.pipeline.frames import FrameSurvey

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
    whole, expected = FrameSurvey(source.path), source.expected
    followed, motions, checksums, last = list[float](), list[float](), list[int](), None
    for done, (_, image) in enumerate(source, start=1):
        whole.add(image)
        gray = reduced(image)
        moved, share = (np.inf, 0.0) if last is None else motion_and_survival(last, gray)
        motions.append(moved)
        followed.append(share)
        checksums.append(checksum(gray))
        last = gray
        if progress is not None:
            progress("look at frames", done, max(done, expected))
    mask, single = whole.mask(), np.float32
    return Survey(
        np.array(whole.sharpnesses, single), np.array(followed, single), np.array(motions, single),
        np.array(checksums, np.uint32), whole.size, mask,
    )  # fmt: skip
