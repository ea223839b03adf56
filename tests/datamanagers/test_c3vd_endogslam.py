"""The c3vd-endogslam data manager: phantoms, closed-form walls with a wandering SLAM, and what is refused."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.core.scenes import Scene
from coliags_plugin.datamanagers.c3vd.writer import depth_steps, write_poses
from coliags_plugin.datamanagers.c3vd_endogslam.reader import (
    PREPARED_DEPTH,
    PREPARED_PINHOLE,
    C3VDEndoGSLAMDataManager,
    C3VDEndoGSLAMSettings,
)
from coliags_plugin.geometry.poses import endogslam
from coliags_plugin.geometry.poses.rigid import inverse, rigid, wxyz_from_rotations
from coliags_plugin.geometry.poses.trajectory import Trajectory
from tests.datamanagers.wall_scenes import PINHOLE, look, off_wall, poses, rays
from tests.phantom.phantom_layouts import distance_from_wall, in_video_order, read, true_poses, write_phantom

WIDTH, HEIGHT = 64, 48


def load(folder: Path, **options) -> Scene:
    return C3VDEndoGSLAMDataManager(C3VDEndoGSLAMSettings(**options)).load(folder)


def write_prepared(folder: Path, count: int = 10, bits: int = 8, pinhole: Intrinsics = PINHOLE) -> Path:
    """The wall in EndoGSLAM's layout, without params.npz."""
    directions = rays(pinhole)
    (folder / "color").mkdir(parents=True)
    (folder / "depth").mkdir()
    for index, pose in enumerate(poses(count)):
        depth, color = look(pose, directions)
        steps = np.floor(depth * 2.55).clip(0, 255).astype(np.uint8) if bits == 8 else depth_steps(depth)
        cv2.imwrite(str(folder / f"color/{index:04d}_color.png"), color[..., ::-1])
        cv2.imwrite(str(folder / f"depth/{index:04d}_depth.tiff"), steps)
    write_poses(folder / "pose.txt", poses(count))
    return folder


def training(count: int) -> np.ndarray:
    return np.array([index for index in range(count) if index % 8 != 7])


def write_params(
    path: Path,
    images: np.ndarray,
    wander: Callable[[np.ndarray], np.ndarray] = lambda pose: pose,
    points: np.ndarray | None = None,
    **changes,
) -> Path:
    """EndoGSLAM's result for some images of the wall, with poses that wander and true ones; points in its world."""
    true = poses(max(images) + 1)[images]
    path.parent.mkdir(parents=True, exist_ok=True)
    endogslam.write(path, Trajectory(true, intrinsics=PINHOLE))
    with np.load(path) as file:
        arrays = dict(file)
    estimate = wander(inverse(true[:1])[0] @ true)
    w2c = inverse(estimate)
    # Not of unit length: EndoGSLAM's are not.
    arrays["cam_unnorm_rots"] = (1.7 * wxyz_from_rotations(w2c[:, :3, :3])).T[None].astype(np.float32)
    arrays["cam_trans"] = w2c[:, :3, 3].T[None].astype(np.float32)
    if points is not None:
        arrays |= {"means3D": points, "rgb_colors": np.tile([0.5, 0.2, 1.2], (len(points), 1))}
        arrays |= {"log_scales": np.zeros((len(points), 1))}
    arrays |= changes
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})
    return path


def drift(pose: np.ndarray) -> np.ndarray:
    """A turn and a shift that grow along the video, from none at its first frame."""
    share = np.arange(len(pose)) / len(pose)
    turns = Rotation.from_rotvec(np.outer(share, [0.01, -0.02, 0.03])).as_matrix()
    return rigid(turns @ pose[:, :3, :3], pose[:, :3, 3] + np.outer(share, [0.3, 0.1, -0.2]))


def matrices(scene: Scene) -> np.ndarray:
    return np.array([frame.camera.camera_to_world.double().numpy() for frame in in_video_order(scene)])


def from_first(count: int) -> np.ndarray:
    return inverse(poses(1))[0] @ poses(count)


