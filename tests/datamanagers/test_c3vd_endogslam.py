"""Particular to EndoGSLAM's data: poses of a SLAM that wanders, its map, 8-bit depth, and PR-Endo's release."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scenes import Scene
from coliags_plugin.geometry.poses.trajectory import inverse, rigid, wxyz_from_rotations
from coliags_plugin.phantom.layouts import depth_steps
from tests.datamanagers.kinds import change_npz, files
from tests.datamanagers.wall_scenes import (
    HEIGHT,
    WIDTH,
    load_scene,
    names,
    off_wall,
    poses,
    worst_off_wall,
    write_wall,
)

PARAMS = "params.npz"

KIND = "c3vd-endogslam"
load = partial(load_scene, "c3vd-endogslam")


def matrices(scene: Scene) -> np.ndarray:
    return np.array([frame.camera.camera_to_world.double().numpy() for frame in scene.video])


def from_first(count: int) -> np.ndarray:
    return inverse(poses(1))[0] @ poses(count)


def training(count: int) -> np.ndarray:
    return np.array([index for index in range(count) if index % 8 != 7])


def estimate(folder: Path, images: np.ndarray, wander: Callable[[np.ndarray], np.ndarray], **changes) -> None:
    """EndoGSLAM's result for some images of the wall, with poses that wander and true ones."""

    def change(arrays: dict) -> None:
        true = from_first(max(images) + 1)[images]
        w2c = inverse(wander(true))
        # Not of unit length: EndoGSLAM's are not.
        arrays["cam_unnorm_rots"] = (1.7 * wxyz_from_rotations(w2c[:, :3, :3])).T[None].astype(np.float32)
        arrays["cam_trans"] = w2c[:, :3, 3].T[None].astype(np.float32)
        arrays["gt_w2c_all_frames"] = inverse(true)
        arrays.update(changes)

    change_npz(PARAMS, change)(folder)


def drift(pose: np.ndarray) -> np.ndarray:
    """A turn and a shift that grow along the video, from none at its first frame."""
    share = np.arange(len(pose)) / len(pose)
    turns = Rotation.from_rotvec(np.outer(share, [0.01, -0.02, 0.03])).as_matrix()
    return rigid(turns @ pose[:, :3, :3], pose[:, :3, 3] + np.outer(share, [0.3, 0.1, -0.2]))


@pytest.fixture
def release(copied):
    """The root of a copy of PR-Endo's release."""
    return copied("pr-endo").parents[1]


@pytest.mark.parametrize("kind", ["c3vd-endogslam", "pr-endo"])
@pytest.mark.parametrize("source", ["slam", "ground-truth"])
def test_points_are_the_map_in_the_world_of_the_poses(walls, kind, source):
    scene = load(walls(kind), poses=source)
    is_true = scene.provenance.world == "pose.txt"
    assert is_true == (source == "ground-truth" and kind == "c3vd-endogslam")
    world = np.eye(4) if is_true else poses(1)[0]
    np.testing.assert_allclose(world @ matrices(scene), poses(11), atol=1e-4)
    points = scene.points.positions.double().numpy() @ world[:3, :3].T + world[:3, 3]
    assert off_wall(points).max() < 1e-3
    assert scene.provenance.points.source.endswith("params.npz" if kind == "c3vd-endogslam" else "cloud.ply")


def test_the_release_is_read_from_its_root_or_its_scene(release, walls):
    root, scene = load(release), load(walls("pr-endo"))
    np.testing.assert_array_equal(matrices(root), matrices(scene))
    assert root.provenance.layout == "pr-endo"
    assert root.provenance.slam["compared_with_pose_file"] is None
    clouds = release / "C3VD_endogslam_optimized/phantom/point_cloud"
    for iteration in (7000, 100_000):
        (clouds / f"iteration_{iteration}").mkdir()
        (clouds / f"iteration_{iteration}/point_cloud.ply").write_text("ply")
    with pytest.raises(InputError, match=r"iteration_100000/point_cloud.ply"):
        load(release)
    for part in ("C3VD", "C3VD_endogslam_optimized"):
        shutil.copytree(release / part / "phantom", release / part / "again")
    with pytest.raises(InputError, match=r"holds several scenes.*C3VD/again"):
        load(release)


# Poses


@pytest.mark.parametrize(("count", "every"), [(5, False), (16, False), (17, False), (11, True)])
def test_poses_go_to_the_frames_that_were_tracked(tmp_path, count, every):
    folder = write_wall(tmp_path / "wall", "endogslam", count)
    tracked = np.arange(count) if every else training(count)
    estimate(folder, tracked, drift)
    scene = load(folder, split="all-train")
    np.testing.assert_allclose(matrices(scene)[tracked], drift(from_first(count)[tracked]), atol=1e-4)
    facts = scene.provenance.slam
    assert facts["frames"] == len(tracked)
    assert facts["images"] == ("every" if len(tracked) == count else "all but 7, 15, 23, ...")


def test_test_frames_take_true_poses_brought_into_the_mapped_world(mine):
    estimate(mine, training(11), drift)
    scene = load(mine)
    (frame,) = scene.test_sets["test"]
    true, mapped = from_first(11)[training(11)], drift(from_first(11)[training(11)])
    # The mean turn as the rotation nearest to the mean of all turns, then the mean of what is left.
    left, _, right = np.linalg.svd((mapped[:, :3, :3] @ true[:, :3, :3].transpose(0, 2, 1)).mean(axis=0))
    turn = left @ right
    motion = rigid(turn[None], (mapped[:, :3, 3] - true[:, :3, 3] @ turn.T).mean(axis=0)[None])[0]
    np.testing.assert_allclose(frame.camera.camera_to_world, motion @ from_first(11)[7], atol=1e-4)
    facts = scene.provenance.slam
    errors = np.linalg.norm((motion @ true - mapped)[:, :3, 3], axis=1)
    assert facts["ate_rmse_mm"] == pytest.approx(np.sqrt((errors**2).mean()), abs=1e-4)
    compared = facts["compared_with_pose_file"]
    assert 0.0 <= compared["largest_distance_mm"] < 1e-3 and compared["largest_angle_deg"] < 1e-2


