"""Short films of a textured wall that slides by."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np

from coliags_plugin.core.images import write_image

WIDTH, HEIGHT = 160, 120


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


def write_avi(frames, path: Path, rate: int, sound: bool = False) -> Path:
    """A video of JPEG images, with a track of sound between them if asked for (8 bit, 8 kHz)."""

    def chunk(name: bytes, *parts: bytes) -> bytes:
        data = b"".join(parts)
        return name + struct.pack("<I", len(data)) + data + bytes(len(data) % 2)

    def stream(kind: bytes, codec: bytes, scale: int, per_scale: int, count: int, sample: int, detail: bytes) -> bytes:
        header = struct.pack("<4s4s10I4H", kind, codec, 0, 0, 0, scale, per_scale, 0, count, 0, 0, sample, 0, 0, 0, 0)
        return chunk(b"LIST", b"strl", chunk(b"strh", header), chunk(b"strf", detail))

    height, width = frames[0].shape[:2]
    jpeg = struct.pack("<IiiHH4sIiiII", 40, width, height, 1, 24, b"MJPG", width * height * 3, 0, 0, 0, 0)
    streams = [stream(b"vids", b"MJPG", 1, rate, len(frames), 0, jpeg)]
    samples = 8000 // rate
    if sound:
        pcm = struct.pack("<HHIIHH", 1, 1, 8000, 8000, 1, 8)
        streams.append(stream(b"auds", bytes(4), 1, 8000, samples * len(frames), 1, pcm))
    main = struct.pack("<14I", 1_000_000 // rate, 0, 0, 16, len(frames), 0, len(streams), 0, width, height, 0, 0, 0, 0)
    movie, index = b"movi", b""
    for frame in frames:
        encoded = cv2.imencode(".jpg", frame[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
        tone = (128 + 100 * np.sin(np.arange(samples))).astype(np.uint8).tobytes()
        for name, data in [(b"00dc", encoded), *([(b"01wb", tone)] if sound else [])]:
            index += name + struct.pack("<III", 16, len(movie), len(data))
            movie += chunk(name, data)
    head = chunk(b"LIST", b"hdrl", chunk(b"avih", main), *streams)
    path.write_bytes(chunk(b"RIFF", b"AVI ", head, chunk(b"LIST", movie), chunk(b"idx1", index)))
    return path


def write_images(folder: Path, frames) -> Path:
    for index, frame in enumerate(frames):
        write_image(folder / f"{index}.png", frame)
    return folder