@pytest.fixture(scope="module")
def prepared(tmp_path_factory):
    return write_prepared(tmp_path_factory.mktemp("endogslam") / "C3VD" / "wall")


@pytest.fixture
def mine(prepared, tmp_path):
    """A copy to spoil, without params.npz."""
    return Path(shutil.copytree(prepared, tmp_path / "C3VD" / "wall"))


@pytest.fixture(scope="module")
def phantom(tmp_path_factory):
    return write_phantom(tmp_path_factory.mktemp("phantoms") / "endogslam", "endogslam", frames=16)


@pytest.fixture(scope="module")
def release(tmp_path_factory):
    return write_phantom(tmp_path_factory.mktemp("phantoms") / "pr-endo", "pr-endo", frames=16)


class TestPhantoms:
    def test_points_are_the_map_in_the_world_of_the_poses(self, phantom, release):
        for folder, name in ((phantom, "params.npz"), (release, "point_cloud.ply")):
            for source in ("slam", "ground-truth"):
                scene = read(folder, "c3vd-endogslam", poses=source)
                true = true_poses(folder)
                world = np.eye(4) if scene.provenance["world"] == "pose.txt" else true[0]
                points = scene.points.positions.double() @ torch.from_numpy(world[:3, :3].T) + torch.from_numpy(
                    world[:3, 3]
                )
                assert distance_from_wall(folder, points).max() < 0.05
                assert scene.provenance["points"]["source"].endswith(name)
                assert scene.points.colors.float().mean(0)[0] > 100

    def test_intrinsics_are_halved_c3vds(self, phantom):
        camera = read(phantom, "c3vd-endogslam").train[0].camera
        k = PREPARED_PINHOLE.resized(64, 51)
        assert (camera.fx, camera.fy) == pytest.approx((k.fx, k.fy))
        assert (camera.cx, camera.cy) == pytest.approx((k.cx, k.cy))

    def test_split_rotation_views_and_marks(self, phantom):
        scene = read(phantom, "c3vd-endogslam")
        assert [frame.name for frame in scene.test_sets["test"]] == ["0007_color", "0015_color"]
        assert all(frame.seen is not None for frame in (*scene.test_sets["test"], *scene.test_sets["rotation"]))
        # A rotation view is taken where a training frame was.
        for turned in scene.test_sets["rotation"]:
            near = min(float((turned.camera.center - frame.camera.center).norm()) for frame in scene.train)
            assert near < 1e-3
        assert read(phantom, "c3vd-endogslam", split="every-8th").test_sets["test"][0].seen is None

    def test_ground_truth_is_pose_txts_world(self, phantom):
        scene = read(phantom, "c3vd-endogslam", poses="ground-truth")
        np.testing.assert_allclose(matrices(scene), true_poses(phantom), atol=1e-4)
        assert scene.provenance["world"] == "pose.txt"

    def test_release_is_read_from_its_root_or_its_scene(self, release):
        root, scene = (read(folder, "c3vd-endogslam") for folder in (release, release / "C3VD" / "phantom"))
        np.testing.assert_array_equal(matrices(root), matrices(scene))
        assert root.provenance["layout"] == scene.provenance["layout"] == "pr-endo"
        assert all(frame.seen is not None for frame in root.test_sets["test"])
        assert root.provenance["slam"]["compared_with_pose_file"] is None

    def test_no_pose_txt_but_true_poses_of_all_frames(self, release):
        scene = read(release, "c3vd-endogslam", poses="ground-truth")
        true = true_poses(release)
        np.testing.assert_allclose(matrices(scene), inverse(true[:1])[0] @ true, atol=1e-4)
        assert scene.provenance["world"] == "first camera"


