"""Dilation and erosion of masks by OpenCV; pixels outside the image have no influence."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, UInt8


def dilated(mask: Bool[np.ndarray, "H W"], reach: int) -> Bool[np.ndarray, "H W"]:
    """The mask with all pixels within ``reach`` rows and columns of it. [H, W]"""
    return cv2.dilate(mask.astype(np.uint8), _square(reach)).astype(bool)


def eroded(mask: Bool[np.ndarray, "H W"], reach: int) -> Bool[np.ndarray, "H W"]:
    """The mask without the pixels within ``reach`` rows and columns of its complement. [H, W]"""
    return cv2.erode(mask.astype(np.uint8), _square(reach)).astype(bool)


def _square(reach: int) -> UInt8[np.ndarray, "K K"]:
    return np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
