"""Scenes written in TUM's form, and folders of that form without poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from coliags_plugin.core.errors import InputError
from coliags_plugin.datamanagers.recognition import find_format
from coliags_plugin.datamanagers.rgbd.files import lacks_trajectory
from coliags_plugin.datamanagers.rgbd.reader import RGBDDataManager, RGBDSettings, UnposedRGBDDataManager
from coliags_plugin.datamanagers.rgbd.writer import depth_scale, depth_steps, write_rgbd_scene
from coliags_plugin.geometry.poses import tum
from tests.scenes import wall_scene, write_wall

SETTINGS = RGBDSettings(split="all-train", initial_points="none")


def wall(count=4):
    scene = wall_scene(count)
    return sorted([*scene.train, *scene.test_sets["test"]], key=lambda frame: frame.index)


def poses_of(frames):
    return torch.stack([frame.camera.camera_to_world for frame in frames]).numpy()


def test_what_is_written_is_read(tmp_path):
    frames = wall()
    mask = torch.ones(frames[0].image.shape[:2], dtype=torch.bool)
    mask[:3] = False
    depth = frames[1].depth.clone()
    depth[5, 7] = torch.nan
    frames = [replace(frame, mask=mask) for frame in frames]
    frames[1] = replace(frames[1], depth=depth)
    write_rgbd_scene(tmp_path / "scene", frames, poses_of(frames))
    assert find_format(tmp_path / "scene") == "rgbd"
    read = RGBDDataManager(SETTINGS).load(tmp_path / "scene").train
    for written, found in zip(frames, read, strict=True):
        assert torch.equal(found.image, written.image)
        assert torch.equal(found.mask, mask)
        wanted = torch.where(mask, written.depth, torch.nan)
        np.testing.assert_allclose(found.depth, wanted, atol=0.0005, equal_nan=True)
        camera, other = found.camera, written.camera
        np.testing.assert_allclose(camera.camera_to_world, other.camera_to_world, atol=1e-6)
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx((other.fx, other.fy, other.cx, other.cy))


def test_times_stay(tmp_path):
    frames = [replace(frame, name=f"130503110{frame.index}.175304") for frame in wall()]
    trajectory = write_rgbd_scene(tmp_path / "scene", frames, poses_of(frames))
    assert [path.stem for path in sorted((tmp_path / "scene" / "depth").iterdir())] == [frame.name for frame in frames]
    assert tum.read(trajectory).timestamps.tolist() == [float(frame.name) for frame in frames]
    read = RGBDDataManager(SETTINGS).load(tmp_path / "scene").train
    assert [frame.name for frame in read] == [frame.name for frame in frames]
    backwards = [replace(frame, name=f"{9 - frame.index}.5") for frame in frames]
    numbered = write_rgbd_scene(tmp_path / "numbered", backwards, poses_of(frames))
    assert tum.read(numbered).timestamps.tolist() == [0.0, 1.0, 2.0, 3.0]


@given(farthest=st.floats(1e-3, 1e5))
@settings(max_examples=50, deadline=None)
def test_steps_of_depth_reach_and_are_fine(farthest):
    scale = depth_scale(farthest)
    depth = np.array([[farthest, 0.5 * farthest, np.nan, 0.0]])
    steps = depth_steps(depth, scale)
    assert steps[0, 2:].tolist() == [0, 0]
    np.testing.assert_allclose(steps[0, :2] / scale, depth[0, :2], atol=0.5001 / scale)
    assert 1.0 / scale <= farthest / 65_535 * 2.5 * 1.000001
    assert depth_scale(100.0) == 500.0  # 0.002 mm for all of C3VD


def test_a_folder_without_poses(tmp_path):
    frames = wall()
    folder = tmp_path / "scene"
    trajectory = write_rgbd_scene(folder, frames, poses_of(frames))
    assert not lacks_trajectory(folder)
    trajectory.unlink()
    assert lacks_trajectory(folder)
    scene = UnposedRGBDDataManager(SETTINGS).load(folder)
    assert [frame.name for frame in scene.train] == ["0000", "0001", "0002", "0003"]
    assert all(torch.equal(frame.camera.camera_to_world.double(), torch.eye(4).double()) for frame in scene.train)
    assert scene.provenance["pose_convention"] is None
    with pytest.raises(InputError, match=r"Add it, or estimate one from depth by coliags poses track"):
        RGBDDataManager(SETTINGS).load(folder)
    for name in ("rgb", "depth"):
        for path in (folder / name).iterdir():
            path.rename(path.with_name(f"{10 + int(path.stem) / 30:.6f}.png"))
    (folder / "depth" / "10.033333.png").unlink()
    assert len(UnposedRGBDDataManager(SETTINGS).load(folder).train) == 3


def test_other_folders_do_not_lack_a_trajectory_of_this_form(tmp_path):
    assert not lacks_trajectory(tmp_path)
    assert not lacks_trajectory(tmp_path / "nothing")
    assert find_format(write_wall(tmp_path / "wall")) == "c3vd"


def test_masks_belong_to_images(tmp_path):
    frames = [replace(frame, mask=torch.ones(frame.image.shape[:2], dtype=torch.bool)) for frame in wall()]
    write_rgbd_scene(tmp_path / "scene", frames, poses_of(frames))
    (tmp_path / "scene" / "mask" / "0002.png").unlink()
    with pytest.raises(InputError, match=r"mask has no mask for 0002\.png"):
        RGBDDataManager(SETTINGS).load(tmp_path / "scene")


def test_what_is_refused(tmp_path):
    frames = wall()
    poses = poses_of(frames)
    with pytest.raises(InputError, match="4 frames and 3 poses"):
        write_rgbd_scene(tmp_path / "scene", frames, poses[:3])
    with pytest.raises(InputError, match="frame 0001 has no depth"):
        write_rgbd_scene(tmp_path / "scene", [frames[0], replace(frames[1], depth=None)], poses[:2])
    other = replace(frames[1], camera=replace(frames[1].camera, fx=3.0))
    with pytest.raises(InputError, match="frame 0001 has another camera"):
        write_rgbd_scene(tmp_path / "scene", [frames[0], other], poses[:2])
    assert list(tmp_path.iterdir()) == []
