"""Short films of a textured wall that slides by."""

from __future__ import annotations

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


def write_images(folder: Path, frames) -> Path:
    for index, frame in enumerate(frames):
        write_image(folder / f"{index}.png", frame)
    return folder
