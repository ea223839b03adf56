"""Frames of a video file or of a folder of images, one after the other, and calibrations beside them."""

from __future__ import annotations

import logging
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import UInt8

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import user_path
from coliags_plugin.core.images import has_alpha, read_8_bit, write_image
from coliags_plugin.core.progress import Progress
from coliags_plugin.datamanagers.reading.files import FRAME_SUFFIXES
from coliags_plugin.datamanagers.recognition import videos_in
from coliags_plugin.geometry.lenses.vicalib import SUFFIX, find_calibration, read_calibration
from coliags_plugin.pipeline.frame_selection import looks_interlaced, one_field
from coliags_plugin.pipeline.settings import FrameSettings
from coliags_plugin.reconstruction.structure.image_files import file_names, list_images, read_image
from coliags_plugin.reconstruction.structure.sfm_settings import SfmSettings, camera_of_lens

if TYPE_CHECKING:
    import cv2

log = logging.getLogger(__name__)

#: Share of the frames stated by a video's header below which it is said that the others are missing.
_COMPLETE = 0.95
#: Frames a second that no header states in earnest.
_FASTEST = 1000.0


@dataclass(frozen=True)
class Span:
    """Frames of a video, by their numbers in it, and how they are read."""

    first: int = 0
    last: int | None = None  # inclusive; None: to the end
    seek: bool = True  # whether the first is sought, or all before it are decoded
    deinterlace: bool = False  # whether of every frame one field is kept, and the rows of the other interpolated

    def count(self, of: int) -> int:
        """How many there are in a video of so many frames; at least 1, so that progress has an end."""
        return max(1, (of if self.last is None else min(of, self.last + 1)) - self.first)

    def shown(self, image: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
        """A frame as it is read."""
        return one_field(image) if self.deinterlace else image


@dataclass(frozen=True)
class FrameSource:
    """Frames of a folder of images, of a video file or of several, in order; every iteration reads them anew.

    Images are in the natural order of their names, frames of videos numbered through by what their headers say.
    """

    path: Path
    span: Span = Span()  # which of them
    videos: tuple[Path, ...] = ()  # files, decoded by OpenCV; none: a folder of images

    @property
    def expected(self) -> int:
        """Number of frames by what files say, at least 1; for progress alone."""
        return self.span.count(sum(count for _, count in self._headers) or len(list_images(self.path)))

    @property
    def rate(self) -> float | None:
        """Frames a second by the first file's header; None where it does not say, and of images."""
        rate = self._headers[0][0] if self.videos else 0.0
        return rate if 0.0 < rate < _FASTEST else None

    @cached_property
    def _headers(self) -> list[tuple[float, int]]:
        """Frames a second, and frames, of each video."""
        import cv2

        found = []
        for file in self.videos:
            video = _opened(file)
            count = max(1, int(video.get(cv2.CAP_PROP_FRAME_COUNT)))
            found.append((video.get(cv2.CAP_PROP_FPS), count))
            video.release()
        return found

    def __iter__(self) -> Iterator[tuple[str, UInt8[np.ndarray, "H W 3"]]]:
        """Names, which sort in frame order, and RGB images, all of one size.

        Names are the stems of images, or ``frame_000000``, ... by the number in the video.
        """
        shape: tuple[int, ...] | None = None
        for file, name, image in self._of_videos() if self.videos else self._of_images():
            shape = shape or image.shape
            if image.shape != shape:
                raise InputError(
                    f"{file} is {image.shape[1]} x {image.shape[0]} at {name}, what is before {shape[1]} x {shape[0]}",
                    "frames of one size",
                    _AS_IMAGES if self.videos else "Leave out images of other sizes",
                )
            yield name, self.span.shown(image)

    def _of_images(self) -> Iterator[tuple[Path, str, UInt8[np.ndarray, "H W 3"]]]:
        named = [*self._images.items()]
        for name, path in named[self.span.first :][: self.span.count(len(named))]:
            yield path, name, read_image(path)

    @cached_property
    def _images(self) -> dict[str, Path]:
        """Image files of a folder by name."""
        images = list_images(self.path)
        return dict(zip(file_names([path.stem for path in images], ""), images, strict=True))

    def with_alpha(self, name: str, image: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W C"]:
        """A frame with the alpha channel of its image file, if it has one."""
        path = None if self.videos else self._images[name]
        return image if path is None or not has_alpha(path) else np.dstack([image, read_8_bit(path)[..., 3:]])

    def _of_videos(self) -> Iterator[tuple[Path, str, UInt8[np.ndarray, "H W 3"]]]:
        """Files, names and frames. Where a file ends too early, and another one follows, black ones."""
        start, end = 0, sys.maxsize if self.span.last is None else self.span.last + 1
        for file, (_, count) in zip(self.videos, self._headers, strict=True):
            number, stop = max(0, self.span.first - start), end - start
            is_last = file == self.videos[-1]
            if not is_last:
                stop = min(stop, count)
            if number < stop:
                for image in _decoded(file, number, stop, self.span.seek, count):
                    yield file, f"frame_{start + number:06d}", image
                    number += 1
                for missing in range(number, 0 if is_last else stop):
                    yield file, f"frame_{start + missing:06d}", np.zeros_like(image)
            start += count


def _decoded(file: Path, first: int, stop: int, seek: bool, total: int) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
    """Frames of a video of ``total`` frames by its header, from one on as far as there are.

    Where the file is damaged and goes on behind that, the frames between are black.
    """
    video, done = _opened(file), 0
    try:
        number = _go_to(video, first, seek)
        while number < stop:
            there, image = video.read()
            if not there:
                # Of a file whose first frame cannot be decoded, FFmpeg may take packets of gigabytes for others.
                found = _beyond_damage(video, number, total - 1) if number > 0 else None
                if found is None:
                    break
                behind, image = found
                log.warning("%s: frames %d to %d cannot be decoded: black here", file, number, behind - 1)
                for _ in range(max(number, first), min(behind, stop)):
                    yield np.zeros(image.shape, np.uint8)
                    done += 1
                number = behind
            if first <= number < stop:
                yield np.ascontiguousarray(image[..., ::-1])
                done += 1
            number += 1
    finally:
        video.release()
    if done == 0 and first > 0:
        raise InputError(f"{file} has no frame {first}", f"one of about {total} frames")
    if done == 0:
        raise InputError(f"no frame of {file} can be decoded", "a video whose codec OpenCV has", _AS_IMAGES)
    if done < _COMPLETE * (expected := min(stop, total) - first):
        log.warning("%s: %d frames, though its header says %d: is it complete?", file, done, expected)


def _go_to(video: cv2.VideoCapture, first: int, seek: bool) -> int:
    """Have a frame come next; returns its number, or where the video ended before it."""
    import cv2

    if seek and first > 0 and video.set(cv2.CAP_PROP_POS_FRAMES, first):
        if round(video.get(cv2.CAP_PROP_POS_FRAMES)) == first:
            return first
        video.set(cv2.CAP_PROP_POS_FRAMES, 0)
    for number in range(first):
        if not video.grab():
            return number
    return first


def _beyond_damage(video: cv2.VideoCapture, number: int, last: int) -> tuple[int, np.ndarray] | None:
    """The first frame after one that cannot be decoded, looked for farther and farther on and then back; its number."""
    if number >= last:
        return None
    lost, found = number, number + 1
    while _sought(video, found) is None:
        if found == last:
            return None
        lost, found = found, min(last, found + max(1, (found - number) // 4))
    while found - lost > 1:
        middle = (lost + found) // 2
        lost, found = (middle, found) if _sought(video, middle) is None else (lost, middle)
    image = _sought(video, found)
    return None if image is None else (found, image)


def _sought(video: cv2.VideoCapture, number: int) -> np.ndarray | None:
    """A frame by its number; None where it cannot be decoded."""
    import cv2

    if not video.set(cv2.CAP_PROP_POS_FRAMES, number):
        return None
    there, image = video.read()
    return image if there and round(video.get(cv2.CAP_PROP_POS_FRAMES)) == number + 1 else None


_AS_IMAGES = "Make images with ffmpeg -i VIDEO FOLDER/%06d.png and give the folder"


def frame_source(path: Path, span: Span = Span()) -> FrameSource:
    """The frames of a file or folder, all or some."""
    if path.is_dir():
        if videos := videos_in(path):
            return FrameSource(path, span, tuple(videos))
        list_images(path)
        return FrameSource(path, span)
    if not path.exists():
        raise InputError(f"no {path}", "a video file, or a folder of images", "Check the path")
    if path.suffix.lower() in FRAME_SUFFIXES:
        raise InputError(f"{path} is a single image", "a video file, or a folder of images", "Give its folder")
    _opened(path).release()
    return FrameSource(path, span, (path,))


def chosen_frames(path: Path, settings: FrameSettings) -> FrameSource:
    """The frames of a file or folder that settings choose, deinterlaced if they say so, or leave it to how it looks."""
    source = frame_source(path, Span(settings.first, settings.last, settings.seek, bool(settings.deinterlace)))
    if settings.deinterlace is None and looks_interlaced(image for _, image in source):
        log.info(
            "%s looks interlaced: of every frame, which shows two moments in alternate rows, one field is kept and the "
            "rows between are interpolated (frames.deinterlace)",
            path,
        )
        return replace(source, span=replace(source.span, deinterlace=True))
    return source


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


def watched(
    source: FrameSource, what: str, progress: Progress | None
) -> Iterator[tuple[str, UInt8[np.ndarray, "H W 3"]]]:
    """Names and images of a source; each is reported when the next one is asked for."""
    expected = source.expected
    for done, frame in enumerate(source, start=1):
        yield frame
        if progress is not None:
            progress(what, done, max(done, expected))


def every_of(source: FrameSource, rate: float) -> int:
    """Of how many frames one is used for about so many a second.

    Raises:
        InputError: ``rate`` is no positive number, or the source does not tell how many frames a second it has.
    """
    if not 0.0 < rate < _FASTEST:
        raise InputError(f"--frames-per-second {rate:g}", f"a number between 0 and {_FASTEST:g}")
    own = source.rate
    if own is None:
        raise InputError(
            f"--frames-per-second {rate:g}, and {source.path} does not tell how many frames a second it has",
            "a video whose header does",
            "Use one of every n frames: --every N",
        )
    every = max(1, round(own / rate))
    what = "%s has %.4g frames a second: the sharpest of every %d is used, %.3g a second"
    log.info(what, source.path, own, every, own / every)
    return every


def frame_at(source: FrameSource, time: str) -> int:
    """Number of the frame at a time such as ``200``, ``3:20`` or ``1:02:03.5`` (seconds, minutes, hours).

    Raises:
        InputError: This is no time, or the source does not tell how many frames a second has.
    """
    try:
        parts = [float(part) for part in time.split(":")]
        if len(parts) > 3 or min(parts) < 0.0:
            raise ValueError
    except ValueError:
        raise InputError(
            f"the time '{time}'", "seconds, or hours, minutes and seconds such as 3:20 or 1:02:03.5"
        ) from None
    rate = source.rate
    if rate is None:
        raise InputError(
            f"the time {time}, and {source.path} does not tell how many frames a second it has",
            "a video whose header does",
            "Give numbers of frames: --set frames.first=100 --set frames.last=400",
        )
    return round(sum(part * 60.0**power for power, part in enumerate(reversed(parts))) * rate)


@contextmanager
def image_files(
    source: Path,
    progress: Progress | None = None,
    look: Callable[[UInt8[np.ndarray, "H W 3"]], None] | None = None,
) -> Iterator[list[Path]]:
    """Image files of a folder, or of a video's frames, which are written to a temporary folder without loss.

    ``look`` is given every frame of a video. A video that looks interlaced is deinterlaced; images of a folder are as
    they are.

    Raises:
        InputError: As :func:`frame_source`, or a frame cannot be read.
    """
    if not frame_source(source).videos:
        yield list_images(source)
        return
    frames = chosen_frames(source, FrameSettings())
    with tempfile.TemporaryDirectory(prefix="coliags-frames-") as scratch:
        files = []
        for name, image in watched(frames, "read frames", progress):
            files.append(Path(scratch) / f"{name}.png")
            write_image(files[-1], image)
            if look is not None:
                look(image)
        yield files


def opened_recording(path: Path, settings: SfmSettings) -> tuple[Path, SfmSettings]:
    """The one video of a recording's folder, or else what was given itself; and its camera in the settings.

    The camera is that of the calibration file that the settings name as its model, or, where they name none, of the
    one in the folder; it is scaled to the frames. Without either, the settings are unchanged.

    Raises:
        InputError: As :func:`frame_source`; or a calibration is missing, damaged or of another frame.
    """
    videos = videos_in(path) if path.is_dir() else []
    source = videos[0] if len(videos) == 1 else path
    frames, camera = frame_source(source), settings.camera
    if camera.model is None:
        calibration = find_calibration(path)
        if calibration is None and videos:
            log.warning("%s has no calibration file: its camera is estimated. --camera NAME.xml gives one", path)
    elif camera.model.lower().endswith(SUFFIX):
        if camera.params is not None:
            raise InputError(f"--params, and --camera {camera.model}", "one of them", "Drop --params")
        calibration = read_calibration(user_path(camera.model))
    else:
        calibration = None
    if calibration is None:
        return source, settings
    height, width = next(iter(frames))[1].shape[:2]
    model, params = camera_of_lens(calibration.lens, str(calibration.path), width, height)
    log.info("%s: camera of %s, for frames of %d x %d", source, calibration.path, width, height)
    known = camera.model_copy(update={"model": model, "params": params})
    return source, settings.model_copy(update={"camera": known})