class TestPoses:
    @pytest.mark.parametrize("count", [5, 10, 16, 17, 24])
    def test_poses_of_training_frames_go_to_training_frames(self, tmp_path, count):
        folder = write_prepared(tmp_path / "wall", count)
        write_params(folder / "params.npz", training(count), drift)
        found = matrices(load(folder, split="all-train"))
        np.testing.assert_allclose(found[training(count)], drift(from_first(count)[training(count)]), atol=1e-4)
        facts = load(folder).provenance["slam"]
        assert facts["frames"] == count - count // 8
        assert facts["images"] == ("every" if count < 8 else "all but 7, 15, 23, ...")

    def test_poses_of_all_frames_go_to_all_frames(self, mine):
        write_params(mine / "params.npz", np.arange(10), drift)
        np.testing.assert_allclose(matrices(load(mine)), drift(from_first(10)), atol=1e-4)

    def test_test_frames_take_true_poses_brought_into_the_mapped_world(self, mine):
        write_params(mine / "params.npz", training(10), drift)
        scene = load(mine)
        (frame,) = scene.test_sets["test"]
        true, mapped = from_first(10)[training(10)], drift(from_first(10)[training(10)])
        # The mean turn as the rotation nearest to the mean of all turns, then the mean of what is left.
        left, _, right = np.linalg.svd((mapped[:, :3, :3] @ true[:, :3, :3].transpose(0, 2, 1)).mean(axis=0))
        turn = left @ right
        shift = (mapped[:, :3, 3] - true[:, :3, 3] @ turn.T).mean(axis=0)
        motion = rigid(turn[None], shift[None])[0]
        np.testing.assert_allclose(frame.camera.camera_to_world, motion @ from_first(10)[7], atol=1e-4)
        facts = scene.provenance["slam"]
        errors = np.linalg.norm((motion @ true - mapped)[:, :3, 3], axis=1)
        assert facts["ate_rmse_mm"] == pytest.approx(np.sqrt((errors**2).mean()), abs=1e-4)
        assert facts["ate_max_mm"] == pytest.approx(errors.max(), abs=1e-4)
        assert facts["mean_rotation_error_deg"] > 0.1
        assert "rigid fit" in facts["other_images"]

    def test_a_rigid_error_is_undone_to_the_digit(self, mine):
        """As if the map had been made in a turned world: then test frames turn with it."""
        turn = rigid(Rotation.from_rotvec([[0.3, -0.2, 0.5]]).as_matrix(), np.array([[4.0, -2.0, 1.0]]))[0]
        write_params(mine / "params.npz", training(10), lambda pose: turn @ pose, points=np.array([[1.0, 2.0, 3.0]]))
        scene = load(mine)
        np.testing.assert_allclose(matrices(scene), turn @ from_first(10), atol=1e-4)
        assert scene.provenance["slam"]["ate_rmse_mm"] < 1e-4
        np.testing.assert_allclose(scene.points.positions, [[1.0, 2.0, 3.0]], atol=1e-6)
        (point,) = load(mine, poses="ground-truth").points.positions.double().numpy()
        back = poses(1)[0] @ np.linalg.inv(turn) @ [1.0, 2.0, 3.0, 1.0]
        np.testing.assert_allclose(point, back[:3], atol=1e-4)

    def test_a_straight_path_is_no_hindrance(self, mine):
        """Places on a line leave a turn about it free; orientations do not."""
        straight = np.tile(np.eye(4), (10, 1, 1))
        straight[:, 2, 3] = np.arange(10)
        straight[1:, :3, :3] = Rotation.from_rotvec([0.0, 0.0, 1e-9]).as_matrix()
        write_poses(mine / "pose.txt", straight)
        write_params(mine / "params.npz", training(10))
        with np.load(mine / "params.npz") as file:
            arrays = dict(file)
        places = straight[training(10)].copy()
        arrays["gt_w2c_all_frames"] = inverse(places)
        # Noise sideways, of which a fit to places alone would make a turn.
        places[:, :2, 3] += 0.01 * np.random.default_rng(1).normal(size=(len(places), 2))
        w2c = inverse(places)
        arrays["cam_unnorm_rots"] = wxyz_from_rotations(w2c[:, :3, :3]).T[None]
        arrays["cam_trans"] = w2c[:, :3, 3].T[None]
        np.savez(mine / "params.npz", **arrays)
        (frame,) = load(mine).test_sets["test"]
        np.testing.assert_allclose(frame.camera.camera_to_world, straight[7], atol=0.01)

    def test_how_far_true_poses_are_from_pose_txt_is_told(self, mine):
        write_params(mine / "params.npz", training(10), drift)
        compared = load(mine).provenance["slam"]["compared_with_pose_file"]
        assert 0.0 <= compared["largest_distance_mm"] < 1e-3 and compared["largest_angle_deg"] < 1e-2

    def test_a_run_that_lost_its_way_is_called_so(self, mine, caplog):
        write_params(mine / "params.npz", training(10), drift)
        load(mine)
        assert not caplog.records
        # Stopped early: the remaining poses are as they were initialised.
        write_params(mine / "params.npz", training(10), lambda pose: np.where(_late(pose), np.eye(4), pose))
        load(mine)
        assert "tracking failed or stopped early" in caplog.text and "params.npz" in caplog.text

    def test_params_file_may_be_named(self, mine, tmp_path):
        elsewhere = write_params(tmp_path / "experiments" / "x.npz", training(10), drift)
        for name in (str(elsewhere), "../../experiments/x.npz"):
            assert load(mine, params_file=name).provenance["slam"]["frames"] == 9
        with pytest.raises(InputError, match=r"no file .*y.npz.*params_file"):
            load(mine, params_file="y.npz")


