"""Phantoms of every layout, read back: poses, depth, images and points against the phantom's truth."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
import torch

from coliags_plugin.config.registry import phantom_layouts
from tests.datamanagers.spoiling import FRAMES, KINDS
from tests.phantom.phantom_layouts import depth_gap, distance_from_wall, in_video_order, read, true_poses

#: Quantile of the distances of depth from the wall, and its limit, mm: steps of the stored depth and, where images are
#: undistorted, up to half a stored pixel beside the ray.
OFF_WALL = {
    "c3vd": (1.0, 0.003),
    "c3vd-raw": (0.5, 0.3),
    "c3vd-raw-old": (0.5, 0.3),
    "c3vd-v2": (0.5, 0.3),
    # A step is 0.39 mm of z-depth, and rays lean to 45 degrees from the axis.
    "c3vd-endogslam": (0.9, 0.6),
    "pr-endo": (0.9, 0.6),
    "rotatecolon": (1.0, 0.001),
    "nerfstudio": (0.5, 0.3),
    # Half a step of 0.002 mm along the longest ray.
    "rgbd": (1.0, 0.002),
    "rgbd-by-order": (1.0, 0.002),
    "reim-nerf": (0.5, 0.3),
    # Pixels of a wider lens.
    "endomapper": (0.5, 0.35),
}
UNDISTORTED = ("c3vd-raw", "c3vd-raw-old", "c3vd-v2", "nerfstudio", "reim-nerf", "endomapper")


def test_every_layout_is_read_back():
    assert {kind.layout for kind in KINDS.values()} == set(phantom_layouts)


@pytest.mark.parametrize("name", KINDS)
def test_poses_depth_images_and_points(phantoms, name):
    folder, kind = phantoms[name], KINDS[name]
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    scene = read(folder / kind.scene, kind.format)
    # RotateColon's test frames are not of the video.
    frames = scene.train if name == "rotatecolon" else in_video_order(scene)
    true = true_poses(folder)
    assert [frame.index for frame in frames] == list(range(FRAMES))
    poses = np.array([frame.camera.camera_to_world.double().numpy() for frame in frames])
    # EndoGSLAM's world is that of the first camera.
    world = true[0] if kind.params else np.eye(4)
    np.testing.assert_allclose(world @ poses, true, atol=1e-4)
    assert json.loads(json.dumps(scene.provenance, allow_nan=False))["dataset"] == kind.format
    # Nothing is written into the data.
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before

    def off_wall(points: torch.Tensor) -> np.ndarray:
        points = points[torch.isfinite(points).all(dim=1)].double().numpy()
        return distance_from_wall(folder, torch.from_numpy(points @ world[:3, :3].T + world[:3, 3]))

    if name in OFF_WALL:
        share, distance = OFF_WALL[name]
        turned = [] if name == "rotatecolon" else scene.test_sets.get("rotation", [])
        for frame in (*frames[::4], *turned):
            assert np.quantile(off_wall(frame.camera.unproject(frame.depth).reshape(-1, 3)), share) < distance
        gap, overlap = depth_gap(*frames[4:6])
        assert gap < 0.7 and overlap > 0.3
    else:
        assert all(frame.depth is None for frame in frames)
    # Initial points are of the data, or fused from depth.
    assert np.median(off_wall(scene.points.positions)) < 0.3
    if name not in UNDISTORTED:
        stored = cv2.imread(str(frames[5].shot.image))[..., ::-1]
        np.testing.assert_array_equal(frames[5].image, stored)
