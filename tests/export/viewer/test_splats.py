"""Gaussians as the browser takes them, read back from viser's own packing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from coliags_plugin.export.viewer.splats import most_visible, on_wire, shown, wire_unit
from tests.export.splats.clouds import covariances
from tests.export.viewer.made import some_gaussians


@pytest.mark.parametrize("scales", [2, 3])
def test_covariances(scales):
    gaussians = some_gaussians(20, scales)
    assert shown(gaussians).scales.shape == (20, 3)
    np.testing.assert_allclose(shown(gaussians).covariances, covariances(shown(gaussians)), atol=1e-6)


def test_what_is_not_finite_is_left_out():
    gaussians = some_gaussians(6)
    gaussians.means[1, 2] = torch.nan
    gaussians.scales[2, 0] = torch.inf
    gaussians.opacities[4] = torch.nan
    np.testing.assert_array_equal(shown(gaussians).means, gaussians.means[[0, 3, 5]].numpy())


@given(st.floats(-12, 12))
def test_half_precision_holds_scenes_of_every_unit_of_length(exponent):
    """A scene in other units looks the same: covariances keep half a percent, and undo their unit exactly."""
    factor = 10.0**exponent
    gaussians = some_gaussians(30)
    scaled = shown(replace(gaussians, means=gaussians.means * factor, scales=gaussians.scales * factor))
    unit = wire_unit(scaled)
    sent = on_wire(scaled, unit)
    halves = sent["covariances"].astype(np.float16).astype(np.float64) * unit**2
    expected = covariances(shown(gaussians)) * factor**2
    np.testing.assert_allclose(halves, expected, atol=5e-3 * np.abs(expected).max())
    np.testing.assert_allclose(sent["centers"] * unit, scaled.means, rtol=1e-6)


def test_the_most_visible_are_the_opaque_and_large_ones():
    gaussians = some_gaussians(4)
    gaussians.scales[:] = torch.tensor([[1.0, 2.0, 0.1], [1.0, 1.0, 0.9], [3.0, 0.1, 2.0], [1.0, 1.0, 1.0]])
    gaussians.opacities[:] = torch.tensor([0.5, 0.9, 0.1, 0.8])  # they cover 1, 0.9, 0.6 and 0.8
    splats = shown(gaussians)
    np.testing.assert_array_equal(most_visible(splats, 2).means, splats.means[:2])
    np.testing.assert_array_equal(most_visible(splats, 3).means, splats.means[[0, 1, 3]])
    assert len(most_visible(splats, 9)) == 4


def test_millimetres_stay_near_millimetres():
    """Splats of a tenth of a millimetre are sent in units near a millimetre."""
    gaussians = some_gaussians(100)
    assert wire_unit(shown(replace(gaussians, scales=0.125 * torch.ones(100, 3)))) == 1.0


def test_too_large_ones_become_smaller_but_keep_their_shape():
    gaussians = some_gaussians(50)
    gaussians.scales[7] *= 1e6
    splats = shown(gaussians)
    sent = on_wire(splats, wire_unit(splats))["covariances"]
    assert np.isfinite(sent.astype(np.float16)).all()
    shape = splats.covariances[7] / splats.covariances[7].max()
    np.testing.assert_allclose(sent[7] / sent[7].max(), shape, atol=1e-5)


def test_no_splats():
    empty = shown(some_gaussians(0))
    assert wire_unit(empty) == 1.0 and on_wire(empty, 1.0)["centers"].shape == (0, 3)
