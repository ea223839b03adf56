"""Surface points under known poses, and closed forms of their tracks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError
from coliags_plugin.datamanagers.colmap.reader import ColmapDataManager, ColmapSettings
from coliags_plugin.datamanagers.recognition import find_format
from coliags_plugin.engine.data_formats import open_scene
from coliags_plugin.geometry.poses.rigid import FLIP_Y_AND_Z, inverse
from coliags_plugin.reconstruction.structure.colmap_scene import write_colmap_scene
from coliags_plugin.reconstruction.structure.outliers import (
    difference_from_lamp,
    difference_from_neighbours,
    median_of_points,
)
from coliags_plugin.reconstruction.structure.tracks import LEAST_NOISE, NOISE_WEIGHT, Tracks, uncertainty, widest_angles
from coliags_plugin.reconstruction.structure.triangulation import (
    TriangulationSettings,
    fitting,
    in_pixels_of,
    triangulate,
)
from tests.textured_tube import texture, tube_frames

FRAMES = tube_frames()
SETTINGS = TriangulationSettings()


@pytest.fixture(scope="module")
def found():
    return triangulate(FRAMES)


def depth_errors(found, frames):
    """Shares of the true depth that the points of each frame are off by, where it is known."""
    errors = []
    for frame, seen in zip(frames, found.observations, strict=True):
        column, row = seen.pixels.astype(int).T
        errors.append(seen.depth / frame.depth.numpy()[row, column] - 1.0)
    errors = np.concatenate(errors)
    return errors[np.isfinite(errors)]


def moved(frame, camera_to_world):
    return replace(frame, camera=replace(frame.camera, camera_to_world=torch.from_numpy(camera_to_world)))


def test_points_lie_on_the_surface(found):
    assert len(found) > 300
    errors = depth_errors(found, FRAMES)
    assert np.median(np.abs(errors)) < 0.01
    assert np.quantile(np.abs(errors), 0.9) < 0.04
    assert abs(np.median(errors)) < 0.003
    # What it says of itself is of the right size.
    assert 0.2 < np.median(np.abs(errors)) / np.median(found.depth_uncertainty) < 2.0


def test_points_have_the_colour_of_the_surface(found):
    assert np.median(np.abs(found.colors - texture(found.positions))) < 10


def test_observations_reproject_and_add_up(found):
    seen_in = np.zeros(len(found), int)
    errors = np.zeros(len(found))
    for frame, seen in zip(FRAMES, found.observations, strict=True):
        pixels, depth = frame.camera.project(torch.from_numpy(found.positions[seen.points]))
        error = np.linalg.norm(pixels.numpy() - seen.pixels, axis=1)
        assert error.max() < SETTINGS.max_reprojection_error + 0.1
        np.testing.assert_allclose(depth, seen.depth)
        np.add.at(seen_in, seen.points, 1)
        np.add.at(errors, seen.points, error)
    np.testing.assert_array_equal(seen_in, found.track_lengths)
    np.testing.assert_allclose(errors / seen_in, found.errors)
    assert found.track_lengths.min() >= SETTINGS.min_track_length
    assert found.depth_uncertainty.max() <= SETTINGS.max_depth_uncertainty
    assert found.summary().startswith(f"{len(found)} points of {found.found} found, seen in")


def test_residuals_are_in_pixels_of_the_working_size(found):
    half = tube_frames(size=(80, 64))
    converted = in_pixels_of(found, FRAMES, half)
    np.testing.assert_allclose(converted.errors, found.errors / 2, rtol=1e-3)
    assert converted.pixel_noise == pytest.approx(found.pixel_noise / 2)
    for frame, seen in zip(half, converted.observations, strict=True):
        pixels, depth = frame.camera.project(torch.from_numpy(found.positions[seen.points]))
        assert np.linalg.norm(pixels.numpy() - seen.pixels, axis=1).max() < SETTINGS.max_reprojection_error / 2 + 0.05
        np.testing.assert_allclose(depth, seen.depth)
    with pytest.raises(InputError, match="the same frames at two sizes"):
        in_pixels_of(found, FRAMES, half[1:])


def test_the_same_frames_give_the_same_points():
    one, other = (triangulate(FRAMES[:5]) for _ in range(2))
    np.testing.assert_array_equal(one.positions, other.positions)
    np.testing.assert_array_equal(one.colors, other.colors)


def test_another_world_gives_the_same_points_in_it():
    """Poses are taken as they are: turned, moved, and in another unit."""
    turn = Rotation.from_rotvec([0.4, -2.0, 1.0]).as_matrix()
    elsewhere = []
    for frame in FRAMES[:5]:
        c2w = frame.camera.camera_to_world.numpy().copy()
        c2w[:3] = np.hstack([turn @ c2w[:3, :3], turn @ (0.1 * c2w[:3, 3:]) + [[5.0], [6.0], [7.0]]])
        elsewhere.append(moved(frame, c2w))
    here, there = triangulate(FRAMES[:5]), triangulate(elsewhere)
    expected = 0.1 * here.positions @ turn.T + [5.0, 6.0, 7.0]
    assert len(there) == pytest.approx(len(here), rel=0.05)
    distance = np.linalg.norm(expected[:, None] - there.positions[None], axis=2).min(axis=1)
    assert np.median(distance) < 1e-3


def test_settings_do_what_they_say():
    strict = triangulate(
        FRAMES, TriangulationSettings(min_track_length=6, max_depth_uncertainty=0.01, max_reprojection_error=0.3)
    )
    assert strict.track_lengths.min() >= 6
    assert strict.depth_uncertainty.max() <= 0.01
    assert strict.errors.max() <= 0.3


def test_what_is_masked_gives_no_points():
    mask = torch.ones(FRAMES[0].image.shape[:2], dtype=torch.bool)
    mask[:, :80] = False
    masked = triangulate([replace(frame, mask=mask) for frame in FRAMES[:6]])
    assert min(seen.pixels[:, 0].min() for seen in masked.observations if len(seen.pixels)) > 82
    assert len(masked) > 20


def test_progress_is_told():
    told = []
    triangulate(FRAMES[:4], progress=lambda *args: told.append(args))
    assert told == [*(("find features", n, 4) for n in range(1, 5)), *(("match features", n, 6) for n in range(1, 7))]


# The written scene


def test_the_written_scene_has_the_points_and_their_depth(found, tmp_path):
    write_colmap_scene(tmp_path / "scene", FRAMES, found)
    assert find_format(tmp_path / "scene") == "colmap"
    scene = ColmapDataManager(ColmapSettings(split="all-train")).load(tmp_path / "scene")
    assert len(scene.train) == len(FRAMES)
    for frame, truth, seen in zip(scene.train, FRAMES, found.observations, strict=True):
        np.testing.assert_array_equal(frame.image, truth.image)
        assert frame.mask is None
        torch.testing.assert_close(
            frame.camera.camera_to_world.double(), truth.camera.camera_to_world, atol=1e-5, rtol=0
        )
        assert (frame.camera.fx, frame.camera.fy, frame.camera.cx, frame.camera.cy) == pytest.approx(
            (truth.camera.fx, truth.camera.fy, truth.camera.cx, truth.camera.cy)
        )
        points = torch.from_numpy(found.positions[np.sort(np.unique(seen.points))])
        pixels, depth = truth.camera.project(points)
        order, expected = np.argsort(frame.sparse_depth.depth), np.argsort(depth)
        np.testing.assert_allclose(frame.sparse_depth.depth[order], depth[expected], rtol=1e-5)
        np.testing.assert_allclose(frame.sparse_depth.pixels[order], pixels[expected], atol=1e-3)
    order, expected = (np.lexsort(points.T) for points in (scene.points.positions.numpy(), found.positions))
    np.testing.assert_allclose(scene.points.positions[order], found.positions[expected], rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(scene.points.colors[order], found.colors[expected])


def test_held_out_frames_are_written_and_see_nothing(tmp_path):
    mask = torch.zeros(FRAMES[0].image.shape[:2], dtype=torch.bool)
    mask[30:, 30:] = True
    train = [replace(frame, mask=mask) for frame in FRAMES if frame.index % 8]
    write_colmap_scene(tmp_path / "scene", train, triangulate(train), FRAMES[::8])
    scene = open_scene(tmp_path / "scene")
    assert [frame.name for frame in scene.test_sets["test"]] == ["0000", "0008"]
    assert all(frame.sparse_depth is None and frame.mask is None for frame in scene.test_sets["test"])
    assert "held_out_used" not in scene.provenance
    assert all(len(frame.sparse_depth.depth) > 20 for frame in scene.train)
    assert all((frame.mask == mask).all() for frame in scene.train)


def test_names_are_made_to_sort_and_to_be_files(tmp_path):
    frames = [replace(frame, name=name) for frame, name in zip(FRAMES[:4], ("b/9", "b/10", "a", "a"), strict=True)]
    write_colmap_scene(tmp_path / "scene", frames, triangulate(frames))
    scene = open_scene(tmp_path / "scene", options=["split=all-train"])
    assert [frame.name for frame in scene.train] == ["00000_b-9", "00001_b-10", "00002_a", "00003_a"]
    for frame, truth in zip(scene.train, frames, strict=True):
        np.testing.assert_array_equal(frame.image, truth.image)


def test_other_frames_or_a_folder_that_is_there_are_refused(found, tmp_path):
    with pytest.raises(InputError, match="a triangulation of 10 frames, and 9 frames"):
        write_colmap_scene(tmp_path / "scene", FRAMES[:9], found)
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "mine").touch()
    with pytest.raises(InputError, match="already exists"):
        write_colmap_scene(tmp_path / "scene", FRAMES, found)
    assert [path.name for path in tmp_path.rglob("*")] == ["scene", "mine"]
    write_colmap_scene(tmp_path / "scene", FRAMES, found, overwrite=True)
    assert not (tmp_path / "scene" / "mine").exists()


# Refusals


def test_a_camera_that_only_turns_is_refused():
    turned = []
    for frame in FRAMES[:4]:
        c2w = frame.camera.camera_to_world.numpy().copy()
        c2w[:3, 3] = 1.0, 2.0, 3.0
        turned.append(moved(frame, c2w))
    with pytest.raises(InputError, match=r"all 4 cameras are at the same position.*gives no depth"):
        triangulate(turned)


@pytest.mark.parametrize("change", ["reversed", "world-to-camera", "OpenGL", "transposed"])
def test_poses_that_are_not_the_frames_own_are_refused(change):
    poses = np.stack([frame.camera.camera_to_world.numpy() for frame in FRAMES])
    if change == "reversed":
        poses = poses[::-1]
    elif change == "world-to-camera":
        poses = inverse(poses)
    elif change == "OpenGL":
        poses = poses @ FLIP_Y_AND_Z
    else:
        poses[:, :3, :3] = poses[:, :3, :3].transpose(0, 2, 1)
    with pytest.raises(InputError, match=r"depth uncertainty of.*Check the poses first \(coliags data check\)"):
        triangulate([moved(frame, pose.copy()) for frame, pose in zip(FRAMES, poses, strict=True)])


def test_images_without_anything_in_them_are_refused():
    blank = [replace(frame, image=torch.full_like(frame.image, 90)) for frame in FRAMES[:3]]
    with pytest.raises(InputError, match=r"no features of 3 frames \(0 a frame\) match"):
        triangulate(blank)


# The phantom


def test_points_of_a_phantom_lie_on_its_wall(phantom):
    scene = open_scene(phantom, options=["split=all-train", "initial_points=none"])
    frames = [frame.to("cpu") for frame in scene.train]
    assert isinstance(frames[0].camera, Camera)
    found = triangulate(frames)
    assert len(found) > 250
    assert found.errors.mean() < 0.5
    errors = depth_errors(found, frames)
    assert np.median(np.abs(errors)) < 0.025
    assert abs(np.median(errors)) < 0.005


F, DEPTH, BASELINE = 120.0, 30.0, 4.0


def camera(x):
    c2w = torch.eye(4, dtype=torch.float64)
    c2w[0, 3] = x
    return Camera(F, F, 50.0, 40.0, 100, 80, c2w)


CAMERAS = [camera(-BASELINE / 2), camera(BASELINE / 2)]


def tracks(points, shift=0.0):
    """Seen by both cameras, the second ``shift`` pixels to the side of where it should."""
    points = np.asarray(points, np.float64)
    pixels = [cam.project(torch.from_numpy(points))[0].numpy() for cam in CAMERAS]
    pixels[1] = pixels[1] + [shift, 0.0]
    numbers = np.arange(len(points))
    return Tracks(points, np.tile(numbers, 2), np.repeat([0, 1], len(points)), np.concatenate(pixels))


def test_what_points_leave_over():
    residuals, depth = tracks([[1.0, 2, DEPTH], [0, 0, 50]], shift=0.5).residuals(CAMERAS)
    np.testing.assert_allclose(residuals, [[0, 0], [0, 0], [-0.5, 0], [-0.5, 0]], atol=1e-12)
    np.testing.assert_allclose(depth, [DEPTH, 50, DEPTH, 50])


def test_the_angle_between_two_rays():
    expected = np.degrees(2 * np.arctan(BASELINE / 2 / DEPTH))
    assert widest_angles(tracks([[0.0, 0, DEPTH]]), CAMERAS) == pytest.approx(expected)


def test_depth_is_as_uncertain_as_the_parallax_is_small():
    """Between two cameras: sigma_z / z = sqrt(2) sigma z / (f b), and residuals of 0 lower sigma."""
    noise, shares = uncertainty(tracks([[0.0, 0, DEPTH], [0, 0, 2 * DEPTH]]), CAMERAS)
    assert noise == LEAST_NOISE
    own = noise * np.sqrt(NOISE_WEIGHT / (NOISE_WEIGHT + 1))
    np.testing.assert_allclose(shares, np.sqrt(2) * own * DEPTH / (F * BASELINE) * np.array([1, 2]), rtol=1e-6)


def test_residuals_tell_the_noise():
    """8 residuals, 2 of them 0.5 px, for 6 numbers that were fitted."""
    noise, shares = uncertainty(tracks([[0.0, 0, DEPTH], [3, 1, DEPTH]], shift=0.5), CAMERAS)
    assert noise == pytest.approx(np.sqrt(2 * 0.25 / 2))
    assert shares[0] == pytest.approx(np.sqrt(2) * noise * DEPTH / (F * BASELINE))


def test_parallel_rays_have_no_depth():
    far = tracks([[0.0, 0, 1e7]])
    assert uncertainty(far, CAMERAS)[1][0] > 100.0


def test_some_of_the_points():
    some = tracks([[0.0, 0, 10], [0, 1, 20], [0, 2, 30]]).only(np.array([True, False, True]))
    assert len(some) == 2
    np.testing.assert_array_equal(some.points, [0, 1, 0, 1])
    np.testing.assert_array_equal(some.frames, [0, 0, 1, 1])
    np.testing.assert_array_equal(some.lengths, [2, 2])
    np.testing.assert_allclose(some.residuals(CAMERAS)[1], [10, 30, 10, 30])
    assert len(some.only(np.array([False, False]))) == 0
    assert uncertainty(some.only(np.array([False, False])), CAMERAS)[1].shape == (0,)


# Outliers


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


@pytest.mark.parametrize("gain", [1.0, 0.3])
def test_a_near_point_that_is_dark_contradicts_the_lamp(gain):
    rng = np.random.default_rng(0)
    depth = rng.uniform(20.0, 80.0, 200)
    albedo = rng.uniform(0.7, 1.0, 200)
    brightness = 250.0 * gain * (albedo * (20.0 / depth) ** 2) ** (1 / 2.2)
    frames = np.repeat([0, 3], 100)
    depth[[7, 150]] = 0.5, 2000.0
    found = difference_from_lamp(brightness, np.log(depth), frames)
    assert (np.flatnonzero(found > 4.0) == [7, 150]).all()


def test_brightness_without_a_lamp_tells_nothing():
    rng = np.random.default_rng(0)
    found = difference_from_lamp(rng.uniform(20.0, 200.0, 500), rng.uniform(3.0, 4.0, 500), np.zeros(500, int))
    assert np.isnan(found).all()
    assert difference_from_lamp(np.empty(0), np.empty(0), np.empty(0, int)).shape == (0,)


def test_medians_of_points():
    values = np.array([3.0, np.nan, 1.0, 2.0, np.nan, 5.0, 4.0])
    points = np.array([0, 0, 0, 0, 2, 3, 3])
    np.testing.assert_array_equal(median_of_points(values, points, 4), [2.0, 0.0, 0.0, 4.0])


def test_points_at_wrong_depths_are_left_out():
    """Consistent in every view, as matches of a repeated texture are: only their neighbours and the lamp tell."""
    depth = [frame.depth.numpy() for frame in FRAMES]
    rng = np.random.default_rng(1)
    cameras = [frame.camera for frame in FRAMES]
    positions, points, frames, pixels = [], [], [], []
    for number in range(400):
        pixel = rng.uniform(10.0, [150.0, 118.0])
        z = depth[4][int(pixel[1]), int(pixel[0])] * (0.5 if number % 10 == 0 else 1.0)
        if not np.isfinite(z):
            continue
        camera = cameras[4]
        ray = np.array([(pixel[0] - camera.cx) / camera.fx, (pixel[1] - camera.cy) / camera.fy, 1.0])
        c2w = camera.camera_to_world.numpy()
        positions.append((c2w[:3, :3] @ (z * ray) + c2w[:3, 3], number % 10 == 0))
        for index in (3, 4, 5):
            seen, front = cameras[index].project(torch.from_numpy(positions[-1][0][None]))
            if front[0] > 0.0:
                points.append(len(positions) - 1)
                frames.append(index)
                pixels.append(seen[0].numpy())
    wrong = np.array([is_wrong for _, is_wrong in positions])
    observed = Tracks(np.stack([p for p, _ in positions]), np.array(points), np.array(frames), np.array(pixels))
    kept = fitting(FRAMES, observed, SETTINGS)
    assert not kept[wrong].any()
    assert kept[~wrong].mean() > 0.8
