"""EndoGSLAM's params.npz."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.geometry.poses import endogslam
from coliags_plugin.geometry.poses.trajectory import inverse
from tests.geometry.poses.winding import PINHOLE, winding

FRAMES, GAUSSIANS = 5, 7


def params():
    """Arrays as EndoGSLAM writes them."""
    rng = np.random.default_rng(3)
    return {
        "means3D": rng.normal(size=(GAUSSIANS, 3)),
        "rgb_colors": rng.uniform(size=(GAUSSIANS, 3)),
        "unnorm_rotations": rng.normal(size=(GAUSSIANS, 4)),
        "logit_opacities": rng.normal(size=(GAUSSIANS, 1)),
        "log_scales": rng.normal(size=(GAUSSIANS, 1)),
        "cam_unnorm_rots": rng.normal(size=(1, 4, FRAMES)),
        "cam_trans": rng.normal(size=(1, 3, FRAMES)),
        "timestep": np.zeros(GAUSSIANS),
        "intrinsics": np.array([[400.0, 0, 334.1], [0, 401.0, 273.9], [0, 0, 1]]),
        "w2c": np.eye(4),
        "org_width": np.array(675),
        "org_height": np.array(540),
        "gt_w2c_all_frames": winding(FRAMES).camera_to_world,
        "keyframe_time_indices": np.array([0, 3]),
    }


def saved(path, **changes):
    """Those arrays in a file, with other values or without some keys (None)."""
    np.savez(path, **{key: array for key, array in (params() | changes).items() if array is not None})
    return path


def test_all_of_it_is_read_poses_inverted_and_quaternions_normalised(tmp_path):
    arrays = params()
    read = endogslam.read_params(saved(tmp_path / "params.npz"))
    for frame in range(FRAMES):
        w, x, y, z = arrays["cam_unnorm_rots"][0, :, frame]
        world_to_camera = Rotation.from_quat([x, y, z, w])
        point = np.array([0.3, -0.2, 0.9])
        there = world_to_camera.apply(point) + arrays["cam_trans"][0, :, frame]
        back = read.camera_to_world[frame] @ [*there, 1.0]
        np.testing.assert_allclose(back, [*point, 1.0], atol=1e-12)
    truth = arrays["gt_w2c_all_frames"] @ read.true_camera_to_world
    np.testing.assert_allclose(truth, np.tile(np.eye(4), (FRAMES, 1, 1)), atol=1e-12)
    np.testing.assert_array_equal(read.means, arrays["means3D"])
    np.testing.assert_array_equal(read.rgb_colors, arrays["rgb_colors"])
    # Pixel centres at integers become integers + 0.5.
    assert read.intrinsics == Intrinsics(400.0, 401.0, 334.1 + 0.5, 273.9 + 0.5, 675, 540)
    estimate, truth = (reader(tmp_path / "params.npz") for reader in (endogslam.read, endogslam.read_truth))
    np.testing.assert_array_equal(estimate.camera_to_world, read.camera_to_world)
    np.testing.assert_array_equal(truth.camera_to_world, read.true_camera_to_world)
    assert estimate.intrinsics == read.intrinsics


def test_poses_alone_can_be_read_and_an_unfinished_run_is_remarked_upon(tmp_path):
    only = {key: None for key in params() if key not in ("cam_unnorm_rots", "cam_trans")}
    read = endogslam.read(saved(tmp_path / "params.npz", **only))
    assert len(read) == FRAMES and read.intrinsics is None
    assert read.remarks == ("no intrinsics: the file has no intrinsics, org_width, org_height",)
    quats, translations = params()["cam_unnorm_rots"], params()["cam_trans"]
    quats[0, :, -2:] = np.array([[1.0, 0, 0, 0]]).T
    translations[0, :, -2:] = 0.0
    read = endogslam.read(saved(tmp_path / "params.npz", cam_unnorm_rots=quats, cam_trans=translations))
    assert read.remarks == ("the last 2 poses are the identity: was the run stopped early?",)


def test_one_message_names_every_fault(tmp_path):
    path = saved(
        tmp_path / "params.npz",
        cam_trans=np.zeros((1, 3, 4)),
        means3D=None,
        rgb_colors=np.zeros((GAUSSIANS, 4)),
        intrinsics=np.full((3, 3), np.nan),
        org_width=np.array("wide"),
    )
    with pytest.raises(InputError) as caught:
        endogslam.read_params(path)
    with pytest.raises(InputError, match=r"cannot read .*gone\.npz"):
        endogslam.read_params(tmp_path / "gone.npz")
    for fault in (
        str(path),
        "cam_trans has the shape [1, 3, 4], not [1, 3, 5]",
        "no means3D",
        "rgb_colors has the shape [7, 4], not [N, 3]",
        "intrinsics holds numbers that are not finite",
        "org_width holds <U4, not numbers",
    ):
        assert fault in str(caught.value)
    nothing = {"cam_unnorm_rots": np.ones((1, 4, 0)), "cam_trans": np.ones((1, 3, 0))}
    with pytest.raises(InputError, match="no frames"):
        endogslam.read_params(saved(tmp_path / "params.npz", **nothing, gt_w2c_all_frames=np.ones((0, 4, 4))))


def test_written_files_hold_the_formats_keys_and_the_first_camera_is_the_world(tmp_path):
    trajectory = winding(6, intrinsics=PINHOLE)
    endogslam.write(tmp_path / "params.npz", trajectory)
    with np.load(tmp_path / "params.npz", allow_pickle=False) as archive:
        assert set(archive.files) == set(params())
        assert archive["cam_unnorm_rots"].shape == (1, 4, 6)
        np.testing.assert_allclose(archive["cam_trans"][0, :, 0], 0.0)
        np.testing.assert_allclose(archive["cam_unnorm_rots"][0, :, 0], [1, 0, 0, 0])
        assert archive["intrinsics"][0, 2] == PINHOLE.cx - 0.5
    read = endogslam.read_params(tmp_path / "params.npz")
    relative = inverse(trajectory.camera_to_world[:1]) @ trajectory.camera_to_world
    np.testing.assert_allclose(read.camera_to_world, relative, atol=1e-4)
    np.testing.assert_allclose(read.true_camera_to_world, relative, atol=1e-4)
    assert read.means.shape == (0, 3)


@given(images=st.integers(8, 1200))
@settings(max_examples=30)
def test_images_of_the_poses(images):
    np.testing.assert_array_equal(endogslam.image_indices(images, images), np.arange(images))
    training = [index for index in range(images) if index % 8 != 7]
    np.testing.assert_array_equal(endogslam.image_indices(images - images // 8, images), training)
    assert endogslam.image_indices(images - images // 8 - 1, images) is None
    assert endogslam.image_indices(images + 1, images) is None
