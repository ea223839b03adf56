"""The basis against scipy's complex spherical harmonics, and its orthonormality."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.special import sph_harm_y

from coliags_plugin.fields.spherical_harmonics import Y0, basis, colors


def directions(count=200):
    vectors = torch.randn(count, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return torch.nn.functional.normalize(vectors, dim=1)


def test_real_harmonics_from_scipys_complex_ones():
    """Y_l,m = sqrt(2) Re or Im of scipy's, which carries the Condon-Shortley sign; order m from -l to l."""
    points = directions()
    theta = np.arccos(points[:, 2].numpy())
    phi = np.arctan2(points[:, 1].numpy(), points[:, 0].numpy())
    expected = []
    for degree in range(4):
        for order in range(-degree, degree + 1):
            value = sph_harm_y(degree, abs(order), theta, phi)
            part = value.imag if order < 0 else value.real
            expected.append(part * (math.sqrt(2.0) if order else 1.0))
    torch.testing.assert_close(basis(points, 3), torch.from_numpy(np.stack(expected, axis=1)))


@pytest.mark.parametrize("degree", range(4))
def test_lower_degrees_are_the_first_functions(degree):
    points = directions(9)
    assert torch.equal(basis(points, degree), basis(points, 3)[:, : (degree + 1) ** 2])


def test_degree_zero_is_a_colour_and_negative_ones_are_cut():
    coefficients = torch.zeros(3, 16, 3, dtype=torch.float64)
    coefficients[:, 0] = (torch.tensor([0.2, 0.5, -0.3]) - 0.5) / Y0
    coefficients[:, 5] = 9.0  # of degree 2
    torch.testing.assert_close(colors(coefficients, directions(3), 1)[1], torch.tensor([0.2, 0.5, 0.0]).double())


def test_unknown_degrees_are_refused():
    with pytest.raises(ValueError, match="degree 4: expected 0 to 3"):
        basis(directions(2), 4)
