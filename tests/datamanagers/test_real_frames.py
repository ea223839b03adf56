"""Real frames through the whole chain: undistort, write, read, and see the ground-truth points where they should be."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from coliags_plugin.core.images import read_rgb
from coliags_plugin.datamanagers.c3vd.reader import C3VDDataManager, C3VDSettings
from coliags_plugin.geometry.lenses.models import LENSES
from tests.datamanagers.real_frames import real_lens, undistort_real_frames


def test_the_crops_lens_is_the_fisheye_cropped(shared_data):
    pixels = [[0, 0], [400, 100], [799, 799]]
    cropped = LENSES["fisheye"].cropped(275, 140, 800, 800)
    np.testing.assert_allclose(real_lens(shared_data).unproject(pixels), cropped.unproject(pixels), atol=1e-12)


@pytest.fixture
def scene(shared_data, tmp_path):
    folder = undistort_real_frames(shared_data, tmp_path / "cecum", 200, 200, 120)
    return C3VDDataManager(C3VDSettings(width=200, height=200)).load(folder)


def test_three_real_frames_become_a_scene(scene):
    assert [frame.name for frame in scene.test_sets["test"]] == ["0000_color"]
    assert [frame.name for frame in scene.train] == ["0001_color", "0002_color"]
    assert len(scene.points) == 2 * 8192
    assert scene.provenance["pose_convention"]["order"] == "column-major"
    frame = scene.train[0]
    assert frame.depth is None
    assert frame.mask is None
    assert 20 < frame.image.float().mean() < 200
    camera = frame.camera
    # The crop sees 31.7 degrees to each side and its centre is not the image's.
    assert camera.width / (2 * camera.fx) == pytest.approx(np.tan(np.radians(31.7)), abs=0.001)
    assert camera.cx == pytest.approx(101.6, abs=0.01)


def test_ground_truth_points_project_where_the_lens_and_the_undistortion_put_them(scene, shared_data):
    data = np.load(shared_data / "c3vd_sparse_depth" / "cecum_t1_a_0000.npz")
    camera = scene.test_sets["test"][0].camera.to(dtype=torch.float64)
    pixels, depth = camera.project(torch.from_numpy(data["points_world_mm"]).double())
    np.testing.assert_allclose(depth, data["depth_mm"], atol=2e-4)
    inside = ((pixels > 3) & (pixels < 197)).all(dim=1).numpy()
    assert inside.sum() > 2000
    # Colours of the undistorted image there, against those of the distorted one where the points were seen.
    crop = read_rgb(shared_data / "c3vd_cecum_t1_a" / "0000_color_crop800.jpg")
    source = (data["uv_raw1350x1080"][inside] - (275, 140)).astype(np.float32)
    smooth = cv2.blur(crop, (3, 3))
    expected = cv2.remap(smooth, source[None, :, 0], source[None, :, 1], cv2.INTER_LINEAR)[0].astype(float)
    target = (pixels[inside].numpy() - 0.5).astype(np.float32)
    image = scene.test_sets["test"][0].image.numpy()

    def difference(shift):
        found = cv2.remap(image, target[None, :, 0] + shift, target[None, :, 1], cv2.INTER_LINEAR)[0]
        return np.abs(found.astype(float) - expected).mean()

    assert difference(0.0) < 1.5
    # A quarter of a pixel shows, to either side.
    assert difference(0.0) < 0.9 * min(difference(0.25), difference(-0.25))