def _late(pose: np.ndarray) -> np.ndarray:
    return (np.arange(len(pose)) >= 5)[:, None, None]


class TestImages:
    @pytest.mark.parametrize("bits", [8, 16])
    def test_depth_of_both_kinds(self, tmp_path, bits):
        folder = write_prepared(tmp_path / "wall", 3, bits)
        scene = load(folder, poses="ground-truth", params_file=str(write_params(tmp_path / "p.npz", np.arange(3))))
        frame = scene.train[1]
        points = frame.camera.unproject(frame.depth).reshape(-1, 3).double().numpy()
        distance = off_wall(points)
        assert distance.max() < (0.5 if bits == 8 else 0.002)
        assert scene.provenance["depth_step_mm"] == (100 / 255 if bits == 8 else 100 / 65535)

    def test_eight_bits_know_nothing_at_0_and_only_a_bound_at_255(self, mine):
        write_params(mine / "params.npz", np.arange(10))
        steps = np.full((HEIGHT, WIDTH), 100, np.uint8)
        steps[0], steps[1] = 0, 255
        cv2.imwrite(str(mine / "depth/0000_depth.tiff"), steps)
        frame = load(mine).train[0]
        assert torch.isnan(frame.depth[:2]).all()
        torch.testing.assert_close(frame.depth[2:], torch.full((HEIGHT - 2, WIDTH), 100 / 2.55))
        assert torch.isnan(frame.depth_at_least[0]).all()
        torch.testing.assert_close(frame.depth_at_least[1], torch.full((WIDTH,), 100.0))
        assert PREPARED_DEPTH.z_depth(np.array([[51]], np.uint8))[0, 0] == pytest.approx(20.0)

    def test_without_params_the_cameras_are_the_tables(self, tmp_path):
        pinhole = PREPARED_PINHOLE.resized(60, 48)
        folder = write_prepared(tmp_path / "wall", 9, pinhole=pinhole)
        scene = load(folder, poses="ground-truth")
        assert scene.provenance["intrinsics_from"] == "EndoGSLAM's table"
        assert scene.train[0].camera.fx == pytest.approx(401.1595 * 60 / 675)
        points = scene.points.positions.double().numpy()
        assert len(points) == 8 * 60 * 48 and off_wall(points).max() < 0.5

    def test_intrinsics_of_another_size_are_scaled_where_their_size_is_told(self, mine):
        large = np.array([[122.0, 0.0, 66.5], [0.0, 110.0, 42.5], [0.0, 0.0, 1.0]])
        params = {"intrinsics": large, "org_width": np.array(2 * WIDTH), "org_height": np.array(2 * HEIGHT)}
        write_params(mine / "params.npz", np.arange(10), **params)
        camera = load(mine).train[0].camera
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx((61.0, 55.0, 33.5, 21.5))

    def test_points_come_from_depth_where_the_map_is_empty(self, mine):
        write_params(mine / "params.npz", np.arange(10))
        scene = load(mine)
        assert len(scene.points) == 9 * WIDTH * HEIGHT
        assert scene.provenance["points"]["source"] == "depth of the training frames"

    def test_colours_of_the_map_are_kept_within_bytes(self, mine):
        write_params(mine / "params.npz", np.arange(10), points=np.array([[1.0, 2.0, 3.0]]))
        assert load(mine).points.colors.tolist() == [[128, 51, 255]]

    def test_originals_kept_by_the_script_are_left_alone(self, mine):
        write_params(mine / "params.npz", np.arange(10))
        for kind in ("color_raw", "depth_raw", "normals", "flow", "occlusion"):
            (mine / kind).mkdir()
            (mine / kind / "0000_x.png").write_text("not looked at")
        assert len(in_video_order(load(mine))) == 10


