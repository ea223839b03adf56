"""Observations of a COLMAP model as arrays, and the correlation of their depth with brightness."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int, UInt8

if TYPE_CHECKING:
    import pycolmap

#: Observations of an image below which it does not count for the correlation.
_FEWEST = 8
#: Side of the square whose mean is the brightness at a feature, pixels.
_BRIGHTNESS_WINDOW = 7


def depths_of(model: pycolmap.Reconstruction) -> dict[int, tuple[Int[np.ndarray, "K"], Float[np.ndarray, "K"]]]:
    """Feature indices and z-depths of the points that each registered image observes, by image ID."""
    numbers = np.array(sorted(model.points3D), np.int64)
    positions = np.array([model.points3D[number].xyz for number in numbers.tolist()]).reshape(-1, 3)
    found = {}
    for number in sorted(model.reg_image_ids()):
        image = model.images[number]
        features = np.array(image.get_observation_point2D_idxs(), np.int64)
        seen = np.array([image.points2D[index].point3D_id for index in features.tolist()], np.int64)
        row = image.cam_from_world().matrix()[2]
        found[number] = features, positions[np.searchsorted(numbers, seen)] @ row[:3] + row[3]
    return found


def brightness_at(image: UInt8[np.ndarray, "H W 3"], pixels: Float[np.ndarray, "K 2"]) -> Float[np.ndarray, "K"]:
    """Mean of the red, green and blue values around pixels, 0 to 255. [K]"""
    import cv2

    mean = cv2.blur(image, (_BRIGHTNESS_WINDOW, _BRIGHTNESS_WINDOW)).mean(axis=2)
    column = np.clip(pixels[:, 0].astype(np.int64), 0, image.shape[1] - 1)
    row = np.clip(pixels[:, 1].astype(np.int64), 0, image.shape[0] - 1)
    return np.asarray(mean[row, column])


def brightness_correlation(
    model: pycolmap.Reconstruction, brightness: Sequence[Float[np.ndarray, "K"]]
) -> float | None:
    """Correlation of log brightness with log depth within the images; None where too few points are seen.

    With the lamp at the lens it is negative: what is nearer is brighter. The gain of each image drops out.

    Args:
        model: Image i has ID i + 1.
        brightness: At the features of each image, 0 to 255.
    """
    light, depth = [], []
    for number, (features, z) in depths_of(model).items():
        front = z > 0.0
        if front.sum() >= _FEWEST:
            logs = np.log(brightness[number - 1][features[front]] + 1.0), np.log(z[front])
            light.append(logs[0] - logs[0].mean())
            depth.append(logs[1] - logs[1].mean())
    if not light:
        return None
    one, other = np.concatenate(light), np.concatenate(depth)
    size = float(np.sqrt((one**2).sum() * (other**2).sum()))
    return float(one @ other) / size if size > 0.0 else None
