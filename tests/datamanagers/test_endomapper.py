"""The endomapper data manager: the phantom's layout against OpenCV's fisheye, and which folders are its."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from coliags_plugin.datamanagers.endomapper.reader import EndoMapperDataManager
from coliags_plugin.datamanagers.recognition import find_format, recognised
from coliags_plugin.geometry.lenses.vicalib import read_calibration
from tests.datamanagers.spoiling import edit
from tests.layouts.endomapper import EndoMapperLayout
from tests.phantom.phantom_layouts import in_video_order, read, true_poses, write_phantom

WIDTH, HEIGHT = 96, 72


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("phantoms") / "endomapper"
    return write_phantom(folder, "endomapper", WIDTH, HEIGHT, mesh_spacing=3.0, texture_spacing=1.0)


@pytest.fixture
def mine(folder, tmp_path):
    return Path(shutil.copytree(folder, tmp_path / "scene"))


def load(folder: Path, **options):
    return EndoMapperDataManager(EndoMapperDataManager.Settings(**options)).load(folder)


def stored_pixels(camera, folder: Path) -> np.ndarray:
    """Column and row of the stored pixel behind every working pixel, by OpenCV's fisheye. [H, W, 2]"""
    lens, k = read_calibration(folder / "calibration.xml").lens, camera.intrinsics
    column, row = np.meshgrid(np.arange(k.width) + 0.5, np.arange(k.height) + 0.5)
    rays = np.stack([(column - k.cx) / k.fx, (row - k.cy) / k.fy, np.ones_like(column)], axis=-1)
    matrix = np.array([[lens.fx, 0.0, lens.cx], [0.0, lens.fy, lens.cy], [0.0, 0.0, 1.0]])
    terms = np.array([lens.k1, lens.k2, lens.k3, lens.k4])
    pixels, _ = cv2.fisheye.projectPoints(rays.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), matrix, terms)
    return np.floor(pixels).astype(int).reshape(*column.shape, 2)


def test_what_is_written_is_read_to_the_bit(folder):
    scene = read(folder, "endomapper")
    frames = in_video_order(scene)
    lens, _ = EndoMapperLayout().lens(WIDTH, HEIGHT)
    calibration = read_calibration(folder / "calibration.xml")
    points = np.random.default_rng(0).uniform((-0.8, -0.6, 1.0), (0.8, 0.6, 1.0), (50, 3))
    np.testing.assert_allclose(calibration.lens.project(points), lens.project(points), atol=1e-12)
    found = np.array([frame.camera.camera_to_world.numpy() for frame in frames])
    np.testing.assert_allclose(found, true_poses(folder), atol=1e-5)
    pixels = stored_pixels(frames[0].camera, folder)
    for frame in frames[::4]:
        steps = cv2.imread(str(folder / f"depth/{frame.name}.png"), cv2.IMREAD_UNCHANGED)
        assert steps.dtype == np.uint16
        expected = (steps[pixels[..., 1], pixels[..., 0]] / calibration.depth_scale).astype(np.float32)
        expected[expected == 0.0] = np.nan
        np.testing.assert_array_equal(frame.depth, expected)
        assert np.isfinite(expected).mean() > 0.9
    assert scene.provenance["lens"] == "FisheyeLens"
    assert scene.provenance["intrinsics_from"] == "calibration.xml"
    assert scene.provenance["unit"] == "mm"


def test_more_of_the_field_of_view_is_kept_without_its_dark_surroundings(folder):
    frame = load(folder, focal_scale=0.25).train[0]
    lit = cv2.imread(str(folder / f"mask/{frame.name}.png"), cv2.IMREAD_UNCHANGED) > 0
    assert 0.5 < lit.mean() < 1.0
    pixels = stored_pixels(frame.camera, folder)
    inside = ((pixels >= 0) & (pixels < (WIDTH, HEIGHT))).all(axis=-1)
    seen = np.zeros(inside.shape, bool)
    seen[inside] = lit[pixels[inside, 1], pixels[inside, 0]]
    assert 0.2 < seen.mean() < 0.95
    # Colour is averaged over an area, so that pixels at the rim are left out.
    mask = frame.mask.numpy()
    assert not (mask & ~seen).any() and mask.sum() > 0.97 * seen.sum()
    assert (frame.image.numpy()[mask].max(axis=1) > 0).all()
    np.testing.assert_array_equal(np.isfinite(frame.depth.numpy()), mask)


def test_another_camera_file_makes_it_an_rgbd_folder(mine):
    assert recognised(mine) == {"endomapper": "the TUM trajectory trajectory.txt beside rgb/"}
    (mine / "intrinsics.txt").write_text("48 48 47.5 35.5")
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