class TestRelease:
    def test_the_latest_iteration_is_taken(self, release, tmp_path):
        folder = Path(shutil.copytree(release, tmp_path / "release"))
        clouds = folder / "C3VD_endogslam_optimized/phantom/point_cloud"
        (clouds / "iteration_7000").mkdir()
        (clouds / "iteration_7000/point_cloud.ply").write_text("not looked at: 7000 < 30000")
        assert "iteration_30000" in load(folder).provenance["points"]["source"]
        (clouds / "iteration_100000").mkdir()
        (clouds / "iteration_100000/point_cloud.ply").write_text("ply")
        with pytest.raises(InputError, match=r"iteration_100000/point_cloud.ply"):
            load(folder)

    def test_a_cloud_without_colours_is_refused(self, release, tmp_path):
        folder = Path(shutil.copytree(release, tmp_path / "release"))
        cloud = folder / "C3VD_endogslam_optimized/phantom/point_cloud/iteration_30000/point_cloud.ply"
        header = "ply\nformat ascii 1.0\nelement vertex 1\n" + "".join(f"property float {axis}\n" for axis in "xyz")
        cloud.write_text(f"{header}end_header\n1 2 3\n")
        with pytest.raises(InputError, match=r"vertices have x, y, z, but no f_dc_0, f_dc_1, f_dc_2"):
            load(folder)

    def test_several_scenes_are_named(self, release, tmp_path):
        folder = Path(shutil.copytree(release, tmp_path / "release"))
        for kind in ("C3VD", "C3VD_endogslam_optimized"):
            shutil.copytree(folder / kind / "phantom", folder / kind / "again")
        with pytest.raises(InputError, match=r"holds several scenes.*C3VD/again"):
            load(folder)


class TestRefused:
    def test_slam_poses_that_are_not_there(self, mine):
        with pytest.raises(
            InputError, match=r"wall has no params.npz.*params_file=FILE, or --set datamanager.poses=ground-truth"
        ):
            load(mine)

    def test_test_frames_without_any_pose(self, mine):
        write_params(mine / "params.npz", training(10))
        (mine / "pose.txt").unlink()
        for source in ("slam", "ground-truth"):
            with pytest.raises(InputError, match=r"Put the sequence's pose.txt of C3VD's release there"):
                load(mine, poses=source)

    def test_images_that_are_not_the_tables(self, mine):
        with pytest.raises(
            InputError, match=r"0000_color.png is 64 x 48, but EndoGSLAM's calibration is for 675 x 540"
        ):
            load(mine, poses="ground-truth")

    def test_rotation_views_without_their_world(self, mine):
        write_params(mine / "params.npz", np.arange(10))
        shutil.copytree(mine / "color", mine / "rotation" / "color")
        with pytest.raises(InputError, match=r"rotation has images, but it has no pose.txt"):
            load(mine)
        (mine / "pose.txt").rename(mine / "rotation/pose.txt")
        with pytest.raises(InputError, match=r"rotation has images, but the scene has no pose.txt"):
            load(mine)
