"""Where rays are sampled, and what the samples add up to: against numpy, closed forms and independent loops."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from coliags_plugin.renderers.rays import WEIGHT_FLOOR, CompositedRays, even_places, refined_places, transmittances

RAYS = torch.zeros(3, 3, dtype=torch.float64)


def chance(seed=0):
    return torch.Generator().manual_seed(seed)


def test_even_places_are_midpoints_and_random_ones_lie_in_the_same_intervals():
    still = even_places(2.0, 10.0, 4, RAYS, None)
    assert still.tolist() == [[3.0, 5.0, 7.0, 9.0]] * 3
    drawn = even_places(2.0, 10.0, 4, torch.zeros(5000, 3, dtype=torch.float64), chance())
    share = (drawn - (still[:1] - 1.0)) / 2.0
    assert 0.0 <= share.min() and share.max() < 1.0
    torch.testing.assert_close(share.mean(0), torch.full((4,), 0.5, dtype=torch.float64), rtol=0, atol=0.02)
    assert torch.equal(drawn, even_places(2.0, 10.0, 4, torch.zeros(5000, 3, dtype=torch.float64), chance()))


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10_000), samples=st.integers(3, 20), more=st.integers(1, 30), most=st.sampled_from([0.0, 1.0])
)
def test_refined_places_are_numpys_inverse_of_the_cumulative_weights(seed, samples, more, most):
    random = np.random.default_rng(seed)
    places = np.sort(random.uniform(1.0, 9.0, (2, samples)), axis=1)
    weights = random.uniform(0.0, most, (2, samples)) ** 8  # rays without weight are refined evenly
    found = refined_places(torch.from_numpy(places), torch.from_numpy(weights), more, None).numpy()
    for row in range(2):
        edges = (places[row, 1:] + places[row, :-1]) / 2
        mass = weights[row, 1:-1] + WEIGHT_FLOOR
        cumulative = np.concatenate([[0.0], np.cumsum(mass) / mass.sum()])
        expected = np.interp((np.arange(more) + 0.5) / more, cumulative, edges)
        np.testing.assert_allclose(found[row], np.sort([*places[row], *expected]), rtol=0, atol=1e-9)


def test_an_opaque_end_absorbs_what_is_left_where_there_is_density():
    density = torch.tensor([[0.5, 0.25, 1e-6], [0.5, 0.25, 0.0]], requires_grad=True)
    lengths = torch.tensor([[1.0, 2.0, 3.0]]).expand(2, -1)
    behind = transmittances(density, lengths, opaque_end=True)
    expected = torch.exp(-torch.tensor([0.0, 0.5, 1.0])).tolist()
    assert behind[0].tolist() == pytest.approx([*expected, 0.0])
    assert behind[1].tolist() == pytest.approx([*expected, expected[-1]])
    behind.sum().backward()
    assert density.grad.isfinite().all() and not density.grad[:, -1].any()
    assert transmittances(density, lengths, opaque_end=False)[0, -1].item() == pytest.approx(np.exp(-1.0 - 3e-6))


def test_outputs_are_the_sums_of_their_definitions():
    generator = chance()
    density, lengths = torch.rand(4, 6, generator=generator).double(), torch.rand(4, 6, generator=generator).double()
    depths = torch.rand(4, 6, generator=generator).double().cumsum(1) + 1
    colors, background = torch.rand(4, 6, 3, generator=generator).double(), torch.tensor([0.1, 0.2, 0.3]).double()
    rays = CompositedRays(depths, transmittances(density, lengths, False), colors)
    for row in range(4):
        light, sums = 1.0, {"alpha": 0.0, "depth_accumulated": 0.0, "inverse_depth_accumulated": 0.0}
        rgb, median = torch.zeros(3).double(), 0.0
        for index in range(6):
            opacity = 1.0 - np.exp(-float(density[row, index] * lengths[row, index]))
            weight, depth = light * opacity, float(depths[row, index])
            sums["alpha"] += weight
            sums["depth_accumulated"] += weight * depth
            sums["inverse_depth_accumulated"] += weight / depth
            rgb += weight * colors[row, index]
            median = depth if light > 0.5 >= light * (1 - opacity) else median
            light *= 1.0 - opacity
        sums |= {"depth_expected": sums["depth_accumulated"] / sums["alpha"], "depth_median": median}
        for name, value in sums.items():
            assert rays.output(name, background)[row, 0].item() == pytest.approx(value, abs=1e-12), name
        torch.testing.assert_close(rays.output("rgb", background)[row, 0], rgb + light * background)
