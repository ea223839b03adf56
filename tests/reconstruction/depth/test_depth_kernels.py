"""Kernels against brute force and closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from coliags_plugin.reconstruction.depth.numba_kernels.kernels import aggregate, pick, sweep, vote
from coliags_plugin.reconstruction.depth.sweeping import WeightedDepth, fuse_frame, ratios, sweep_frame
from coliags_plugin.reconstruction.depth.views import SWEEPS, Sweep, guide_of
from coliags_plugin.reconstruction.structure.features import FeatureSettings
from coliags_plugin.reconstruction.structure.matching import Pose
from tests.reconstruction.depth.walls import sideways, wall_depth, wall_frames

NO_HIGHLIGHTS = FeatureSettings(highlight_level=256)


def zncc(first, second, floor):
    """Of two windows, by the definition."""
    a, b = first - first.mean(), second - second.mean()
    return (a * b).mean() / np.sqrt(((a**2).mean() + floor) * ((b**2).mean() + floor))


def test_costs_are_correlations_of_windows():
    rng = np.random.default_rng(0)
    reference, other = rng.normal(size=(2, 12, 35)).astype(np.float32)
    ones = np.ones((12, 35), np.float32)
    turn = np.eye(3, dtype=np.float32)[None]
    # The neighbour is two pixels to the side at depth 1: disparity 2 / z.
    shift = np.array([[2.0, 0.0, 0.0]], np.float32)
    cost = np.empty((12, 35, 2), np.float32)
    mask = ones.astype(np.uint8)
    mask[6, 20] = 0
    # Pixels between four of which the first or the last is masked are not known.
    known = (mask[:-1, :-1] & mask[1:, 1:]).astype(bool)
    depths = np.array([1.0, 2.0], np.float32)
    sweep(ones, depths, reference, ones, other[None], mask[None], turn, shift, 1, 0.01, 1.0, cost)
    for y in (3, 6, 8):
        for x in (3, 7, 10, 16, 17, 18, 19, 20, 30):
            window = (slice(y - 1, y + 2), slice(x - 1, x + 2))
            for d, disparity in enumerate((2, 1)):
                moved = (slice(y - 1, y + 2), slice(x - 1 + disparity, x + 2 + disparity))
                there = known[moved]
                correlation = zncc(reference[window][there], other[moved][there], 0.01)
                assert cost[y, x, d] == pytest.approx(1.0 - correlation, abs=1e-5)


def test_of_several_neighbours_the_best_count():
    rng = np.random.default_rng(1)
    reference, wrong = rng.normal(size=(2, 10, 10)).astype(np.float32)
    ones, one = np.ones((10, 10), np.float32), np.ones(1, np.float32)
    turns, shifts = np.tile(np.eye(3, dtype=np.float32), (2, 1, 1)), np.zeros((2, 3), np.float32)
    cost = np.empty((10, 10, 1), np.float32)
    images, masks = np.stack([wrong, reference]), np.ones((2, 10, 10), np.uint8)
    sweep(ones, one, reference, ones, images, masks, turns, shifts, 2, 1e-6, 0.5, cost)
    np.testing.assert_allclose(cost[3:7, 3:7, 0], 0.0, atol=1e-4)
    masks[:] = 0
    sweep(ones, one, reference, ones, images, masks, turns, shifts, 2, 1e-6, 0.5, cost)
    assert (cost == 1.0).all()


def brute_force_paths(cost, guide, small, large, contrast):
    """Hirschmueller's recurrence, written out."""
    height, width, count = cost.shape
    total = np.zeros(cost.shape)
    for dy, dx in [(0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)]:
        path = np.zeros(cost.shape)
        rows = range(height) if dy >= 0 else range(height - 1, -1, -1)
        columns = range(width) if dx >= 0 else range(width - 1, -1, -1)
        for y in rows:
            for x in columns:
                py, px = y - dy, x - dx
                if not (0 <= py < height and 0 <= px < width):
                    path[y, x] = cost[y, x]
                    continue
                jump = max(small, large / (1.0 + contrast * abs(guide[y, x] - guide[py, px])))
                before = path[py, px]
                for d in range(count):
                    options = [before[d], before.min() + jump]
                    options += [before[e] + small for e in (d - 1, d + 1) if 0 <= e < count]
                    path[y, x, d] = cost[y, x, d] + min(options) - before.min()
        total += path
    return total


@pytest.mark.parametrize("count", [4, 20])
def test_aggregation_is_semi_global_matching(count):
    rng = np.random.default_rng(2)
    cost = rng.uniform(0, 2, (5, 6, count)).astype(np.float32)
    guide = rng.normal(size=(5, 6)).astype(np.float32)
    padded = np.pad(cost, ((0, 0), (0, 0), (0, -count % 16)), constant_values=np.inf)
    total = np.empty_like(padded)
    aggregate(padded, guide, np.float32(0.1), np.float32(0.7), np.float32(3.0), total)
    np.testing.assert_allclose(total[..., :count], brute_force_paths(cost, guide, 0.1, 0.7, 3.0), rtol=1e-5)


