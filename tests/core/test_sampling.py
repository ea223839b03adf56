"""Bilinear samples against scipy's."""

from __future__ import annotations

import torch
from scipy.ndimage import map_coordinates

from coliags_plugin.core.sampling import bilinear


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
