"""Particular to EndoMapper: its calibration, against OpenCV's fisheye, and which folders are its."""

from __future__ import annotations

from functools import partial

import cv2
import numpy as np
import torch

from coliags_plugin.engine.data_formats import find_format, recognised
from coliags_plugin.geometry.lenses.vicalib import read_calibration
from tests.datamanagers.kinds import edit
from tests.datamanagers.wall_scenes import HEIGHT, WIDTH, layout_of, load_scene

KIND = "endomapper"
load = partial(load_scene, "endomapper")


def stored_pixels(camera, folder) -> np.ndarray:
    """Column and row of the stored pixel behind every working pixel, by OpenCV's fisheye. [H, W, 2]"""
    lens, k = read_calibration(folder / "calibration.xml").lens, camera.intrinsics
    column, row = np.meshgrid(np.arange(k.width) + 0.5, np.arange(k.height) + 0.5)
    rays = np.stack([(column - k.cx) / k.fx, (row - k.cy) / k.fy, np.ones_like(column)], axis=-1)
    matrix = np.array([[lens.fx, 0.0, lens.cx], [0.0, lens.fy, lens.cy], [0.0, 0.0, 1.0]])
    terms = np.array([lens.k1, lens.k2, lens.k3, lens.k4])
    pixels, _ = cv2.fisheye.projectPoints(rays.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), matrix, terms)
    return np.floor(pixels).astype(int).reshape(*column.shape, 2)


def test_depth_is_read_to_the_bit(walls):
    folder = walls("endomapper")
    scene = load(folder)
    calibration, written = read_calibration(folder / "calibration.xml"), layout_of("endomapper").lens(WIDTH, HEIGHT)[0]
    points = np.random.default_rng(0).uniform((-0.8, -0.6, 1.0), (0.8, 0.6, 1.0), (50, 3))
    np.testing.assert_allclose(calibration.lens.project(points), written.project(points), atol=1e-12)
    pixels = stored_pixels(scene.train[0].camera, folder)
    for frame in scene.video[::4]:
        steps = cv2.imread(str(folder / f"depth/{frame.name}.png"), cv2.IMREAD_UNCHANGED)
        expected = (steps[pixels[..., 1], pixels[..., 0]] / calibration.depth_scale).astype(np.float32)
        np.testing.assert_array_equal(frame.depth, np.where(expected == 0.0, np.nan, expected))
    assert scene.provenance.lens == "FisheyeLens"
    assert scene.provenance.intrinsics_from == "calibration.xml"


def test_another_camera_file_makes_it_an_rgbd_folder(mine):
    assert recognised(mine) == {"endomapper": "the TUM trajectory trajectory.txt beside rgb/"}
    (mine / "intrinsics.txt").write_text("20 20 19.5 15.5")
    assert list(recognised(mine)) == ["rgbd"]
    (mine / "calibration.xml").unlink()
    (mine / "intrinsics.txt").unlink()
    assert find_format(mine) == "rgbd"


def test_the_scale_of_depth_is_that_of_the_file_or_the_option(mine):
    before = load(mine).train[0].depth
    edit("calibration.xml", "500.0", "250.0")(mine)
    torch.testing.assert_close(load(mine).train[0].depth, 2.0 * before, equal_nan=True)
    edit("calibration.xml", "<depth_scale.*", "")(mine)
    torch.testing.assert_close(load(mine, depth_scale=250.0).train[0].depth, 2.0 * before, equal_nan=True)
    assert load(mine, depth="none", initial_points="none").train[0].depth is None
