"""Short films of a textured wall that slides by."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np

from coliags_plugin.core.images import write_image

WIDTH, HEIGHT = 160, 120
#: Settings of a camera that is known.
KNOWN = {"sfm.camera.model": "PINHOLE", "sfm.camera.params": (100.0, 100.0, 80.0, 60.0)}


def wall(seed: int = 0) -> np.ndarray:
    """A smooth random pattern, twice as wide as a frame. [H, 2 W, 3]"""
    noise = np.random.default_rng(seed).normal(size=(HEIGHT, 2 * WIDTH, 3))
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return np.clip(np.array([150.0, 110.0, 90.0]) + 30.0 * smooth / smooth.std(), 5, 235).astype(np.uint8)


def film(places, seed: int = 0) -> list[np.ndarray]:
    """Frames of the wall from columns on. [H, W, 3] each"""
    whole = wall(seed)
    return [np.ascontiguousarray(whole[:, place : place + WIDTH]) for place in places]


def blurred(image: np.ndarray, sigma: float = 4.0) -> np.ndarray:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma))


def numbered(count: int, height: int = 48, width: int = 64) -> list[np.ndarray]:
    """Frames whose red tells their number."""
    ramp = np.linspace(10, 240, width).astype(np.uint8)
    down = np.linspace(10, 240, height).astype(np.uint8)
    return [
        np.stack(np.broadcast_arrays(np.uint8(20 + 5 * number), ramp, down[:, None]), axis=2) for number in range(count)
    ]


def number_of(image: np.ndarray) -> int:
    """Number of one of these frames; -4 where it is black."""
    return round((float(np.median(image[..., 0])) - 20) / 5)


def write_film(frames, target, codec="libx264", rate=20, *, kind=None, times=None, sound=False, muxing=None, second=(),
               turn=None, aspect=1, pix_fmt="yuv420p", **options):  # fmt: skip
    """A video by a codec of PyAV; frames are at ``times``, ms, beside a track of sound and a second video, if given.

    ``target`` may also be a file that is open for writing; then ``kind`` names the container.
    """
    name = f"file:{target}" if isinstance(target, Path) else target
    with av.open(name, "w", kind, container_options=muxing or {}) as file:
        films = []
        for images in filter(len, (frames, second)):
            stream = file.add_stream(codec, rate, {key: str(value) for key, value in options.items()})
            stream.height, stream.width, stream.pix_fmt = *images[0].shape[:2], pix_fmt
            stream.codec_context.sample_aspect_ratio = Fraction(aspect)
            if times is not None:
                stream.codec_context.time_base = Fraction(1, 1000)
            if turn is not None:
                stream.set_display_rotation(*turn)
            films.append((stream, images))
        track = file.add_stream("pcm_s16le", 8000, layout="mono") if sound else None
        for stream, images in films:
            for number, image in enumerate(images):
                frame = av.VideoFrame.from_ndarray(image, format="rgb24")
                if times is not None:
                    frame.pts, frame.time_base = times[number], Fraction(1, 1000)
                file.mux(stream.encode(frame))
                if track is not None:
                    tone = (8000 * np.sin(np.arange(8000 // rate)))[None].astype(np.int16)
                    noise = av.AudioFrame.from_ndarray(tone, format="s16", layout="mono")
                    noise.sample_rate = 8000
                    file.mux(track.encode(noise))
            file.mux(stream.encode(None))
    return target


def write_images(folder: Path, frames) -> Path:
    for index, frame in enumerate(frames):
        write_image(folder / f"{index}.png", frame)
    return folder
