"""Merging of splats keeps moments, colours and what is covered."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coliags_plugin.export.splats.cloud import SplatCloud, harmonics_of_colors
from coliags_plugin.export.viewer.splats import merged, merged_to, shown
from tests.export.viewer.made import some_gaussians


def flat(count, sigma, opacity, color, center=(0.0, 0.0, 0.0)):
    """Equal discs in the plane z = 0."""
    rows = (center, (1.0, 0.0, 0.0, 0.0), (sigma, sigma, 0.0), opacity)
    parts = (np.repeat(np.float32([row]), count, axis=0) for row in rows)
    return SplatCloud(*parts, harmonics_of_colors(np.float32([color] * count) / 255))


def colors(splats):
    return np.rint(255 * splats.colors)


def test_discs_at_one_place_are_as_opaque_as_one_behind_the_other():
    one = merged(flat(3, 0.5, 0.4, (200, 100, 50)), np.zeros(3, np.int64))
    assert len(one) == 1
    assert one.opacities[0] == pytest.approx(1 - 0.6**3, rel=1e-6)
    np.testing.assert_allclose(one.covariances[0], np.diag([0.25, 0.25, 0.0]), atol=1e-7)
    np.testing.assert_array_equal(colors(one)[0], [200, 100, 50])


def test_moments_of_two_equal_discs(monkeypatch):
    monkeypatch.setattr("coliags_plugin.export.viewer.splats._SPREAD", 1.0)
    pair = flat(1, 0.5, 0.5, (100, 0, 0), (-1.0, 0, 0)).concat(flat(1, 0.5, 0.5, (0, 200, 0), (1.0, 0, 0)))
    one = merged(pair, np.zeros(2, np.int64))
    np.testing.assert_allclose(one.means, [[0, 0, 0]], atol=1e-7)
    np.testing.assert_allclose(one.covariances[0], np.diag([1.25, 0.25, 0.0]), atol=1e-6)
    np.testing.assert_array_equal(colors(one)[0], [50, 100, 0])
    # Two areas of 0.25 with an optical depth of log 2 each, over one of sqrt(1.25) / 2.
    assert one.opacities[0] == pytest.approx(1 - 2 ** -(0.5 / (0.5 * 1.25**0.5)), rel=1e-6)


def test_each_alone_stays_as_it_is():
    splats = shown(some_gaussians(30))
    same = merged(splats, np.arange(30))
    np.testing.assert_allclose(same.means, splats.means, atol=1e-6)
    np.testing.assert_allclose(same.covariances, splats.covariances, atol=1e-6)
    np.testing.assert_array_equal(colors(same), colors(splats))
    np.testing.assert_allclose(same.opacities, np.minimum(splats.opacities, 0.999), atol=1e-4)


@given(st.integers(1, 400))
def test_at_most_as_many_as_asked_for(count):
    splats = shown(some_gaussians(300))
    fewer = merged_to(splats, count, np.linspace(1.0, 1.9, 300))
    assert 1 <= len(fewer) <= count
    if count >= 300:
        assert fewer is splats


def test_far_ones_are_merged_first():
    near, far = shown(some_gaussians(200)), shown(some_gaussians(200, seed=1))
    far = replace(far, means=far.means + np.float32([1000, 0, 0]))
    fewer = merged_to(near.concat(far), 250, np.repeat([10.0, 80.0], 200))
    left = (fewer.means[:, 0] < 500).sum()
    assert left > 2 * (len(fewer) - left)
