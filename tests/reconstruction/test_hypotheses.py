"""Cameras that structure from motion starts with, choice among models by the lamp, and reversal of depth."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.geometry.lenses.models import LENSES
from coliags_plugin.geometry.poses.colmap import posed_model
from coliags_plugin.phantom.layouts import SeenPoints, add_points
from coliags_plugin.reconstruction.structure.hypotheses import (
    Hypothesis,
    choose,
    fitting_focal_lengths,
    reversed_in_depth,
)
from coliags_plugin.reconstruction.structure.mapping import brightness_at, brightness_correlation, depths_of
from coliags_plugin.reconstruction.structure.sfm_settings import (
    CALIBRATED,
    CameraSettings,
    Picture,
    Start,
    candidate_cameras,
    distortion,
    field_of_view,
    is_refined,
    starting_cameras,
)
from tests.reconstruction.seen_points import seen_points
from tests.textured_tube import HEIGHT, WIDTH

RANGE = (40.0, 150.0)
#: Of a camera so far away that its images are nearly affine.
NARROW = (3.0, 150.0)
SIDE, FOCAL = 200, 2000.0
COUNT, POINTS = 8, 120
BRIGHTNESS = 1e8


def turntable(noise=0.3):
    """A shallow, distant surface that turns in front of the camera, and its exact depths: nearly affine images."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-30, 30, (POINTS, 2)), rng.uniform(-8, 8, POINTS)])
    poses, seen, depths = [], [], []
    for index in range(COUNT):
        rotation = Rotation.from_euler("yx", [2.0 * (index - COUNT / 2), 1.5 * np.sin(index)], degrees=True).as_matrix()
        poses.append(pycolmap.Rigid3d(np.column_stack([rotation, (0.0, 0.0, 1000.0)])))
        local = points @ rotation.T + (0.0, 0.0, 1000.0)
        pixels = FOCAL * local[:, :2] / local[:, 2:] + SIDE / 2 + rng.normal(0.0, noise, (POINTS, 2))
        seen.append(SeenPoints(pixels, np.arange(POINTS)))
        depths.append(local[:, 2])
    camera = Intrinsics(FOCAL, FOCAL, SIDE / 2, SIDE / 2, SIDE, SIDE)
    model = posed_model(poses, [f"{index}.png" for index in range(COUNT)], [camera], [0] * COUNT)
    add_points(model, seen, points, np.zeros((POINTS, 3), np.uint8))
    return model, np.array(depths)


