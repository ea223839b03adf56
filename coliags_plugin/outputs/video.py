"""MP4 video writing with the codecs of OpenCV's wheel."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from jaxtyping import UInt8

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_path
from coliags_plugin.outputs.image_files import checked_rgb

if TYPE_CHECKING:
    from torch import Tensor

_LOG = logging.getLogger(__name__)

#: In order of preference. OpenCV's wheels have no H.264 encoder; VP9 plays in browsers, MPEG-4 part 2 in players only.
CODECS = ("vp09", "mp4v")


def write_video(frames: Iterable[UInt8[np.ndarray, "H W 3"] | Tensor], path: Path, fps: float) -> None:
    """Write an MP4 video atomically; frames are consumed one at a time, so that a generator may render them.

    An odd width or height is padded by repeating the last column or row: the codecs halve the chroma planes, and OpenCV
    would crop a line instead.
    """
    if path.suffix.lower() != ".mp4":
        raise InputError(f"video file {path}", "a name that ends in .mp4")
    check_rate(fps)
    # FFmpeg chooses the container by the suffix, and opens the file itself.
    with atomic_path(path) as scratch:
        scratch.write_bytes(bytes(4096))  # OpenCV would call a full disk a missing codec
        count = _encode(frames, scratch, fps)
        if count == 0:
            raise InputError(f"no frames for {path}", "at least one")
        if _frame_count(scratch) != count:
            raise InputError(f"the video written to {path} is incomplete", "a disk with space left", "Free some")
    _LOG.info("encoded %s: %d frames, %g per second", path.name, count, fps)


def check_rate(fps: float) -> None:
    """Refuse what is no number of frames a second."""
    if not 0.0 < fps < math.inf:
        raise InputError(f"{fps} frames a second", "a positive number")


def _frame_count(path: Path) -> int:
    video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        return int(video.get(cv2.CAP_PROP_FRAME_COUNT))
    finally:
        video.release()


def _encode(frames: Iterable[np.ndarray | Tensor], scratch: Path, fps: float) -> int:
    writer: Any = None
    shape: tuple[int, ...] = ()
    count = 0
    try:
        for frame in frames:
            image = checked_rgb(frame, f"frame {count}")
            if writer is None:
                shape = image.shape
                writer = _writer(scratch, fps, shape[1] + shape[1] % 2, shape[0] + shape[0] % 2)
            elif image.shape != shape:
                raise InputError(
                    f"frame {count} is {image.shape[1]} x {image.shape[0]} px", f"{shape[1]} x {shape[0]} px as frame 0"
                )
            even = np.pad(image, ((0, shape[0] % 2), (0, shape[1] % 2), (0, 0)), mode="edge")
            writer.write(np.ascontiguousarray(even[:, :, ::-1]))
            count += 1
    finally:
        if writer is not None:
            writer.release()
    return count


def _writer(scratch: Path, fps: float, width: int, height: int) -> Any:
    for codec in CODECS:
        writer = cv2.VideoWriter(
            str(scratch), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*codec), float(fps), (width, height)
        )
        if writer.isOpened():
            return writer
    raise InputError(
        f"OpenCV {cv2.__version__} opens none of the codecs {', '.join(CODECS)} for {width} x {height} px",
        "an OpenCV built with FFmpeg",
        "Install opencv-contrib-python-headless from PyPI, or write the frames as PNG",
    )
