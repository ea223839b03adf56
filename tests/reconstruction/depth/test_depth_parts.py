"""Parts of depth estimation against closed forms: range, neighbours, priors, completion, confidence and points."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import write_image
from coliags_plugin.core.scenes import Frame, SparseDepth
from coliags_plugin.reconstruction.depth.depth_range import difference_from_neighbours, find_range, given_range
from coliags_plugin.reconstruction.depth.estimate import choose_neighbours
from coliags_plugin.reconstruction.depth.priors import (
    FilePrior,
    LightPrior,
    complete,
    near_rim,
    robust_fit,
    smooth_surface,
)
from coliags_plugin.reconstruction.depth.scene import VoxelPoints
from coliags_plugin.reconstruction.depth.sweeping import depth_confidence
from coliags_plugin.reconstruction.structure.features import FeatureSettings
from coliags_plugin.reconstruction.structure.matching import Pose
from tests.reconstruction.depth.walls import sideways, wall_depth, wall_frames

FEATURES = FeatureSettings(highlight_level=256)


def test_features_give_the_range_in_any_unit():
    frames = wall_frames(sideways(8))
    found = find_range(frames, FEATURES)
    depths = [wall_depth(frame.camera) for frame in frames]
    assert 0.4 * min(map(np.min, depths)) < found.near < min(map(np.min, depths))
    assert max(map(np.max, depths)) < found.far < 3.0 * max(map(np.max, depths))
    np.testing.assert_allclose(found.medians, [np.median(depth) for depth in depths], rtol=0.08)
    scaled = []
    for frame in frames:
        pose = frame.camera.camera_to_world.clone()
        pose[:3, 3] *= 1e-3
        scaled.append(dataclasses.replace(frame, camera=dataclasses.replace(frame.camera, camera_to_world=pose)))
    smaller = find_range(scaled, FEATURES)
    assert smaller.near == pytest.approx(1e-3 * found.near, rel=1e-6)
    assert smaller.far == pytest.approx(1e-3 * found.far, rel=1e-6)


def test_sparse_depth_of_the_scene_counts():
    pixels = torch.stack([torch.arange(50) + 0.5, torch.full((50,), 20.5)], dim=1)
    depths = torch.linspace(30.0, 50.0, 50)
    frames = [
        dataclasses.replace(frame, sparse_depth=SparseDepth(pixels, depths)) for frame in wall_frames(sideways(4, 0.0))
    ]
    found = find_range(frames, FEATURES)
    assert found.near == pytest.approx(0.6 * np.percentile(np.tile(depths, 4), 1.0), rel=1e-5)
    assert found.far == pytest.approx(2.0 * np.percentile(np.tile(depths, 4), 99.0), rel=1e-5)
    np.testing.assert_allclose(found.medians, 40.0, rtol=1e-5)


def test_given_ranges_and_frames_without_features():
    assert given_range(10.0, 40.0, 2).medians == (20.0, 20.0)
    with pytest.raises(InputError, match="0 < near < far"):
        given_range(0.0, 40.0, 2)
    flat = torch.full((80, 96, 3), 90, dtype=torch.uint8)
    frames = [dataclasses.replace(frame, image=flat) for frame in wall_frames(sideways(4))]
    with pytest.raises(InputError, match="the depth range is unknown: 0 points"):
        find_range(frames, FEATURES)


def along(distances):
    centers = np.zeros((len(distances), 3))
    centers[:, 0] = distances
    return centers


def chosen(distances, axes=None, sources=None):
    ahead = np.tile([0.0, 0.0, 1.0], (len(distances), 1))
    directions, depths = ahead if axes is None else axes, [10.0] * len(distances)
    sources = sources or range(len(distances))
    return choose_neighbours(along(distances), directions, sources, depths, (0.1, 0.2))


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
    found = chosen([float(distance) for distance in distances], sources=sources)
    assert {frame: found[frame] for frame in expected} == expected


def test_a_pause_changes_no_distance():
    moving = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    paused = moving[:3] + [3.0] * 50 + moving[4:]
    for index in (3, 30, 52):
        assert [paused[other] for other in chosen(paused)[index]] == [1.0, 2.0, 4.0, 5.0]


def test_frames_turned_away_are_no_neighbours():
    axes = np.tile([0.0, 0.0, 1.0], (5, 1))
    axes[3] = [1.0, 0.0, 0.0]
    assert 3 not in chosen([1.0 * k for k in range(5)], axes=axes)[1]
    assert len(chosen([0.5 * k for k in range(20)])[0]) == 4  # at an end the other side gives more


ALL = np.ones((80, 96), bool)
FLOAT = np.ones((80, 96), np.float32)
NOWHERE = np.zeros((80, 96), np.float32)


def lit_frame(law=2.0):
    """A plane of one colour lit by a lamp at the lens: linear intensity ~ depth^-law; and its depth."""
    frame = wall_frames(sideways(1))[0]
    depth = wall_depth(frame.camera)
    linear = 0.9 * (depth.min() / depth) ** law
    image = np.repeat(np.rint(255.0 * linear ** (1 / 2.2)).astype(np.uint8)[..., None], 3, axis=2)
    return Frame("lit", 0, torch.from_numpy(image), frame.camera), depth


def test_a_robust_fit_ignores_a_third_of_outliers():
    rng = np.random.default_rng(0)
    columns = np.stack([np.ones(900), rng.normal(size=900), rng.normal(size=900)], axis=1)
    values = columns @ [1.0, 2.0, -3.0]
    values[::3] += rng.uniform(20, 30, 300)
    found = robust_fit(columns, values, np.ones(900), np.zeros(3), 1e-6)
    np.testing.assert_allclose(found, [1.0, 2.0, -3.0], atol=0.05)
    np.testing.assert_array_equal(robust_fit(columns[:0], values[:0], values[:0], np.arange(3.0), 1.0), [0.0, 1.0, 2.0])


def test_brightness_gives_depth():
    frame, depth = lit_frame()
    known = np.log(depth).astype(np.float32)
    half = FLOAT.copy()
    half[:, ::2] = 0.0
    prior = np.exp(LightPrior().log_depth(frame, ALL, known, half, 40.0))
    assert np.abs(prior / depth - 1.0)[5:-5, 5:-5].max() < 0.03
    # Without known depth the law of a lamp at the lens holds.
    prior = np.exp(LightPrior().log_depth(frame, ALL, NOWHERE, NOWHERE, float(np.median(depth))))
    np.testing.assert_allclose(prior[5:-5, 5:-5], depth[5:-5, 5:-5], rtol=0.02)


def test_completion_keeps_what_is_known_and_shifts_the_prior_to_it():
    truth = np.log(np.linspace(30.0, 40.0, 96, dtype=np.float32))[None].repeat(80, axis=0)
    support = 5.0 * FLOAT
    support[20:60, 30:60] = 0.0
    known = np.where(support > 0.0, truth, np.float32(9.9))
    found = complete(known, support, FLOAT, truth - np.float32(0.3), NOWHERE)
    np.testing.assert_array_equal(found[support > 0.0], truth[support > 0.0])
    np.testing.assert_allclose(found, truth, atol=0.01)


def test_a_swept_surface_is_smooth_up_to_the_edges_of_the_image():
    columns = np.arange(96, dtype=np.float32)[None].repeat(80, axis=0)
    truth = np.where(columns < 48, 20.0, 60.0) * np.exp(0.002 * columns)
    rough = truth * np.exp(np.random.default_rng(0).normal(0.0, 0.02, truth.shape))
    found = smooth_surface(rough.astype(np.float32), np.where(columns < 48, 0.5, -0.5).astype(np.float32))
    error = np.abs(np.log(found / truth))
    assert np.median(error) < 0.005
    assert error[:, 47:49].max() < 0.05
    # Depth of half the size is brought to the image's.
    half = smooth_surface(np.full((40, 48), 7.0, np.float32), np.zeros((80, 96), np.float32))
    np.testing.assert_allclose(half, np.full((80, 96), 7.0), rtol=1e-4)


def test_the_rim_is_the_near_side_of_an_edge():
    log_depth = np.where(np.arange(96) < 50, 3.0, 3.5).astype(np.float32)[None].repeat(80, axis=0)
    rim = near_rim(log_depth, 6)
    assert rim[40, 45:50].all()
    assert not rim[:, 50:].any()
    assert not rim[:, :40].any()
    assert not near_rim(np.full((80, 96), 3.0, np.float32), 6).any()


def test_confidence_rises_with_support_and_falls_at_edges():
    flat = np.full((80, 96), 3.0, np.float32)
    levels = [depth_confidence(flat, n * FLOAT, 0.01 * FLOAT, ~ALL)[40, 40] for n in (0.0, 0.3, 1.0, 3.0, 9.0)]
    assert levels[0] == 0.0
    assert (np.diff(levels) > 0.0).all()
    assert levels[-1] < 1.0
    edge = flat.copy()
    edge[:, 48:] = 3.4
    at_edge = depth_confidence(edge, 3.0 * FLOAT, 0.01 * FLOAT, ~ALL)
    assert at_edge[40, 46] < at_edge[40, 10]
    assert depth_confidence(flat, 3.0 * FLOAT, 0.01 * FLOAT, ALL)[40, 40] < levels[3]


def camera_pose(x):
    matrix = np.eye(4)
    matrix[0, 3] = x
    return Pose.of(Camera(60.0, 60.0, 48.0, 40.0, 96, 80, torch.from_numpy(matrix)))


def test_points_are_where_three_frames_are_sure():
    image = np.full((80, 96, 3), 100, np.uint8)
    voxels = VoxelPoints(2.0, np.zeros(3))
    for x in (0.0, 0.3, 0.6):
        voxels.add(camera_pose(x), 31.0 * FLOAT, FLOAT, image)
    # A fourth frame that disagrees makes no shell, and one without confidence nothing at all.
    voxels.add(camera_pose(0.9), 41.0 * FLOAT, FLOAT, image)
    voxels.add(camera_pose(1.2), 51.0 * FLOAT, 0.5 * FLOAT, image)
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
    prior = FilePrior.of(tmp_path, [frame])
    found = np.exp(prior.log_depth(frame, ALL, np.log(depth).astype(np.float32), half, 40.0))
    np.testing.assert_allclose(found, depth, rtol=2e-3)
    # Without known depth the scale is a guess.
    guess = np.exp(prior.log_depth(frame, ALL, NOWHERE, NOWHERE, 40.0))
    assert np.median(guess) == pytest.approx(40.0, rel=1e-3)
    if suffix == "npy":  # a larger map of the same aspect is taken
        np.save(tmp_path / "lit.npy", np.kron(values, np.ones((2, 2))))
        found = FilePrior.of(tmp_path, [frame]).log_depth(frame, ALL, np.log(depth).astype(np.float32), FLOAT, 40.0)
        np.testing.assert_allclose(np.exp(found), depth, rtol=1e-3)


def test_files_that_do_not_fit_are_refused(tmp_path):
    frame, depth = lit_frame()
    with pytest.raises(InputError, match="no such folder"):
        FilePrior.of(tmp_path / "none", [frame])
    with pytest.raises(InputError, match="1 of 1 frames have no depth map: lit"):
        FilePrior.of(tmp_path, [frame])
    np.save(tmp_path / "lit.npy", depth[:, :60])
    with pytest.raises(InputError, match="60 x 80 pixels, frame lit 96 x 80"):
        FilePrior.of(tmp_path, [frame])


def grid(size=12):
    return np.stack(np.meshgrid(np.arange(size), np.arange(size)), axis=-1).reshape(-1, 2) * 5.0


def test_a_point_unlike_its_neighbours_stands_out_and_an_edge_does_not():
    pixels = grid()
    log_depth = np.where(pixels[:, 0] < 30.0, 3.0, 4.0)
    clean = difference_from_neighbours(pixels, log_depth)
    np.testing.assert_array_equal(clean, 0.0)
    log_depth[40] += 0.7
    found = difference_from_neighbours(pixels, log_depth)
    assert found[40] == pytest.approx(0.7)
    np.testing.assert_array_equal(np.delete(found, 40), 0.0)
    assert np.isnan(difference_from_neighbours(pixels[:8], log_depth[:8])).all()
