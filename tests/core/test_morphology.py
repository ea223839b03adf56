"""Dilation and erosion of masks against OpenCV's, borders included."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from coliags_plugin.core.morphology import dilated, eroded


@pytest.mark.parametrize("reach", [0, 1, 3])
@pytest.mark.parametrize("size", [(1, 1), (1, 9), (31, 24)])
def test_squares_of_opencv(reach, size):
    kernel = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    for seed, share in enumerate((0.05, 0.5, 0.97)):
        mask = np.random.default_rng(seed).random(size) < share
        pixels = mask.astype(np.uint8)
        assert np.array_equal(dilated(mask, reach), cv2.dilate(pixels, kernel, borderType=cv2.BORDER_REPLICATE) > 0)
        assert np.array_equal(eroded(mask, reach), cv2.erode(pixels, kernel, borderType=cv2.BORDER_REPLICATE) > 0)