def test_the_lamp_chooses_between_a_model_and_its_reversal():
    """Light falls off with the squared distance; the gain of each image is arbitrary."""
    model, depths = turntable()
    other = reversed_in_depth(model, refine_camera=False)
    # A shallow surface reversed in depth fits nearly as well; the model that was given stays as it was.
    features, z = depths_of(other)[COUNT // 2 + 1]
    assert np.corrcoef(z, depths[COUNT // 2][features])[0, 1] < -0.9
    assert model.compute_num_observations() == COUNT * POINTS
    assert other.compute_num_observations() > 0.95 * COUNT * POINTS
    assert other.compute_mean_reprojection_error() < 1.0
    gain = np.linspace(0.5, 2.0, COUNT)[:, None]
    brightness = list(gain * BRIGHTNESS / depths**2)
    pair = [Hypothesis.of(model, brightness), Hypothesis.of(other, brightness, is_reversed=True)]
    assert choose(pair, NARROW) is choose(pair[::-1], NARROW) is pair[0]
    assert pair[0].correlation == pytest.approx(-1.0, abs=0.02) and pair[1].correlation > 0.8
    # Under a light that grows with the distance, the reversed model is taken, whatever the errors.
    inverse = list(gain * depths**2 / 1e4)
    pair = [Hypothesis.of(model, inverse), Hypothesis.of(other, inverse, is_reversed=True)]
    assert choose(pair, NARROW).is_reversed


def hypothesis(
    correlation=-0.7, focal=200.0, radial=0.0, lens="SIMPLE_RADIAL", images=20, observations=1000, error=0.5
):
    """A hypothesis by the numbers that the choice uses."""
    camera = pycolmap.Camera.create_from_model_name(1, lens, focal, 320, 240)
    camera.params = [focal, 160.0, 120.0, radial]
    return Hypothesis(None, images, observations, error, camera, [field_of_view(camera)], correlation)


def test_plausible_then_complete_then_lit_then_exact():
    best = hypothesis(error=0.6)
    others = [
        hypothesis(-0.9, focal=1967.0, observations=2000, error=0.1),
        hypothesis(-0.9, images=15, error=0.1),
        hypothesis(-0.9, observations=500, error=0.1),
        hypothesis(0.2, error=0.1),
        hypothesis(None, error=0.1),
        hypothesis(-0.9, error=0.7),
    ]
    assert choose([*others, best], RANGE) is best
    # Where errors hardly differ, the first of the same camera model, whatever its distortion.
    distorted = hypothesis(radial=-0.2, error=0.61)
    assert choose([best, hypothesis(focal=150.0, error=0.59)], RANGE) is best
    assert choose([distorted, best], RANGE) is distorted
    with pytest.raises(InputError, match=r"1967 px \(9 degrees\).*nominal field of view of 40 to 150 degrees"):
        choose(others[:1], RANGE)


def test_the_least_distorted_of_camera_models_that_fit_as_well():
    """To third order, a fisheye with k and a pinhole with k - 1/3 are the same lens; their order does not matter."""

    def taken(third, error=0.5):
        fisheye = hypothesis(radial=third, lens="SIMPLE_RADIAL_FISHEYE", error=error)
        pinhole = hypothesis(radial=third - 1 / 3, error=0.51)
        (model,) = {choose(pair, RANGE).camera.model_name for pair in ([fisheye, pinhole], [pinhole, fisheye])}
        return model

    assert taken(0.0) == taken(-0.1) == taken(0.1) == "SIMPLE_RADIAL_FISHEYE"
    assert taken(1 / 3) == taken(0.3) == "SIMPLE_RADIAL"
    # Errors that differ decide.
    assert taken(0.0, error=0.6) == "SIMPLE_RADIAL"


def test_focal_lengths_that_fit_as_well():
    chosen = hypothesis()
    assert set(fitting_focal_lengths([chosen], chosen, RANGE)) == {200.0}
    for rival, fits in (
        (hypothesis(-0.5, focal=260.0, error=0.51), True),
        (hypothesis(-0.5, focal=260.0, error=0.7), False),
        (hypothesis(0.5, focal=260.0, error=0.51), False),
        (hypothesis(focal=260.0, error=0.51, lens="SIMPLE_RADIAL_FISHEYE"), True),
    ):
        lengths = fitting_focal_lengths([chosen, rival], chosen, RANGE)
        assert set(lengths) == {200.0, *([260.0] if fits else [])}


def test_correlation_of_exact_falloff_and_of_too_few_points():
    model, depths = turntable(noise=0.0)
    brightness = list(BRIGHTNESS / depths**2 - 1.0)
    assert brightness_correlation(model, brightness) == pytest.approx(-1.0, abs=1e-9)
    assert brightness_correlation(model, [np.full(POINTS, 50.0)] * COUNT) is None
    assert brightness_correlation(pycolmap.Reconstruction(), []) is None


def test_brightness_is_the_mean_around_a_pixel():
    image = np.zeros((20, 30, 3), np.uint8)
    image[5:12, 10:17] = 70
    brightness = brightness_at(image, np.array([(13.5, 8.5), (25.0, 18.0), (29.9, 19.9)]))
    np.testing.assert_allclose(brightness, [70.0, 0.0, 0.0])


@pytest.mark.parametrize("name", CALIBRATED)
@pytest.mark.parametrize("size", [(1350, 1080), (338, 270)])
def test_colmaps_camera_projects_as_the_lens(name, size):
    (camera,) = starting_cameras(CameraSettings(model=name), [], [size], Start(name, 1.0))
    points = np.random.default_rng(0).uniform((-0.8, -0.6, 1.0), (0.8, 0.6, 1.0), (50, 3))
    lens = LENSES[CALIBRATED[name]].resized(*size)
    k = lens.pinhole
    pinhole = points[:, :2] * (k.fx, k.fy) + (k.cx, k.cy)
    expected = lens.project(points) if camera.model_name == "OPENCV_FISHEYE" else pinhole
    np.testing.assert_allclose(camera.img_from_cam(points), expected, atol=1e-6)
    with pytest.raises(InputError, match=rf"`camera={name}`, and images of 800 x 800. Expected the whole frame"):
        starting_cameras(CameraSettings(model=name), [], [(800, 800)], Start(name, 1.0))


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
    lenses, factors = candidate_cameras(settings, tracked=False)
    assert is_refined(settings) == refined and len(lenses) + len(factors) - 1 == count
    if not options:
        assert lenses == [Start("SIMPLE_RADIAL_FISHEYE", 0.6), Start("SIMPLE_RADIAL", 0.6)] and factors == [0.6, 0.4]
        lenses, factors = candidate_cameras(settings, tracked=True)
        assert [lens.radial for lens in lenses] == [0.333, 0.0, 0.167] and len(factors) == 6


@pytest.mark.parametrize("size", [(200, 120), (120, 200)])
@pytest.mark.parametrize(
    ("model", "degrees"), [("PINHOLE", 90.0), ("SIMPLE_FISHEYE", np.degrees(2.0)), ("SIMPLE_RADIAL", 90.0)]
)
def test_field_of_view_and_distortion_at_the_border_have_closed_forms(model, degrees, size):
    camera = pycolmap.Camera.create_from_model_name(0, model, 100.0, *size)
    term = -0.25 if model == "SIMPLE_RADIAL" else 0.0
    if term:
        camera.params = [*camera.params[:-1], term]
    assert field_of_view(camera) == pytest.approx(degrees)
    assert distortion(camera) == pytest.approx(abs(term), abs=1e-12)


def test_ranges_that_are_none_are_refused():
    for wrong in (
        {"focal_factors": (0.5, 0.0)},
        {"field_of_view": (90, 40)},
        {"focal_factors": ()},
        {"params": (1.0,)},
    ):
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
