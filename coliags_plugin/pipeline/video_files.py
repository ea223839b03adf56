"""Video files, decoded by PyAV: frames by their numbers, with their times and shapes."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property, lru_cache
from itertools import chain, islice, takewhile
from pathlib import Path
from typing import Any, NamedTuple

import av
import cv2
import numpy as np
from av import Packet, VideoFrame
from av.container import InputContainer
from av.stream import Disposition
from av.video.stream import VideoStream
from jaxtyping import Float64, Int64, UInt8

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.text_files import unreadable

log = logging.getLogger(__name__)

#: Share of the frames stated by a video's header below which it is said that the others are missing.
_COMPLETE = 0.95
#: Frames a second that no header states in earnest.
FASTEST = 1000.0
#: Ratio of the sides of a pixel that is in earnest, at most.
_STRETCHED = 8
#: Places by which packets precede or follow their place by time, at most: 16 frames in H.264 and HEVC.
_REORDERED = 32
#: Bytes of a packet of MPEG-4 part 2 that says that there is no new frame, at most.
_EMPTY = 12
#: Share of even steps between frames above which longer ones are taken for frames that were lost.
_EVEN = 0.9
#: Frames, from three key frames on, whose times are compared with those of packets before these are believed.
_COMPARED = 16

AS_IMAGES = "Make images with ffmpeg -i VIDEO FOLDER/%06d.png and give the folder"


class Key(NamedTuple):
    """A frame from which decoding can begin."""

    time: int  # of presentation
    size: int  # bytes
    before: int  # decoding time of the key frame before: packets behind the place sought may have wrong times


@dataclass(frozen=True, eq=False)
class VideoIndex:
    """Times of a file's frames by its packets, in units of the stream."""

    times: Int64[np.ndarray, "N"]  # presentation times of the frames, ascending
    keys: Int64[np.ndarray, "K 3"]  # of frames to begin decoding from: presentation and decoding times, bytes
    unit: Fraction  # seconds
    stated: int  # number of frames that the file should have: more than N where it is cut off

    @property
    def room(self) -> int:
        """Number of frames for which there is time in the file if its rate is nearly constant; else N."""
        steps = np.diff(self.times, append=2 * self.times[-1] - self.times[-2:][0])
        step = np.median(steps)
        is_even = np.mean(np.abs(steps - step) <= max(0.1 * step, 1)) > _EVEN
        return round(steps.sum() / step) if is_even and step else len(self.times)

    def key_before(self, number: int) -> Key | None:
        """The last key frame at or before a frame, by its number; None if that is the first key frame."""
        place = int(np.searchsorted(self.keys[:, 0], self.times[: number + 1][-1], side="right")) - 1
        if place < 1:
            return None
        time, _, size = self.keys[place].tolist()
        return Key(time, size, int(self.keys[place - 1, 1]))


