"""Parts of depth estimation against closed forms, and kernels against brute force."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.depth_maps import Pose, WeightedDepth
from coliags_plugin.core.images import write_image
from coliags_plugin.core.scenes import Frame, SparseDepth
from coliags_plugin.reconstruction.depth.estimate import choose_neighbours
from coliags_plugin.reconstruction.depth.numba_kernels.kernels import aggregate, pick, sweep, vote
from coliags_plugin.reconstruction.depth.priors import (
    FilePrior,
    LightPrior,
    complete,
    find_range,
    near_rim,
    neighbourly,
    robust_fit,
    smooth_surface,
)
from coliags_plugin.reconstruction.depth.scene import VoxelPoints
from coliags_plugin.reconstruction.depth.sweeping import (
    SWEEPS,
    Sweep,
    depth_confidence,
    disagreement,
    fuse_frame,
    guide_of,
    ratios,
    sweep_frame,
)
from coliags_plugin.reconstruction.structure.sfm_settings import FeatureSettings
from tests.commands import refuses
from tests.reconstruction.depth.walls import sideways, wall_depth, wall_frames

FEATURES = FeatureSettings(highlight_level=256)


def test_features_give_the_range_in_any_unit():
    frames = wall_frames(sideways(8))
    depth_range = find_range(frames, FEATURES)
    depths = [wall_depth(frame.camera) for frame in frames]
    assert 0.4 * min(map(np.min, depths)) < depth_range.near < min(map(np.min, depths))
    assert max(map(np.max, depths)) < depth_range.far < 3.0 * max(map(np.max, depths))
    np.testing.assert_allclose(depth_range.medians, [np.median(depth) for depth in depths], rtol=0.08)
    scaled = []
    for frame in frames:
        pose = frame.camera.camera_to_world.clone()
        pose[:3, 3] *= 1e-3
        scaled.append(dataclasses.replace(frame, camera=dataclasses.replace(frame.camera, camera_to_world=pose)))
    smaller = find_range(scaled, FEATURES)
    assert smaller.near == pytest.approx(1e-3 * depth_range.near, rel=1e-6)
    assert smaller.far == pytest.approx(1e-3 * depth_range.far, rel=1e-6)


def test_sparse_depth_of_the_scene_counts():
    pixels = torch.stack([torch.arange(50) + 0.5, torch.full((50,), 20.5)], dim=1)
    depths = torch.linspace(30.0, 50.0, 50)
    frames = [
        dataclasses.replace(frame, sparse_depth=SparseDepth(pixels, depths)) for frame in wall_frames(sideways(4, 0.0))
    ]
    depth_range = find_range(frames, FEATURES)
    assert depth_range.near == pytest.approx(0.6 * np.percentile(np.tile(depths, 4), 1.0), rel=1e-5)
    assert depth_range.far == pytest.approx(2.0 * np.percentile(np.tile(depths, 4), 99.0), rel=1e-5)
    np.testing.assert_allclose(depth_range.medians, 40.0, rtol=1e-5)


def chosen(distances, axes=None, sources=None):
    centers = np.zeros((len(distances), 3))
    centers[:, 0] = distances
    axes = np.tile([0.0, 0.0, 1.0], (len(distances), 1)) if axes is None else axes
    return choose_neighbours(centers, axes, sources or range(len(distances)), [10.0] * len(distances), (0.1, 0.2))


HALVES = [0.5 * k for k in range(12)]


@pytest.mark.parametrize(
    ("distances", "sources", "expected"),
    [
        (HALVES, None, {6: [2, 4, 8, 10]}),  # a baseline of 0.1 at depth 10 is 1
        (HALVES, [0, 1, 2, 3, 5, 6, 7, 9, 11], {6: [2, 3, 9, 11], 4: [0, 2, 6, 9]}),  # from sources alone
        ([0.0] * 5, None, {key: [] for key in range(5)}),
        ([0.0, 0.2, 0.4], None, {key: [] for key in range(3)}),
        ([0.0, 9.0, 18.0], None, {key: [] for key in range(3)}),
        (list(range(8)), None, {0: [1, 2, 4]}),  # 0.1 and 0.2, then 0.3, which is frame 4 by rounding, and 0.4
    ],
)
def test_the_first_frame_beyond_each_baseline_on_either_side(distances, sources, expected):
    neighbours = chosen([float(distance) for distance in distances], sources=sources)
    assert {frame: neighbours[frame] for frame in expected} == expected


def test_a_pause_changes_no_distance_and_frames_turned_away_are_no_neighbours():
    moving = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    paused = moving[:3] + [3.0] * 50 + moving[4:]
    for index in (3, 30, 52):
        assert [paused[other] for other in chosen(paused)[index]] == [1.0, 2.0, 4.0, 5.0]
    axes = np.tile([0.0, 0.0, 1.0], (5, 1))
    axes[3] = [1.0, 0.0, 0.0]
    assert 3 not in chosen([1.0 * k for k in range(5)], axes=axes)[1]
    assert len(chosen([0.5 * k for k in range(20)])[0]) == 4  # at an end the other side gives more


ALL = np.ones((80, 96), bool)
FLOAT = np.ones((80, 96), np.float32)
NOWHERE = np.zeros((80, 96), np.float32)


def lit_frame():
    """A plane of one colour lit by a lamp at the lens: linear intensity ~ depth^-2; and its depth."""
    frame = wall_frames(sideways(1))[0]
    depth = wall_depth(frame.camera)
    linear = 0.9 * (depth.min() / depth) ** 2
    image = np.repeat(np.rint(255.0 * linear ** (1 / 2.2)).astype(np.uint8)[..., None], 3, axis=2)
    return Frame.of("lit", 0, torch.from_numpy(image), frame.camera), depth


def test_a_robust_fit_ignores_a_third_of_outliers():
    rng = np.random.default_rng(0)
    columns = np.stack([np.ones(900), rng.normal(size=900), rng.normal(size=900)], axis=1)
    values = columns @ [1.0, 2.0, -3.0]
    values[::3] += rng.uniform(20, 30, 300)
    coefficients = robust_fit(columns, values, np.ones(900), np.zeros(3), 1e-6)
    np.testing.assert_allclose(coefficients, [1.0, 2.0, -3.0], atol=0.05)
    np.testing.assert_array_equal(robust_fit(columns[:0], values[:0], values[:0], np.arange(3.0), 1.0), [0.0, 1.0, 2.0])


def test_brightness_gives_depth():
    frame, depth = lit_frame()
    log_depth = np.log(depth).astype(np.float32)
    half = np.where(np.arange(96) % 2, FLOAT, 0.0)
    prior = np.exp(LightPrior().log_depth(frame, ALL, log_depth, half, 40.0))
    assert np.abs(prior / depth - 1.0)[5:-5, 5:-5].max() < 0.03
    # Without known depth the law of a lamp at the lens holds.
    prior = np.exp(LightPrior().log_depth(frame, ALL, NOWHERE, NOWHERE, float(np.median(depth))))
    np.testing.assert_allclose(prior[5:-5, 5:-5], depth[5:-5, 5:-5], rtol=0.02)


def test_completion_keeps_what_is_known_and_shifts_the_prior_to_it():
    truth = np.log(np.linspace(30.0, 40.0, 96, dtype=np.float32))[None].repeat(80, axis=0)
    support = 5.0 * FLOAT
    support[20:60, 30:60] = 0.0
    log_known = np.where(support > 0.0, truth, np.float32(9.9))
    completed = complete(log_known, support, FLOAT, truth - np.float32(0.3), NOWHERE)
    np.testing.assert_array_equal(completed[support > 0.0], truth[support > 0.0])
    np.testing.assert_allclose(completed, truth, atol=0.01)


def test_a_swept_surface_is_smooth_up_to_the_edges_of_the_image():
    columns = np.arange(96, dtype=np.float32)[None].repeat(80, axis=0)
    truth = np.where(columns < 48, 20.0, 60.0) * np.exp(0.002 * columns)
    rough = truth * np.exp(np.random.default_rng(0).normal(0.0, 0.02, truth.shape))
    smooth = smooth_surface(rough.astype(np.float32), np.where(columns < 48, 0.5, -0.5).astype(np.float32))
    error = np.abs(np.log(smooth / truth))
    assert np.median(error) < 0.005 and error[:, 47:49].max() < 0.05
    # Depth of half the size is brought to the image's.
    half = smooth_surface(np.full((40, 48), 7.0, np.float32), np.zeros((80, 96), np.float32))
    np.testing.assert_allclose(half, np.full((80, 96), 7.0), rtol=1e-4)


def test_the_rim_is_the_near_side_of_an_edge():
    log_depth = np.where(np.arange(96) < 50, 3.0, 3.5).astype(np.float32)[None].repeat(80, axis=0)
    rim = near_rim(log_depth, 6)
    assert rim[40, 45:50].all() and not rim[:, 50:].any()
    assert not rim[:, :40].any()
    assert not near_rim(np.full((80, 96), 3.0, np.float32), 6).any()


def test_confidence_rises_with_support_and_falls_at_edges():
    flat = np.full((80, 96), 3.0, np.float32)
    levels = [depth_confidence(flat, n * FLOAT, 0.01 * FLOAT, ~ALL)[40, 40] for n in (0.0, 0.3, 1.0, 3.0, 9.0)]
    assert levels[0] == 0.0 and (np.diff(levels) > 0.0).all()
    assert levels[-1] < 1.0
    edge = flat.copy()
    edge[:, 48:] = 3.4
    at_edge = depth_confidence(edge, 3.0 * FLOAT, 0.01 * FLOAT, ~ALL)
    assert at_edge[40, 46] < at_edge[40, 10]
    assert depth_confidence(flat, 3.0 * FLOAT, 0.01 * FLOAT, ALL)[40, 40] < levels[3]


def test_points_are_where_three_frames_are_sure():
    image = np.full((80, 96, 3), 100, np.uint8)
    voxels = VoxelPoints(2.0, np.zeros(3))
    # A fourth frame that disagrees makes no shell, and one without confidence nothing at all.
    for x, depth, confidence in ((0.0, 31, 1), (0.3, 31, 1), (0.6, 31, 1), (0.9, 41, 1), (1.2, 51, 0.5)):
        matrix = torch.eye(4, dtype=torch.float64)
        matrix[0, 3] = x
        pose = Pose.of(Camera(60.0, 60.0, 48.0, 40.0, 96, 80, matrix))
        voxels.add(pose, np.float32(depth) * FLOAT, np.float32(confidence) * FLOAT, image)
    positions, colors = voxels.points()
    np.testing.assert_allclose(positions[:, 2], 31.0, atol=1e-4)
    assert (colors == 100).all()
    assert len(positions) == len(np.unique(np.floor(positions / 2.0), axis=0))
    # Some 49 mm by 41 mm of the plane are seen, in cells of 2 mm.
    assert 0.8 * 49 * 41 / 4 < len(positions) < 1.15 * 49 * 41 / 4


@pytest.mark.parametrize("inverse", [False, True])
@pytest.mark.parametrize("suffix", ["npy", "png"])
def test_files_as_a_prior_in_any_scale_and_shift(tmp_path, inverse, suffix):
    frame, depth = lit_frame()
    values = 1000.0 + 20000.0 * (10.0 / depth if inverse else depth / 100.0)
    if suffix == "npy":
        np.save(tmp_path / "lit.npy", values)
    else:
        write_image(tmp_path / "lit.png", np.rint(values).astype(np.uint16))
    half = FLOAT.copy()
    half[:, 48:] = 0.0
    prior = FilePrior(tmp_path, [frame])
    fitted = np.exp(prior.log_depth(frame, ALL, np.log(depth).astype(np.float32), half, 40.0))
    np.testing.assert_allclose(fitted, depth, rtol=2e-3)
    # Without known depth the scale is a guess.
    guess = np.exp(prior.log_depth(frame, ALL, NOWHERE, NOWHERE, 40.0))
    assert np.median(guess) == pytest.approx(40.0, rel=1e-3)
    if suffix == "npy":  # a larger map of the same aspect is taken
        np.save(tmp_path / "lit.npy", np.kron(values, np.ones((2, 2))))
        fitted = FilePrior(tmp_path, [frame]).log_depth(frame, ALL, np.log(depth).astype(np.float32), FLOAT, 40.0)
        np.testing.assert_allclose(np.exp(fitted), depth, rtol=1e-3)


def test_files_that_do_not_fit_are_refused(tmp_path):
    frame, depth = lit_frame()
    refuses("no such folder", FilePrior, tmp_path / "none", [frame])
    refuses("1 of 1 frames have no depth map: lit", FilePrior, tmp_path, [frame])
    np.save(tmp_path / "lit.npy", depth[:, :60])
    refuses("60 x 80 pixels, frame lit 96 x 80", FilePrior, tmp_path, [frame])


def test_a_point_unlike_its_neighbours_stands_out_and_an_edge_does_not():
    pixels = np.stack(np.meshgrid(np.arange(12), np.arange(12)), axis=-1).reshape(-1, 2) * 5.0
    depths = np.where(pixels[:, 0] < 30.0, 20.0, 55.0)
    np.testing.assert_array_equal(neighbourly(pixels, depths), depths)
    depths[40], unknown = 2.0 * depths[40], depths * np.where(np.arange(144) == 7, np.nan, 1.0)
    np.testing.assert_array_equal(neighbourly(pixels, depths), np.delete(depths, 40))
    np.testing.assert_array_equal(neighbourly(pixels, unknown), np.delete(unknown, 7))
    np.testing.assert_array_equal(neighbourly(pixels[33:41], depths[33:41]), depths[33:41])


def zncc(first, second, floor):
    """Zero-mean normalised cross-correlation of two windows, by its definition."""
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
    is_known = (mask[:-1, :-1] & mask[1:, 1:]).astype(bool)
    depths = np.array([1.0, 2.0], np.float32)
    sweep(ones, depths, reference, ones, other[None], mask[None], turn, shift, 1, 0.01, 1.0, cost)
    for y in (3, 6, 8):
        for x in (3, 7, 10, 16, 17, 18, 19, 20, 30):
            window = (slice(y - 1, y + 2), slice(x - 1, x + 2))
            for d, disparity in enumerate((2, 1)):
                moved = (slice(y - 1, y + 2), slice(x - 1 + disparity, x + 2 + disparity))
                there = is_known[moved]
                correlation = zncc(reference[window][there], other[moved][there], 0.01)
                assert cost[y, x, d] == pytest.approx(1.0 - correlation, abs=1e-5)


def test_of_several_neighbours_the_best_count():
    rng = np.random.default_rng(1)
    reference, wrong = rng.normal(size=(2, 10, 10)).astype(np.float32)
    ones, factor = np.ones((10, 10), np.float32), np.ones(1, np.float32)
    turns, shifts = np.tile(np.eye(3, dtype=np.float32), (2, 1, 1)), np.zeros((2, 3), np.float32)
    cost = np.empty((10, 10, 1), np.float32)
    images, masks = np.stack([wrong, reference]), np.ones((2, 10, 10), np.uint8)
    sweep(ones, factor, reference, ones, images, masks, turns, shifts, 2, 1e-6, 0.5, cost)
    np.testing.assert_allclose(cost[3:7, 3:7, 0], 0.0, atol=1e-4)
    masks[:] = 0
    sweep(ones, factor, reference, ones, images, masks, turns, shifts, 2, 1e-6, 0.5, cost)
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
    guides = [guide_of(frame, 1, FEATURES) for frame in frames]
    truth = wall_depth(frames[2].camera)
    factors, base = ratios(sweep, (20.0, 80.0)), base_of(truth).astype(np.float32)
    others = [guides[k] for k in (0, 1, 3, 4)]
    return sweep_frame(guides[2], others, base, factors, sweep), truth


def test_a_plane_seen_by_cameras_at_known_places():
    sweep = Sweep(step=0.02)
    factors = ratios(sweep, (20.0, 80.0))
    assert factors[0] == 1.0 and factors[-1] == pytest.approx(4.0)
    result, truth = swept(sweep, lambda truth: np.full(truth.shape, 20.0))
    error = np.abs(result.depth / truth - 1.0)[INNER]
    assert np.median(error) < 0.01 and np.percentile(error, 90) < 0.03
    assert np.median(result.match[INNER]) > 0.98


def test_a_surface_whose_slant_is_wrong_is_swept_to_the_right_one():
    """A smoothness that holds to the shape of the swept surface would keep part of its error: far lumens too near."""
    across = np.linspace(-0.06, 0.06, 96)
    result, truth = swept(SWEEPS[-1], lambda truth: truth * np.exp(across)[None])
    error = np.log(result.depth / truth)[INNER]
    assert np.median(np.abs(error)) < 0.004
    trend = np.polyfit(np.broadcast_to(across, truth.shape)[INNER].ravel(), error.ravel(), 1)[0]
    assert abs(trend) < 0.1


def voted(depth, candidates, weights=None, tolerance=0.02):
    candidates = np.repeat(np.array(candidates, np.float32)[:, None], 16, axis=1)
    weights = np.ones_like(candidates) if weights is None else np.repeat(np.float32(weights)[:, None], 16, axis=1)
    out = np.empty((3, 16), np.float32)
    unit = np.ones(16, np.float32)
    vote(unit * np.float32(depth), unit, candidates, weights, np.float32(tolerance), *out)
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


def true_maps() -> list[WeightedDepth]:
    """True depth of five frames."""
    cameras = [frame.camera for frame in wall_frames(sideways(5))]
    depths = [wall_depth(camera).astype(np.float32) for camera in cameras]
    return [WeightedDepth(Pose.of(camera), z, np.ones_like(z)) for camera, z in zip(cameras, depths, strict=True)]


def test_fusion_repairs_a_wrong_depth():
    maps = true_maps()
    truth = maps[2].depth.copy()
    maps[2].depth[30:40, 40:50] *= 1.04
    fused, votes, _ = fuse_frame(maps[2], [maps[k] for k in (0, 1, 3, 4)], 0.02)
    inner = (slice(8, -8), slice(12, -12))
    np.testing.assert_allclose(fused[inner], truth[inner], rtol=3e-3)
    assert votes[20, 45] == 5.0 and votes[35, 45] == 4.0


@pytest.mark.parametrize(("factor", "expected"), [(1.0, 0.0), (1.03, np.log(1.03)), (0.98, -np.log(0.98)), (1.5, 0.1)])
def test_frames_disagree_by_the_log_of_a_factor_on_depth_up_to_a_tenth(factor, expected):
    middle, *others = [true_maps()[k] for k in (2, 0, 1, 3, 4)]
    scaled = dataclasses.replace(middle, depth=np.float32(factor) * middle.depth)
    assert disagreement(scaled, others) == pytest.approx(expected, abs=2e-3)


def test_frames_that_see_nothing_of_each_other_do_not_agree():
    middle, other = true_maps()[:2]
    unknown = dataclasses.replace(other, depth=np.full_like(other.depth, np.nan))
    assert disagreement(middle, [unknown]) == disagreement(middle, []) == np.inf
