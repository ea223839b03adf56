"""Frames of a video file or of a folder of images, one after the other."""

from __future__ import annotations

import logging
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
from jaxtyping import UInt8

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import write_image
from coliags_plugin.core.progress import Progress
from coliags_plugin.reconstruction.structure.image_files import IMAGE_SUFFIXES, file_names, list_images, read_image

if TYPE_CHECKING:
    import cv2

log = logging.getLogger(__name__)

#: Share of the frames stated by a video's header below which it is said that the others are missing.
_COMPLETE = 0.95


class FrameSource(Protocol):
    """Frames in order, read anew by every iteration."""

    @property
    def path(self) -> Path:
        """The file or folder."""

    @property
    def expected(self) -> int:
        """Number of frames by what the file says, at least 1; for progress alone."""

    def __iter__(self) -> Iterator[tuple[str, UInt8[np.ndarray, "H W 3"]]]:
        """Names, which sort in frame order, and RGB images, all of one size."""


@dataclass(frozen=True)
class ImageFolder:
    """Images of a folder, in the natural order of their names."""

    path: Path

    @property
    def expected(self) -> int:
        """Number of images."""
        return len(list_images(self.path))

    def __iter__(self) -> Iterator[tuple[str, UInt8[np.ndarray, "H W 3"]]]:
        """Stems of the file names, and images; see :class:`FrameSource`."""
        images = list_images(self.path)
        shape: tuple[int, ...] | None = None
        for name, path in zip(file_names([path.stem for path in images], ""), images, strict=True):
            image = read_image(path)
            shape = shape or image.shape
            if image.shape != shape:
                raise InputError(
                    f"{path} is {image.shape[1]} x {image.shape[0]}, {images[0].name} {shape[1]} x {shape[0]}",
                    "frames of one size",
                    "Leave out images of other sizes",
                )
            yield name, image


@dataclass(frozen=True)
class VideoFile:
    """Frames of a video file, decoded by OpenCV."""

    path: Path

    @property
    def expected(self) -> int:
        """Number of frames by the file's header."""
        import cv2

        video = _opened(self.path)
        try:
            return max(1, int(video.get(cv2.CAP_PROP_FRAME_COUNT)))
        finally:
            video.release()

    def __iter__(self) -> Iterator[tuple[str, UInt8[np.ndarray, "H W 3"]]]:
        """Names ``frame_000000``, ... by their number in the video, and images; see :class:`FrameSource`."""
        expected = self.expected
        video = _opened(self.path)
        count, shape = 0, None
        try:
            while True:
                there, image = video.read()
                if not there:
                    break
                shape = shape or image.shape
                if image.shape != shape:
                    raise InputError(
                        f"{self.path}: the size changes at frame {count}", "frames of one size", _AS_IMAGES
                    )
                yield f"frame_{count:06d}", np.ascontiguousarray(image[..., ::-1])
                count += 1
        finally:
            video.release()
        if count == 0:
            raise InputError(f"no frame of {self.path} can be decoded", "a video whose codec OpenCV has", _AS_IMAGES)
        if count < _COMPLETE * expected:
            log.warning("%s: %d frames, though its header says %d: is it complete?", self.path, count, expected)


_AS_IMAGES = "Make images with ffmpeg -i VIDEO FOLDER/%06d.png and give the folder"


def frame_source(path: Path) -> FrameSource:
    """The frames of a file or folder."""
    if path.is_dir():
        list_images(path)
        return ImageFolder(path)
    if not path.exists():
        raise InputError(f"no {path}", "a video file, or a folder of images", "Check the path")
    if path.suffix.lower() in IMAGE_SUFFIXES:
        raise InputError(f"{path} is a single image", "a video file, or a folder of images", "Give its folder")
    _opened(path).release()
    return VideoFile(path)


def _opened(path: Path) -> cv2.VideoCapture:
    import cv2

    # FFmpeg and OpenCV write messages of their own to stderr; what they come to is said by the error.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    finally:
        cv2.utils.logging.setLogLevel(level)
    if not video.isOpened():
        size = path.stat().st_size
        raise InputError(
            f"{path} ({size} bytes) cannot be opened as a video by OpenCV {cv2.__version__}",
            "a video file with a codec of FFmpeg, for instance .mp4, .avi or .mov",
            f"Fetch it again if it is incomplete. {_AS_IMAGES}",
        )
    return video


@contextmanager
def image_files(
    source: Path,
    progress: Progress | None = None,
    look: Callable[[UInt8[np.ndarray, "H W 3"]], None] | None = None,
) -> Iterator[list[Path]]:
    """Image files of a folder, or of a video's frames, which are written to a temporary folder without loss.

    ``look`` is given every frame of a video.

    Raises:
        InputError: As :func:`frame_source`, or a frame cannot be read.
    """
    frames = frame_source(source)
    if isinstance(frames, ImageFolder):
        yield list_images(source)
        return
    with tempfile.TemporaryDirectory(prefix="coliags-frames-") as scratch:
        files = []
        expected = frames.expected
        for done, (name, image) in enumerate(frames, start=1):
            files.append(Path(scratch) / f"{name}.png")
            write_image(files[-1], image)
            if look is not None:
                look(image)
            if progress is not None:
                progress("read frames", done, max(done, expected))
        yield files
