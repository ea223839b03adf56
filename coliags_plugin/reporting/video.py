"""Writer of MP4 videos."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, cast

import av
import numpy as np
from jaxtyping import UInt8

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_path
from coliags_plugin.reporting.image_files import checked_rgb

if TYPE_CHECKING:
    from av.video.stream import VideoStream
    from torch import Tensor

_LOG = logging.getLogger(__name__)

#: VP9, which plays in browsers.
_CODEC, _OPTIONS = "libvpx-vp9", {"crf": "15", "b": "0", "deadline": "realtime", "cpu-used": "6"}


def write_video(frames: Iterable[UInt8[np.ndarray, "H W 3"] | Tensor], path: Path, fps: float) -> None:
    """Write an MP4 video atomically; frames are consumed one at a time, so that a generator may render them.

    An odd width or height is padded by repeating the last column or row: the codecs halve the chroma planes.
    """
    if path.suffix.lower() != ".mp4":
        raise InputError(f"video file {path}", "a name that ends in .mp4")
    check_rate(fps)
    with atomic_path(path) as scratch:
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
    try:
        with av.open(f"file:{path}") as file:
            return file.streams.video[0].frames
    except av.FFmpegError:
        return 0


def _encode(frames: Iterable[np.ndarray | Tensor], scratch: Path, fps: float) -> int:
    shape: tuple[int, ...] = ()
    count = 0
    # With the protocol, as a colon in the path would name another one.
    with av.open(f"file:{scratch}", "w", "mp4") as file:
        try:
            stream = cast("VideoStream", file.add_stream(_CODEC, Fraction(fps).limit_denominator(100_000), _OPTIONS))
        except av.codec.codec.UnknownCodecError:
            lacks = f"PyAV {av.__version__} lacks the codec {_CODEC}"
            raise InputError(lacks, "PyAV's wheel", "Install av from PyPI, or write the frames as PNG") from None
        for frame in frames:
            image = checked_rgb(frame, f"frame {count}")
            if count == 0:
                shape = image.shape
                stream.width, stream.height = shape[1] + shape[1] % 2, shape[0] + shape[0] % 2
                stream.pix_fmt = "yuv420p"
            elif image.shape != shape:
                raise InputError(
                    f"frame {count} is {image.shape[1]} x {image.shape[0]} px", f"{shape[1]} x {shape[0]} px as frame 0"
                )
            even = np.pad(image, ((0, shape[0] % 2), (0, shape[1] % 2), (0, 0)), mode="edge")
            file.mux(stream.encode(av.VideoFrame.from_ndarray(even, format="rgb24")))
            count += 1
        if count:
            file.mux(stream.encode(None))
    return count
