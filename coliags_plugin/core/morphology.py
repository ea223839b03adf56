"""Dilation and erosion of masks by scikit-image; pixels outside the image have no influence."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool


def dilated(mask: Bool[np.ndarray, "H W"], reach: int) -> Bool[np.ndarray, "H W"]:
    """The mask with all pixels within ``reach`` rows and columns of it. [H, W]"""
    from skimage.morphology import dilation

    return np.asarray(dilation(mask.astype(np.uint8), _square(reach), mode="ignore")).astype(bool)


def eroded(mask: Bool[np.ndarray, "H W"], reach: int) -> Bool[np.ndarray, "H W"]:
    """The mask without the pixels within ``reach`` rows and columns of its complement. [H, W]"""
    from skimage.morphology import erosion

    return np.asarray(erosion(mask.astype(np.uint8), _square(reach), mode="ignore")).astype(bool)


def _square(reach: int) -> tuple[tuple[np.ndarray, int], ...]:
    """The square footprint as a column and a row, which together cost far less."""
    from skimage.morphology import footprint_rectangle

    footprint: tuple[tuple[np.ndarray, int], ...] = footprint_rectangle(
        (2 * reach + 1, 2 * reach + 1), decomposition="separable"
    )
    return footprint