def test_a_rigid_error_is_undone_to_the_digit(mine):
    """Test frames turn with a map that was made in a turned world."""
    turn = rigid(Rotation.from_rotvec([[0.3, -0.2, 0.5]]).as_matrix(), np.array([[4.0, -2.0, 1.0]]))[0]
    colors = {"means3D": np.array([[1.0, 2.0, 3.0]]), "rgb_colors": np.array([[0.5, 0.2, 1.2]])}
    estimate(mine, training(11), lambda pose: turn @ pose, **colors, log_scales=np.zeros((1, 1)))
    scene = load(mine)
    np.testing.assert_allclose(matrices(scene), turn @ from_first(11), atol=1e-4)
    assert scene.provenance.slam["ate_rmse_mm"] < 1e-4
    np.testing.assert_allclose(scene.points.positions, [[1.0, 2.0, 3.0]], atol=1e-6)
    assert scene.points.colors.tolist() == [[128, 51, 255]]
    (point,) = load(mine, poses="ground-truth").points.positions.double().numpy()
    back = poses(1)[0] @ np.linalg.inv(turn) @ [1.0, 2.0, 3.0, 1.0]
    np.testing.assert_allclose(point, back[:3], atol=1e-4)


def test_a_run_that_lost_its_way_is_called_so(mine, caplog):
    """Stopped early: the remaining poses are as they were initialised."""
    estimate(mine, training(11), lambda pose: np.where((np.arange(10) >= 5)[:, None, None], np.eye(4), pose))
    load(mine)
    assert "tracking failed or stopped early" in caplog.text and "params.npz" in caplog.text


def test_the_result_may_be_named(mine, tmp_path):
    (tmp_path / "experiments").mkdir()
    elsewhere = (mine / PARAMS).rename(tmp_path / "experiments/x.npz")
    for name in (str(elsewhere), "../experiments/x.npz"):
        assert load(mine, params_file=name).provenance.slam["frames"] == 10
    with pytest.raises(InputError, match=r"no file .*y.npz.*params_file"):
        load(mine, params_file="y.npz")


def test_rotation_views_need_the_world_of_the_scene(mine):
    estimate(mine, np.arange(11), drift)
    (mine / "pose.txt").unlink()
    with pytest.raises(InputError, match=r"rotation has images, but the scene has no pose.txt"):
        load(mine)


# Images, depth, cameras and points


def test_depth_may_be_of_16_bits(mine, walls):
    for path in [*files(mine, "depth/*.tiff"), *files(mine, "rotation/depth/*.tiff")]:
        stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(path), depth_steps((stored + 0.5) / 2.55))
    scene = load(mine, poses="ground-truth")
    assert scene.provenance.depth_step_mm == 100 / 65535 and worst_off_wall(scene.train[1]) < 0.25
    assert load(walls("c3vd-endogslam")).provenance.depth_step_mm == 100 / 255


def test_without_a_result_the_camera_is_endogslams(mine):
    (mine / PARAMS).unlink()
    scene = load(mine, poses="ground-truth")
    assert scene.provenance.intrinsics_from == "EndoGSLAM's table"
    assert scene.train[0].camera.fx == pytest.approx(401.1595 * WIDTH / 675)
    assert names(scene.test_sets["rotation"]) == ["rotation-0000_color", "rotation-0001_color"]
    assert max(worst_off_wall(frame) for frame in (*scene.train, *scene.test_sets["rotation"])) < 0.5
    for path in files(mine, "color/*.png"):
        cv2.imwrite(str(path), np.zeros((48, 64, 3), np.uint8))
    with pytest.raises(InputError, match=r"0000_color.png is 64 x 48, but EndoGSLAM's calibration is for 675 x 540"):
        load(mine, poses="ground-truth")


def test_intrinsics_of_another_size_are_scaled_where_their_size_is_told(mine, walls):
    def larger(arrays: dict) -> None:
        k = arrays["intrinsics"]
        arrays["intrinsics"] = np.array(
            [[2 * k[0, 0], 0, 2 * k[0, 2] + 0.5], [0, 2 * k[1, 1], 2 * k[1, 2] + 0.5], k[2]]
        )
        arrays.update(org_width=np.array(2 * WIDTH), org_height=np.array(2 * HEIGHT))

    change_npz(PARAMS, larger)(mine)
    loaded, expected = (load(folder).train[0].camera.intrinsics for folder in (mine, walls("c3vd-endogslam")))
    assert vars(loaded) == pytest.approx(vars(expected), rel=1e-6)


def test_points_come_from_depth_where_the_map_is_empty(mine):
    empty = {"means3D": np.zeros((0, 3)), "rgb_colors": np.zeros((0, 3)), "log_scales": np.zeros((0, 1))}
    change_npz(PARAMS, lambda arrays: arrays.update(empty))(mine)
    scene = load(mine)
    assert len(scene.points) == 10 * WIDTH * HEIGHT
    assert scene.provenance.points.source == "depth of the training frames"