def test_the_parabola_finds_the_minimum_between_steps():
    position = np.arange(9)
    costs = (0.1 * (position - 4.3) ** 2).astype(np.float32)[None, None]
    index, match, margin = (np.empty((1, 1), np.float32) for _ in range(3))
    pick(costs, 0.5 * costs, 3, index, match, margin)
    assert index[0, 0] == pytest.approx(4.3, abs=1e-5)
    assert match[0, 0] == pytest.approx(1.0 - 0.5 * 0.1 * 0.09, abs=1e-5)
    assert margin[0, 0] == pytest.approx(0.1 * (2.7**2 - 0.3**2), abs=1e-5)

    alone = 0.5 * costs
    alone[0, 0, 2] = 1.0
    pick(costs, alone, 3, index, match, margin)
    assert match[0, 0] == 0.0


INNER = (slice(12, -12), slice(16, -16))


def swept(sweep, base_of):
    """The middle one of five frames swept from a surface that is made of its true depth, and that depth."""
    frames = wall_frames(sideways(5))
    guides = [guide_of(frame, 1, NO_HIGHLIGHTS) for frame in frames]
    truth = wall_depth(frames[2].camera)
    factors, base = ratios(sweep, (20.0, 80.0)), base_of(truth).astype(np.float32)
    others = [guides[k] for k in (0, 1, 3, 4)]
    return sweep_frame(guides[2], others, base, factors, sweep), truth


def test_a_plane_seen_by_cameras_at_known_places():
    sweep = Sweep(step=0.02)
    factors = ratios(sweep, (20.0, 80.0))
    assert factors[0] == 1.0
    assert factors[-1] == pytest.approx(4.0)
    found, truth = swept(sweep, lambda truth: np.full(truth.shape, 20.0))
    error = np.abs(found.depth / truth - 1.0)[INNER]
    assert np.median(error) < 0.01
    assert np.percentile(error, 90) < 0.03
    assert np.median(found.match[INNER]) > 0.98


def test_a_surface_whose_slant_is_wrong_is_swept_to_the_right_one():
    """A smoothness that holds to the shape of the swept surface would keep part of its error: far lumens too near."""
    across = np.linspace(-0.06, 0.06, 96)
    found, truth = swept(SWEEPS[-1], lambda truth: truth * np.exp(across)[None])
    error = np.log(found.depth / truth)[INNER]
    assert np.median(np.abs(error)) < 0.004
    trend = np.polyfit(np.broadcast_to(across, truth.shape)[INNER].ravel(), error.ravel(), 1)[0]
    assert abs(trend) < 0.1


def voted(own, candidates, weights=None, tolerance=0.02):
    candidates = np.repeat(np.array(candidates, np.float32)[:, None], 16, axis=1)
    weights = np.ones_like(candidates) if weights is None else np.repeat(np.float32(weights)[:, None], 16, axis=1)
    out = np.empty((3, 16), np.float32)
    one = np.ones(16, np.float32)
    vote(one * np.float32(own), one, candidates, weights, np.float32(tolerance), *out)
    return [float(values[0]) for values in out]


def test_votes():
    fused, votes, spread = voted(10.0, [10.1, 9.9, 20.0, np.nan])
    assert (fused, votes) == (10.0, 3.0)
    assert spread == pytest.approx(0.2 / 30.0, rel=1e-4)
    # Two groups: the heavier one, although the frame's own depth is in the other.
    fused, votes, _ = voted(10.0, [20.0, 20.2, 19.9])
    assert (fused, votes) == (20.0, 3.0)
    # The mean of the middle two of four.
    assert voted(10.0, [10.1, 10.2, 10.3])[0] == pytest.approx(10.15)
    # A heavy candidate moves the median.
    assert voted(10.0, [10.1, 10.2], [1.0, 5.0])[0] == pytest.approx(10.2)
    assert voted(10.0, [np.nan])[:2] == [10.0, 1.0]


def test_fusion_repairs_a_wrong_depth():
    frames = wall_frames(sideways(5))
    maps = []
    for frame in frames:
        depth = wall_depth(frame.camera).astype(np.float32)
        maps.append(WeightedDepth(Pose.of(frame.camera), depth, np.ones_like(depth)))
    truth = maps[2].depth.copy()
    maps[2].depth[30:40, 40:50] *= 1.04
    fused = fuse_frame(maps[2], [maps[k] for k in (0, 1, 3, 4)], 0.02)
    inner = (slice(8, -8), slice(12, -12))
    np.testing.assert_allclose(fused.depth[inner], truth[inner], rtol=3e-3)
    assert fused.votes[20, 45] == 5.0
    assert fused.votes[35, 45] == 4.0