class VideoFile:
    """A video file, decoded anew by every iteration; frame n is what follows n frames, in every container.

    Raises:
        InputError: The file cannot be opened, or has no video.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with self.opened() as (container, stream):
            width, height = stream.width, stream.height
            if (count := len(_videos(container))) > 1:
                what = "%s has %d video streams: number %d is used, of %d x %d"
                log.warning(what, path, count, stream.index, width, height)
        if (square := round(width * self.aspect)) != width:
            what = "%s has pixels that are not square (%s) and is read as %d x %d: `params` and `mask` are of that size"
            log.warning(what, path, self.aspect, square, height)

    @contextmanager
    def opened(self) -> Iterator[tuple[InputContainer, VideoStream]]:
        """The file and its video, which is no cover picture; InputError where there is none."""
        try:
            # Without the protocol, a name such as 12:30.mp4 would have one.
            container = av.open(f"file:{self.path}", metadata_errors="replace")
        except (av.FFmpegError, OSError) as error:
            raise unreadable(
                self.path,
                f"{self.path} ({self.path.stat().st_size} bytes) cannot be opened as a video by FFmpeg "
                f"({getattr(error, 'strerror', None) or error})",
                "a video file with a codec of FFmpeg, for instance .mp4, .avi or .mov",
                f"Fetch it again if it is incomplete. {AS_IMAGES}",
            ) from None
        with container:
            if not (videos := _videos(container)):
                kinds = ", ".join(each.type for each in container.streams) or "none"
                raise InputError(f"{self.path} has no video among its streams ({kinds})", "a video", "Check the path")
            decodable = [each for each in videos if each.codec_context is not None]
            if not decodable:
                raise InputError(f"FFmpeg does not know the codec of {self.path}", "another one", AS_IMAGES)
            yield container, max(decodable, key=lambda stream: stream.width * stream.height)

    @cached_property
    def aspect(self) -> Fraction:
        """Width of a pixel as stored over its height; 1 where the file does not say, in earnest."""
        with self.opened() as (_, stream):
            ratio = stream.sample_aspect_ratio or Fraction(1)
            return ratio if 1 / _STRETCHED <= ratio <= _STRETCHED else Fraction(1)

    @property
    def index(self) -> VideoIndex | None:
        """Times of the frames, for which the file is read once; None where packets do not tell them."""
        return self._packets[0]

    @property
    def expected(self) -> int:
        """Number of frames that the file should have, or of packets where these do not tell; at least 1."""
        return max(1, self._packets[1] if self.index is None else self.index.stated)

    @cached_property
    def count(self) -> int:
        """Number of frames, those included that a file which is cut off lacks at its end; at least 1."""
        if self.index is not None:
            return max(1, self.index.stated)
        return max(1, sum(frame is not None for frame in self.decoded()))

    @cached_property
    def rate(self) -> float | None:
        """Frames a second, the mean of a variable rate; None where nothing tells."""
        with self.opened() as (_, stream):
            rate = float(stream.average_rate or 0.0)
        stated, times, index = rate if 0.0 < rate < FASTEST else None, self.times, self.index
        if times is None or index is None or len(times) < 2:
            return stated
        numbers = np.arange(len(times))
        if stated is not None and np.abs(times - numbers / stated).max() <= 1.01 * index.unit:
            return stated
        return float(numbers[-1] / times[-1])

    @property
    def times(self) -> Float64[np.ndarray, "N"] | None:
        """Presentation times of the frames after that of the first, s; None where packets do not tell them."""
        index = self.index
        return None if index is None else (index.times - index.times[0]) * float(index.unit)

    def frames(
        self, first: int, stop: int, is_filled: bool, shown: Callable[[np.ndarray, bool], np.ndarray]
    ) -> Iterator[tuple[UInt8[np.ndarray, "H W 3"], bool]]:
        """Images from frame ``first`` up to ``stop``, and whether each is flagged as interlaced.

        Where the file is damaged and goes on behind that, the frames between are black, and, with ``is_filled``, those
        before ``stop`` that it lacks. ``shown`` is applied to images and flags as they are stored, before pixels become
        square and images are turned as the file says.
        """
        count, concealed = 0, 0
        for number, frame in self._numbered(first):
            image, behind = self._picture(frame, shown), min(number, stop)
            if behind > first + count:
                log.warning("%s: frames %d to %d cannot be decoded: black here", self.path, first + count, number - 1)
            while behind > first + count:
                yield np.zeros(image.shape, np.uint8), False
                count += 1
            if number < stop:
                concealed += frame.is_corrupt
                yield image, frame.interlaced_frame
                count += 1
            if number + 1 >= stop:
                break
        if concealed:
            log.warning("%s: damaged frames, %d, are shown as far as they can be decoded", self.path, concealed)
        if is_filled and count < stop - first:
            shape = image.shape if count else next(self.frames(0, 1, False, shown))[0].shape
            yield from ((np.zeros(shape, np.uint8), False) for _ in range(first + count, stop))
        elif count == 0 and first > 0:
            raise InputError(f"{self.path} has no frame {first}", f"one of about {self.expected} frames")
        elif count == 0:
            raise InputError(f"no frame of {self.path} can be decoded", "a video whose codec FFmpeg has", AS_IMAGES)
        if (index := self.index) is None:
            return
        if count < _COMPLETE * (stated := min(stop, index.stated) - first):
            log.warning("%s: %d frames, though its header says %d: is it complete?", self.path, count, stated)
        elif first == 0 and count < min(stop, _COMPLETE * index.room):
            what = "%s: %d frames, though there is time for %d: some are missing in between"
            log.warning(what, self.path, count, index.room)

    def _picture(
        self, frame: VideoFrame, shown: Callable[[np.ndarray, bool], np.ndarray]
    ) -> UInt8[np.ndarray, "H W 3"]:
        """Convert a frame to RGB with square pixels, turned as the file says; columns alone are resampled."""
        try:
            image: Any = frame.to_ndarray(format="rgb24", interpolation="BICUBIC", threads=1)
        except av.FFmpegError as error:
            problem = f"FFmpeg does not convert {frame.format.name} with the colour matrix {frame.colorspace}"
            raise InputError(f"{self.path}: {problem}: {error.strerror}", "BT.601 or BT.709", AS_IMAGES) from None
        image = shown(image, frame.interlaced_frame)
        height, width = image.shape[:2]
        if (square := round(width * self.aspect)) != width:
            image = cv2.resize(
                image, (square, height), interpolation=cv2.INTER_AREA if square < width else cv2.INTER_LINEAR
            )
        turn: Any = frame.side_data.get("DISPLAYMATRIX")
        if turn is not None:
            matrix = np.frombuffer(turn, np.int32)
            if matrix[0] == 0:  # columns become rows
                image, right, down = image.swapaxes(0, 1), matrix[3], matrix[1]
            else:
                right, down = matrix[0], matrix[4]
            image = image[:: -1 if down < 0 else 1, :: -1 if right < 0 else 1]
        return np.ascontiguousarray(image)

    def _numbered(self, first: int) -> Iterator[tuple[int, VideoFrame]]:
        """Numbers and frames from ``first`` on; behind damaged frames, numbers follow from presentation times."""
        number, frames = self._sought(first) if first > 0 else (0, self.decoded())
        for frame in frames:
            if frame is None:
                # Of a file whose first frame cannot be decoded, FFmpeg may take packets of gigabytes for others.
                if number > 0:
                    yield from self._behind_damage(max(number, first))
                return
            if number >= first:
                yield number, frame
            number += 1

    def _sought(self, first: int) -> tuple[int, Iterator[VideoFrame | None]]:
        """Seek frame ``first`` by its time, or else start from 0: the number of the first frame, and frames."""
        index = self.index
        if index is not None and first >= len(index.times):
            return first, iter(())
        if index is None or (key := index.key_before(first)) is None:
            return 0, self.decoded()
        frames, time = self.decoded(key), int(index.times[first])
        for frame in frames:
            if frame is None or frame.pts == time:
                return first, chain([frame], frames)
            if frame.pts is None or frame.pts > time:
                break
        return 0, self.decoded()

    def _behind_damage(self, first: int) -> Iterator[tuple[int, VideoFrame]]:
        """Numbers and frames from ``first`` on, decoded by one thread, as several lose frames beside damaged ones.

        Where packets do not tell times, what cannot be decoded has no number.
        """
        index, number = self.index, 0
        for frame in self.decoded(None if index is None else index.key_before(first), threads=1):
            if frame is None:
                continue
            if index is not None:
                number = int(np.searchsorted(index.times, np.int64(frame.pts or 0)))
            if number >= first:
                yield number, frame
            number += 1

    @cached_property
    def _packets(self) -> tuple[VideoIndex | None, int]:
        """Index of the file, None where its packets lack times, and their number."""
        shown, keys = list[int | None](), list[tuple[int, int, int]]()
        begin, end = np.inf, -np.inf  # of all streams, s
        with self.opened() as (container, stream):
            codec = stream.codec_context.name
            for packet in _filled(container):
                time = packet.dts if packet.pts is None else packet.pts
                if time is not None and packet.time_base is not None:
                    begin = min(begin, float(time * packet.time_base))
                    end = max(end, float((time + (packet.duration or 0)) * packet.time_base))
                if packet.stream_index == stream.index:
                    if packet.is_keyframe and packet.pts is not None:
                        keys.append((packet.pts, packet.pts if packet.dts is None else packet.dts, packet.size))
                    # VP8 marks packets that show nothing; in MPEG-4 part 2 they are short, as real frames may be.
                    is_shown = not packet.is_discard and (codec != "vp8" or bool(bytes(packet)[0] & 0x10))
                    is_sure = codec != "mpeg4" or packet.size > _EMPTY
                    shown += [packet.pts if is_sure else None] if is_shown else []
            unit, seconds = stream.time_base or Fraction(1), (container.duration or 0) / 1e6
            # The header of MP4 and MOV lists all frames; that of AVI may state nonsense, of which the length is then.
            entries = stream.index_entries if "mp4" in container.format.name else ()
            listed = sum(not entry.is_discard for entry in entries)
            if not listed and stream.frames <= self.path.stat().st_size and 0.0 < end - begin < _COMPLETE * seconds:
                listed = stream.frames or round(len(shown) * seconds / (end - begin))
        packets = np.array([time for time in shown if time is not None], np.int64)
        order = np.argsort(packets, kind="stable")
        times, places = packets[order], np.arange(len(order))
        is_even = len(times) == len(shown) and (np.diff(times) > 0).all()
        is_even = is_even and (np.abs(order - places) <= _REORDERED).all()
        if not keys or not is_even or (start := next(self.decoded(), None)) is None or start.pts is None:
            return None, len(shown)
        times = times[times >= start.pts]
        index = VideoIndex(times, np.array(sorted(keys), np.int64), unit, max(len(times), listed))
        looked_at = {index.key_before(number) for number in (0, len(times) // 2, len(times) - 1)} if len(times) else {}
        return index if looked_at and all(self._is_right(index, key) for key in looked_at) else None, len(shown)

    def _is_right(self, index: VideoIndex, key: Key | None) -> bool:
        """Return True if frames decoded from a key frame on have the index's times, up to the first damaged one."""
        whole = takewhile(lambda frame: frame is not None, self.decoded(key))
        times = (frame.pts for frame in islice(whole, _COMPARED) if frame is not None)
        decoded = [time for time in times if time is not None and (key is None or time >= key.time)]
        place = np.searchsorted(index.times, decoded[0]) if decoded else 0
        return index.times[place:][: len(decoded)].tolist() == decoded

    def decoded(self, key: Key | None = None, threads: int = 0) -> Iterator[VideoFrame | None]:
        """Decode frames from the start or a key frame on; yields None for a damaged stretch before the next key frame.

        A stream may begin between key frames: what cannot be decoded before the first of them is no frame.
        """
        with self.opened() as (container, stream):
            codec, is_lost, is_before = stream.codec_context, False, False
            codec.thread_type, codec.thread_count = "AUTO", threads
            if key is not None:
                with suppress(av.FFmpegError):  # all is read then
                    container.seek(key.before, stream=stream)
            is_first = key is None
            for packet in _filled(container, stream):
                if key is not None and not (packet.is_keyframe and (packet.pts, packet.size) == (key.time, key.size)):
                    continue
                key, is_first, is_before = None, False, is_before or (is_first and not packet.is_keyframe)
                if is_lost and not packet.is_keyframe:
                    continue
                is_lost = False
                try:
                    frames = codec.decode(packet)
                except av.FFmpegError:
                    if not is_before:
                        is_lost = True
                        with suppress(av.FFmpegError):
                            yield from codec.decode(None)  # those held back for their order
                        yield None
                        codec.flush_buffers()
                    continue
                is_before = is_before and not frames
                yield from frames
            if not is_lost:
                with suppress(av.FFmpegError):
                    yield from codec.decode(None)


def _videos(container: InputContainer) -> list[VideoStream]:
    """Streams of video, without cover pictures."""
    return [each for each in container.streams.video if not each.disposition & Disposition.attached_pic]


def _filled(container: InputContainer, *streams: VideoStream) -> Iterator[Packet]:
    """Packets that hold something, of some streams or of all, as far as the file can be read."""
    with suppress(av.FFmpegError, IndexError):  # at the end, of streams that begin within the file
        for packet in container.demux(*streams):
            if packet.size:
                yield packet


def video_file(path: Path) -> VideoFile:
    """A video file, which is read and warned of once while it is not changed."""
    status = path.stat()
    return _video_file(path, status.st_size, status.st_mtime_ns)


@lru_cache(maxsize=64)
def _video_file(path: Path, size: int, modified: int) -> VideoFile:
    return VideoFile(path)
