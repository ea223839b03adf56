"""Frames of a video file or of a folder of images, one after the other, deinterlaced, and calibrations beside them."""

from __future__ import annotations

import logging
import sys
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import user_path
from coliags_plugin.core.images import has_alpha, read_8_bit, write_image
from coliags_plugin.core.jobs import Progress, with_progress
from coliags_plugin.core.scene_files import FRAME_SUFFIXES
from coliags_plugin.engine.data_formats import videos_in
from coliags_plugin.geometry.lenses.vicalib import SUFFIX, find_calibration, read_calibration
from coliags_plugin.pipeline.settings import FrameSettings
from coliags_plugin.pipeline.video_files import AS_IMAGES, VideoFile, video_file
from coliags_plugin.reconstruction.structure.image_files import file_names, is_repeated, list_images, read_image
from coliags_plugin.reconstruction.structure.sfm_settings import SfmSettings, camera_of_lens

log = logging.getLogger(__name__)

#: Share of the frames looked at that are flagged as interlaced above which all are deinterlaced.
_FLAGGED = 0.1
#: Ratio of the differences of neighbouring rows and of rows two apart above which a frame is interlaced: 0.5 to 0.7 in
#: images, 1 for noise alone, 1.1 where that is sharpened, 1.4 to 9 where two fields show a scene that moves fast. Slow
#: motion combs little: hence the percentile, over frames that change, of a video's ratios.
_INTERLACED, _PERCENTILE = 1.3, 90.0
#: Frames that change which are looked at, from the first on, and frames among which they are sought.
_CHANGING, _LOOKED_AT = 300, 3000


@dataclass(frozen=True)
class Span:
    """Frames of a video, by their numbers in it, and how they are read."""

    first: int = 0
    last: int | None = None  # inclusive; None: to the end
    #: Whether of every frame one field is kept, and the rows of the other interpolated; None: of frames flagged so.
    deinterlace: bool | None = False

    def count(self, of: int) -> int:
        """Number of frames in a video of ``of`` frames; at least 1, so that progress has an end."""
        return max(1, (of if self.last is None else min(of, self.last + 1)) - self.first)

    def shown(self, image: UInt8[np.ndarray, "H W 3"], is_interlaced: bool) -> UInt8[np.ndarray, "H W 3"]:
        """Deinterlace a frame if ``deinterlace``, or else the frame's own flag, says so."""
        return one_field(image) if (is_interlaced if self.deinterlace is None else self.deinterlace) else image


