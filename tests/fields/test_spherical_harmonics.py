"""The basis against scipy's complex spherical harmonics, and the kernel against torch."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.special import sph_harm_y

from coliags_plugin.fields.numba_kernels import spherical_harmonics as kernel
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
    for degree in range(4):
        functions = np.stack(expected[: (degree + 1) ** 2], axis=1)
        torch.testing.assert_close(basis(points, degree), torch.from_numpy(functions))
    with pytest.raises(ValueError, match="degree 4: expected 0 to 3"):
        basis(points, 4)


def test_degree_zero_is_a_colour_and_negative_ones_are_cut():
    coefficients = torch.zeros(3, 16, 3, dtype=torch.float64)
    coefficients[:, 0] = (torch.tensor([0.2, 0.5, -0.3]) - 0.5) / Y0
    coefficients[:, 5] = 9.0  # of degree 2
    torch.testing.assert_close(colors(coefficients, directions(3), 1)[1], torch.tensor([0.2, 0.5, 0.0]).double())


# --- the kernel -------------------------------------------------------------------------------------------------------


def made(count, degree, share=0.7):
    """Coefficients of degrees 0 and above of so many rows, those selected, vectors to these and their derivatives."""
    generator = torch.Generator().manual_seed(0)
    sh0, shN = (torch.randn(count, terms, 3, generator=generator) for terms in (1, (degree + 1) ** 2 - 1))
    rows = (torch.rand(count, generator=generator) < share).nonzero().squeeze(1)
    sight, given = (3.0 * torch.randn(len(rows), 3, generator=generator) for _ in range(2))
    return sh0, shN, rows, sight, given


def by_torch(sh0, shN, rows, sight, degree):
    coefficients = torch.cat([sh0, shN], dim=1)[rows]
    return colors(coefficients, torch.nn.functional.normalize(sight, dim=1), degree)


def with_gradients(function, sh0, shN, rows, sight, degree, given):
    leaves = [tensor.clone().requires_grad_() for tensor in (sh0, shN, sight)]
    result = function(leaves[0], leaves[1], rows, leaves[2], degree)
    gradients = torch.autograd.grad(result, leaves, given, allow_unused=True, materialize_grads=True)
    return result.detach(), *gradients


@pytest.mark.parametrize(("most", "degree"), [(0, 0), (1, 1), (2, 2), (3, 0), (3, 1), (3, 2), (3, 3)])
@pytest.mark.parametrize(("count", "share"), [(0, 1.0), (1, 1.0), (16, 1.0), (9, 0.0), (700, 0.7)])
def test_kernel_against_torch_in_float64(count, share, most, degree):
    sh0, shN, rows, sight, given = made(count, most, share)
    found = with_gradients(kernel.colors, sh0, shN, rows, sight, degree, given)
    expected = with_gradients(by_torch, sh0.double(), shN.double(), rows, sight.double(), degree, given.double())
    clamped = (expected[0] == 0.0).sum()
    assert count < 700 or 0 < clamped < expected[0].numel()
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other.float(), rtol=1e-5, atol=2e-5)
    unseen = torch.ones(count, dtype=torch.bool).index_fill_(0, rows, False)
    assert not found[1][unseen].any() and not found[2][unseen].any()
    assert not found[2][:, (degree + 1) ** 2 - 1 :].any()


def test_colours_of_zero_have_gradients():
    """As those of the first step, of points that are black."""
    sh0 = torch.full((1, 1, 3), -0.5) / Y0
    rows, sight = torch.tensor([0]), torch.tensor([[0.3, -0.2, 1.0]])
    found = with_gradients(kernel.colors, sh0, torch.zeros(1, 15, 3), rows, sight, 3, torch.ones(1, 3))
    assert torch.equal(found[0], torch.zeros(1, 3))
    torch.testing.assert_close(found[1], torch.full((1, 1, 3), Y0))


def test_kernel_gives_the_same_bits_on_any_number_of_threads():
    case = made(5000, 3)
    results = []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        results.append(with_gradients(kernel.colors, *case[:4], 3, case[4]))
    assert all(torch.equal(a, b) for other in results[1:] for a, b in zip(results[0], other, strict=True))
