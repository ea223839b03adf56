"""Cameras that structure from motion starts with."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest
from pydantic import ValidationError

from coliags_plugin.core.errors import InputError
from coliags_plugin.geometry.lenses.models import LENSES
from coliags_plugin.reconstruction.structure.sfm_settings import (
    CALIBRATED,
    CameraSettings,
    Picture,
    Start,
    calibrated_camera,
    distortion,
    field_of_view,
    is_refined,
    starting_cameras,
    starts,
)
from tests.reconstruction.seen_points import seen_points
from tests.textured_tube import HEIGHT, WIDTH


def test_c3vd_at_full_size_is_the_official_calibration():
    model, params = calibrated_camera("c3vd", 1350, 1080)
    assert model == "OPENCV_FISHEYE"
    # REIM-NeRF's c3vd_calib.json, whose pixel centres are at integers.
    expected = (767.3861511125845, 767.5058656118406, 679.554265997005, 544.146891684636)
    assert params[:4] == pytest.approx(expected, rel=1e-14)
    assert params[4:] == (-0.18867185058223412, -0.003927337093919806, 0.030524814153620117, -0.012756926010904904)


def test_undistorted_images_are_those_of_the_legacy_pinhole():
    model, params = calibrated_camera("c3vd-undistorted", 675, 540)
    assert model == "PINHOLE"
    assert params == pytest.approx((401.1595, 400.9425, 0.5 * (668.286 + 0.5), 0.5 * (547.733 + 0.5)))


@pytest.mark.parametrize("name", CALIBRATED)
@pytest.mark.parametrize("size", [(1350, 1080), (675, 540), (338, 270)])
def test_colmaps_camera_projects_as_the_lens(name, size):
    (camera,) = starting_cameras(CameraSettings(model=name), [], [size], Start(name, 1.0))
    points = np.random.default_rng(0).uniform((-0.8, -0.6, 1.0), (0.8, 0.6, 1.0), (50, 3))
    lens = LENSES[CALIBRATED[name]].resized(*size)
    k = lens.pinhole
    pinhole = points[:, :2] * (k.fx, k.fy) + (k.cx, k.cy)
    expected = lens.project(points) if camera.model_name == "OPENCV_FISHEYE" else pinhole
    np.testing.assert_allclose(camera.img_from_cam(points), expected, atol=1e-6)


@pytest.mark.parametrize(
    ("options", "refined", "count"),
    [
        ({"model": "c3vd"}, False, 1),
        ({"model": "c3vd", "refine": True}, True, 1),
        ({}, True, 3),
        ({"refine": False}, False, 3),
        ({"model": "PINHOLE"}, True, 2),
        ({"model": "PINHOLE", "params": (1.0,)}, False, 1),
        ({"model": "PINHOLE", "params": (1.0,), "refine": True}, True, 1),
    ],
)
def test_known_cameras_have_one_start_and_are_kept(options, refined, count):
    settings = CameraSettings(focal_factors=(0.6, 0.4), **options)
    assert is_refined(settings) == refined and len(starts(settings)) == count
    if not options:
        fisheye = "SIMPLE_RADIAL_FISHEYE"
        assert starts(settings) == [Start(fisheye, 0.6), Start(fisheye, 0.4), Start("SIMPLE_RADIAL", 0.6)]


def test_crops_are_refused():
    with pytest.raises(InputError, match=r"--camera c3vd, and images of 800 x 800. Expected the whole frame"):
        calibrated_camera("c3vd", 800, 800)


@pytest.mark.parametrize("size", [(200, 120), (120, 200)])
@pytest.mark.parametrize(("model", "degrees"), [("PINHOLE", 90.0), ("SIMPLE_FISHEYE", np.degrees(2.0))])
def test_field_of_view_has_a_closed_form(model, degrees, size):
    """It is the angle between the rays that COLMAP projects to the ends of the larger side."""
    camera = pycolmap.Camera.create_from_model_name(0, model, 100.0, *size)
    assert field_of_view(camera) == pytest.approx(degrees)
    half = np.radians(0.5 * field_of_view(camera))
    ray = np.array([[np.sin(half), 0.0, np.cos(half)]])
    assert camera.img_from_cam(ray)[0, 0] == pytest.approx(0.5 * size[0] + 100.0)
    assert distortion(camera) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("size", [(200, 120), (120, 200)])
@pytest.mark.parametrize(("model", "term"), [("SIMPLE_RADIAL", -0.25), ("SIMPLE_RADIAL_FISHEYE", 0.5)])
def test_distortion_is_that_of_the_border(size, model, term):
    camera = pycolmap.Camera.create_from_model_name(0, model, 125.0, *size)
    camera.params = [125.0, 95.0, 63.0, term]
    assert distortion(camera) == pytest.approx(abs(term) * 0.8**2)


@pytest.mark.parametrize(
    "wrong", [{"focal_factors": (0.5, 0.0)}, {"field_of_view": (90, 40)}, {"focal_factors": ()}, {"params": (1.0,)}]
)
def test_ranges_that_are_none_are_refused(wrong):
    with pytest.raises(ValidationError):
        CameraSettings(**wrong)


# Pictures within black surroundings


def test_the_lens_fills_what_is_neither_masked_nor_black():
    image = np.zeros((60, 100, 3), np.uint8)
    image[10:50, 30:90] = 120
    image[3, :20] = 255  # text beside the picture
    mask = image.max(axis=2) == 120
    mask[44:50] = False  # text on the picture
    assert Picture.in_mask(mask, image) == Picture((30, 10), (60, 40), (100, 60))
    everything = np.ones((60, 100), bool)
    assert Picture.in_mask(everything, image) is None
    everything[:20, :20] = False  # corners do not matter
    assert Picture.in_mask(everything, image) is None


def test_models_of_a_picture_become_those_of_whole_images():
    model, _ = seen_points()
    picture = Picture((30, 10), (WIDTH, HEIGHT), (WIDTH + 50, HEIGHT + 20))
    before = {number: np.array([point.xy for point in image.points2D]) for number, image in model.images.items()}
    picture.to_frame(model)
    (camera,) = model.cameras.values()
    assert (camera.width, camera.height) == picture.frame
    model.update_point_3d_errors()
    assert model.compute_mean_reprojection_error() == pytest.approx(0.0, abs=1e-9)
    for number, image in model.images.items():
        np.testing.assert_allclose([point.xy for point in image.points2D], np.add(before[number], (30, 10)))