@dataclass(frozen=True)
class FrameSource:
    """Frames of a folder of images, of a video file or of several, in order; every iteration reads them anew.

    Images are in the natural order of their names, frames of videos are numbered through.
    """

    path: Path
    span: Span = Span()  # which of them
    videos: tuple[VideoFile, ...] = ()  # none: a folder of images

    @property
    def expected(self) -> int:
        """Number of frames, at least 1: for progress, of one file about so many."""
        if not self.videos:
            return self.span.count(len(self._images))
        first, *others = self.videos
        return self.span.count(sum(video.count for video in self.videos) if others else first.expected)

    @property
    def rate(self) -> float | None:
        """Frames a second of the first file, or of all if they differ in theirs; None where it does not say."""
        if not self.videos or (rate := self.videos[0].rate) is None:
            return None
        times = self.times if len(self.videos) > 1 else None
        return rate if times is None or not _is_variable(times, rate) else float((len(times) - 1) / times[-1])

    @cached_property
    def times(self) -> Float64[np.ndarray, "N"] | None:
        """Presentation times of all frames after the first one, s, of one file after the other; None where unknown."""
        parts, start = list[Float64[np.ndarray, "N"]](), 0.0
        for video in self.videos:
            if (rate := video.rate) is None or (video.index is None and len(self.videos) == 1):
                return None
            times = np.zeros(1) if video.times is None else video.times
            missing = np.arange(1, video.count - len(times) + 1) / rate
            parts.append(start + np.append(times, times[-1] + missing))
            start = parts[-1][-1] + 1.0 / rate
        return np.concatenate(parts) if parts else None

    @property
    def is_variable(self) -> bool:
        """True if the frame rate varies: a frame is half a frame or more from its time at a constant rate."""
        return self.times is not None and self.rate is not None and _is_variable(self.times, self.rate)

    def frame_at(self, seconds: float) -> int:
        """Number of the frame that is shown at a time; InputError where the rate is unknown."""
        rate, times = self.known_rate, self.times
        if times is None:
            return round(seconds * rate)
        # The frame that is shown then, or comes within half a frame, as times are rounded.
        place = int(np.searchsorted(times, seconds + 0.5 * np.diff(times).min(initial=1.0 / rate), side="right")) - 1
        return place if place < len(times) - 1 else place + round((seconds - times[-1]) * rate)

    @property
    def known_rate(self) -> float:
        """Frames a second; InputError where the source does not tell."""
        if self.rate is None:
            lacks = f"{self.path} does not tell how many frames a second it has"
            numbers = "`every=N`, `frames.first=100`, `frames.last=400`"
            raise InputError(lacks, "a video whose header does", f"Give numbers of frames: {numbers}")
        return self.rate

    def __iter__(self) -> Iterator[tuple[str, UInt8[np.ndarray, "H W 3"]]]:
        """Names, which sort in frame order, and RGB images, all of one size.

        Names are the stems of images, or ``frame_000000``, ... by the number in the video.
        """
        return ((name, image) for name, image, _ in self.flagged())

    def flagged(self) -> Iterator[tuple[str, UInt8[np.ndarray, "H W 3"], bool]]:
        """Names and images, and whether each is flagged as interlaced."""
        shape: tuple[int, ...] | None = None
        for file, name, image, is_interlaced in self._of_videos() if self.videos else self._of_images():
            shape = shape or image.shape
            if image.shape != shape:
                raise InputError(
                    f"{file} is {image.shape[1]} x {image.shape[0]} at {name}, what is before {shape[1]} x {shape[0]}",
                    "frames of one size",
                    AS_IMAGES if self.videos else "Leave out images of other sizes",
                )
            yield name, image, is_interlaced

    def _of_images(self) -> Iterator[tuple[Path, str, UInt8[np.ndarray, "H W 3"], bool]]:
        named = [*self._images.items()]
        for name, path in named[self.span.first :][: self.span.count(len(named))]:
            yield path, name, self.span.shown(read_image(path), False), False

    @cached_property
    def _images(self) -> dict[str, Path]:
        """Image files of a folder by name."""
        images = list_images(self.path)
        return dict(zip(file_names([path.stem for path in images], ""), images, strict=True))

    def with_alpha(self, name: str, image: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W C"]:
        """A frame with the alpha channel of its image file, if it has one."""
        path = None if self.videos else self._images[name]
        return image if path is None or not has_alpha(path) else np.dstack([image, read_8_bit(path)[..., 3:]])

    def _of_videos(self) -> Iterator[tuple[Path, str, UInt8[np.ndarray, "H W 3"], bool]]:
        """Files, names, frames and flags. Where a file ends too early, and another one follows, black ones."""
        start, end = 0, sys.maxsize if self.span.last is None else self.span.last + 1
        for video in self.videos:
            is_last, first = video is self.videos[-1], max(0, self.span.first - start)
            count = sys.maxsize if is_last else video.count
            if first < (stop := min(end - start, count)):
                frames = video.frames(first, stop, not is_last, self.span.shown)
                for number, (image, is_interlaced) in enumerate(frames, start + first):
                    yield video.path, f"frame_{number:06d}", image, is_interlaced
            start += count


def _is_variable(times: Float64[np.ndarray, "N"], rate: float) -> bool:
    return bool(np.abs(times * rate - np.arange(len(times))).max() >= 0.5)


def frame_source(path: Path, span: Span = Span()) -> FrameSource:
    """The frames of a file or folder, all or some."""
    if path.is_dir():
        if videos := videos_in(path):
            return FrameSource(path, span, tuple(map(video_file, videos)))
        list_images(path)
        return FrameSource(path, span)
    if not path.exists():
        raise InputError(f"no {path}", "a video file, or a folder of images", "Check the path")
    if path.suffix.lower() in FRAME_SUFFIXES:
        raise InputError(f"{path} is a single image", "a video file, or a folder of images", "Give its folder")
    return FrameSource(path, span, (video_file(path),))


def chosen_frames(path: Path, settings: FrameSettings) -> FrameSource:
    """The frames of a file or folder that settings choose, deinterlaced as they say, or else by flags and looks."""
    source = frame_source(path, Span(settings.first, settings.last, settings.deinterlace))
    if settings.deinterlace is not None:
        return source
    stored, flags = replace(source, span=replace(source.span, deinterlace=False)), list[bool]()

    def images() -> Iterator[UInt8[np.ndarray, "H W 3"]]:
        for _, image, is_interlaced in stored.flagged():
            flags.append(is_interlaced)
            yield image

    if not (looks_interlaced(images()) or np.mean(flags) > _FLAGGED):
        return source
    log.info(
        "%s is interlaced: of every frame, which shows two moments in alternate rows, one field is kept and the rows "
        "between are interpolated (frames.deinterlace)",
        path,
    )
    return replace(source, span=replace(source.span, deinterlace=True))


def looks_interlaced(images: Iterable[UInt8[np.ndarray, "H W 3"]]) -> bool:
    """True if frames of a video show two moments each, by the first of them that differ from the one before."""
    combs, last = list[float](), None
    for image in islice(images, _LOOKED_AT):
        if last is not None and not is_repeated(last, image):
            green = image[..., 1].astype(np.int16)
            between_fields, within_field = (np.abs(green[step:] - green[:-step]).mean() for step in (1, 2))
            combs.append(float(between_fields / max(within_field, 1e-6)))
        last = image
        if len(combs) == _CHANGING:
            break
    return bool(combs) and bool(np.percentile(combs, _PERCENTILE) > _INTERLACED)


def one_field(image: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    """A frame of one moment: the even rows, from the first, and means of those above and below in place of the odd.

    The rows of an interlaced frame show two moments in turn, while a pose is that of one. Which is the earlier does not
    matter: the even rows of all frames are equally far apart in time.
    """
    whole = image.copy()
    whole[1::2] = image[:-1:2]  # the last row has none below
    whole[1:-1:2] = (image[:-2:2].astype(np.uint16) + image[2::2] + 1) // 2
    return whole


@contextmanager
def image_files(source: Path, progress: Progress | None = None) -> Iterator[list[Path]]:
    """Image files of a folder, or of a video's frames, which are written to a temporary folder without loss.

    A video that looks interlaced is deinterlaced; images of a folder are as they are.

    Raises:
        InputError: As :func:`frame_source`, or a frame cannot be read.
    """
    if not frame_source(source).videos:
        yield list_images(source)
        return
    frames = chosen_frames(source, FrameSettings())
    with tempfile.TemporaryDirectory(prefix="coliags-frames-") as scratch:
        files = []
        for name, image in with_progress(frames, "read frames", progress, frames.expected):
            files.append(Path(scratch) / f"{name}.png")
            write_image(files[-1], image)
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
            log.warning("%s has no calibration file: its camera is estimated. `camera=NAME.xml` gives one", path)
    elif camera.model.lower().endswith(SUFFIX):
        if camera.params is not None:
            raise InputError(f"`params`, and `camera={camera.model}`", "one of them", "Drop `params`")
        calibration = read_calibration(user_path(camera.model))
    else:
        calibration = None
    if calibration is None:
        return source, settings
    height, width = next(iter(frames))[1].shape[:2]
    lens, aspect = calibration.lens, frames.videos[0].aspect if len(frames.videos) == 1 else 1
    if round(lens.height * width / height) == round(lens.width * aspect):  # calibrated with pixels as they are stored
        lens = lens.resized(round(lens.width * aspect), lens.height)
    model, params = camera_of_lens(lens, str(calibration.path), width, height)
    log.info("%s: camera of %s, for frames of %d x %d", source, calibration.path, width, height)
    calibrated = camera.model_copy(update={"model": model, "params": params})
    return source, settings.model_copy(update={"camera": calibrated})
