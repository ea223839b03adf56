"""Masked means, dilation and erosion of masks against OpenCV's, and bilinear samples against scipy's."""

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates

from coliags_plugin.core.masked import masked_mean, zero_outside
from coliags_plugin.core.morphology import dilated, eroded
from coliags_plugin.core.sampling import bilinear


@settings(max_examples=20, deadline=None)
@given(height=st.integers(1, 40), width=st.integers(1, 40), seed=st.integers(0, 99))
def test_a_full_mask_is_no_mask_to_the_bit(height, width, seed):
    values = torch.rand(height, width, 3, generator=torch.Generator().manual_seed(seed))
    full = torch.ones(height, width, dtype=torch.bool)
    assert torch.equal(masked_mean(values, full), masked_mean(values, None))
    part = torch.rand(height, width, generator=torch.Generator().manual_seed(seed)) < 0.5
    expected = values[part].mean() if part.any() else torch.tensor(0.0)
    torch.testing.assert_close(masked_mean(values, part), expected)
    assert torch.equal(zero_outside(values, full), values)


@pytest.mark.parametrize("reach", [0, 1, 3])
@pytest.mark.parametrize("size", [(1, 1), (1, 9), (31, 24)])
def test_squares_of_opencv(reach, size):
    kernel = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    for seed, share in enumerate((0.05, 0.5, 0.97)):
        mask = np.random.default_rng(seed).random(size) < share
        pixels = mask.astype(np.uint8)
        assert np.array_equal(dilated(mask, reach), cv2.dilate(pixels, kernel, borderType=cv2.BORDER_REPLICATE) > 0)
        assert np.array_equal(eroded(mask, reach), cv2.erode(pixels, kernel, borderType=cv2.BORDER_REPLICATE) > 0)


def test_samples_are_scipys_also_beyond_the_edge():
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(7, 9, 2, generator=generator)
    pixels = torch.rand(4, 5, 2, generator=generator) * torch.tensor([13.0, 11.0]) - 2.0
    made = bilinear(image, pixels)
    rows, columns = (pixels[..., 1] - 0.5).numpy(), (pixels[..., 0] - 0.5).numpy()
    for channel in range(2):
        expected = map_coordinates(image[..., channel].numpy(), [rows, columns], order=1, mode="nearest")
        torch.testing.assert_close(made[..., channel], torch.from_numpy(expected), atol=1e-5, rtol=0.0)


def test_pixel_centres_are_at_halves():
    image = torch.arange(6.0).view(2, 3, 1)
    assert bilinear(image, torch.tensor([[[2.5, 1.5]]])).item() == 5.0
