"""Parts of structure from motion: cameras, choice among models by the lamp, pairs, features and points followed."""

from __future__ import annotations

import itertools
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import highlights
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.geometry.lenses.models import LENSES
from coliags_plugin.geometry.poses.colmap import posed_model
from coliags_plugin.phantom.layouts import SeenPoints, add_points
from coliags_plugin.reconstruction.structure.features import (
    Features,
    alike_pairs,
    epipolar_inliers,
    mutual_matches,
    usable,
)
from coliags_plugin.reconstruction.structure.hypotheses import (
    Hypothesis,
    choose,
    fitting_focal_lengths,
    reversed_in_depth,
)
from coliags_plugin.reconstruction.structure.mapping import brightness_at, brightness_correlation, depths_of
from coliags_plugin.reconstruction.structure.point_tracks import (
    fineness,
    shared_tracks,
    track_between,
    track_points,
    wall_textures,
)
from coliags_plugin.reconstruction.structure.sfm_settings import (
    CALIBRATED,
    CameraSettings,
    FeatureSettings,
    Picture,
    SfmSettings,
    Start,
    TrackSettings,
    candidate_cameras,
    distortion,
    field_of_view,
    is_refined,
    starting_cameras,
)
from coliags_plugin.reconstruction.structure.video import MatchedVideo, cut_where_lost
from coliags_plugin.reporting.image_files import write_png
from tests.reconstruction.seen_points import seen_points
from tests.textured_tube import HEIGHT, INTRINSICS, WIDTH, texture, tube_frames

RANGE = (40.0, 150.0)
#: Of a camera so far away that its images are nearly affine.
NARROW = (3.0, 150.0)
SIDE, FOCAL = 200, 2000.0
VIEWS, POINTS = 8, 120
BRIGHTNESS = 1e8


def turntable(noise=0.3):
    """A shallow, distant surface that turns in front of the camera, and its exact depths: nearly affine images."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-30, 30, (POINTS, 2)), rng.uniform(-8, 8, POINTS)])
    poses, seen, depths = [], [], []
    for index in range(VIEWS):
        rotation = Rotation.from_euler("yx", [2.0 * (index - VIEWS / 2), 1.5 * np.sin(index)], degrees=True).as_matrix()
        poses.append(pycolmap.Rigid3d(np.column_stack([rotation, (0.0, 0.0, 1000.0)])))
        local = points @ rotation.T + (0.0, 0.0, 1000.0)
        pixels = FOCAL * local[:, :2] / local[:, 2:] + SIDE / 2 + rng.normal(0.0, noise, (POINTS, 2))
        seen.append(SeenPoints(pixels, np.arange(POINTS)))
        depths.append(local[:, 2])
    camera = Intrinsics(FOCAL, FOCAL, SIDE / 2, SIDE / 2, SIDE, SIDE)
    model = posed_model(poses, [f"{index}.png" for index in range(VIEWS)], [camera], [0] * VIEWS)
    add_points(model, seen, points, np.zeros((POINTS, 3), np.uint8))
    return model, np.array(depths)


def test_the_lamp_chooses_between_a_model_and_its_reversal():
    """Light falls off with the squared distance; the gain of each image is arbitrary."""
    model, depths = turntable()
    other = reversed_in_depth(model, refine_camera=False)
    # A shallow surface reversed in depth fits nearly as well; the model that was given stays as it was.
    features, z = depths_of(other)[VIEWS // 2 + 1]
    assert np.corrcoef(z, depths[VIEWS // 2][features])[0, 1] < -0.9
    assert model.compute_num_observations() == VIEWS * POINTS
    assert other.compute_num_observations() > 0.95 * VIEWS * POINTS
    assert other.compute_mean_reprojection_error() < 1.0
    gain = np.linspace(0.5, 2.0, VIEWS)[:, None]
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
    assert brightness_correlation(model, [np.full(POINTS, 50.0)] * VIEWS) is None
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


def features(pixels, descriptors, scale=2.0):
    keypoints = np.zeros((len(pixels), 4), np.float32)
    keypoints[:, :2], keypoints[:, 2] = pixels, scale
    descriptors = np.asarray(descriptors, np.float32)
    return Features(keypoints, descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True))


@given(st.integers(0, 1000))
@settings(max_examples=15, deadline=None)
def test_mutual_matches_are_those_of_a_plain_loop(seed):
    rng = np.random.default_rng(seed)
    first = features(rng.uniform(0, 12, (20, 2)), rng.normal(size=(20, 128)) + 3.0)
    second = features(rng.uniform(0, 12, (25, 2)), rng.normal(size=(25, 128)) + 3.0)
    distance = np.linalg.norm(first.descriptors[:, None] - second.descriptors[None], axis=2)
    expected = []
    for i in range(20):
        j = distance[i].argmin()
        apart = np.linalg.norm(second.pixels - second.pixels[j], axis=1) > 2.0
        if distance[:, j].argmin() == i and distance[i, j] < min(0.7, 0.97 * distance[i, apart].min()):
            expected.append((i, j))
    np.testing.assert_array_equal(mutual_matches(first, second, 0.97), np.array(expected).reshape(-1, 2))
    assert mutual_matches(first, Features(second.keypoints[:0], second.descriptors[:0]), 0.97).shape == (0, 2)


def test_highlights_and_masks_yield_no_features():
    image = np.full((60, 80, 3), 100, np.uint8)
    image[20:24, 30:34] = 200  # twice as bright as its surroundings
    image[50:52, 60:62] = 255
    image[:, :10] = 118  # brighter, not by enough
    columns = np.nonzero(highlights(image))[1]
    np.testing.assert_array_equal(np.unique(columns), [30, 31, 32, 33, 60, 61])
    assert not highlights(image, level=256).any()
    mask = np.ones((60, 80), bool)
    mask[:, 70:] = False
    free = usable(image, mask, FeatureSettings(margin=2))
    assert not free[18:26, 28:36].any() and not free[:, 68:].any() and free[:, 40:50].all() and free[17, 31]


def video(places, reach, seed=0):
    """Images at places on a line; each sees the landmarks, two per unit, within ``reach``."""
    rng = np.random.default_rng(seed)
    landmarks = rng.normal(size=(2 * (max(places) + 2 * reach), 128)).astype(np.float32)
    landmarks /= np.linalg.norm(landmarks, axis=1, keepdims=True)
    features = []
    for place in places:
        visible = landmarks[2 * place : 2 * (place + reach)]
        keypoints = np.column_stack(
            [rng.uniform(0, 300, (len(visible), 2)), np.ones(len(visible)), np.zeros(len(visible))]
        )
        features.append(Features(keypoints.astype(np.float32), visible))
    return features


def test_neighbours_growing_steps_while_alike_and_loop_closures():
    pairs = alike_pairs(video(range(40), 14), SfmSettings())
    assert {second - first for first, second in pairs} == {1, 2, 4, 8}
    assert len(pairs) == 39 + 38 + 36 + 32
    # Nothing in common: neighbours alone.
    assert {second - first for first, second in alike_pairs(video(range(0, 400, 10), 8), SfmSettings())} == {1, 2}
    places = [*range(0, 300, 6), *range(300, 0, -6)]
    loops = [(first, second) for first, second in alike_pairs(video(places, 14), SfmSettings()) if second - first > 16]
    assert loops and all(abs(places[first] - places[second]) < 14 for first, second in loops)


@pytest.mark.parametrize("count", [30, 100])
def test_the_middle_of_a_video_is_matched_too(count):
    features = video(range(count), 40)
    pairs = alike_pairs(features, SfmSettings())
    names = tuple(map(str, range(count)))
    matches = {pair: np.zeros((0, 2), np.uint32) for pair in pairs}
    keypoints = tuple(image_features.keypoints for image_features in features)
    whole = MatchedVideo(tuple(map(Path, names)), names, ((8, 8),) * count, keypoints, (np.zeros(0),) * count, matches)
    part = whole.search_part()
    assert len(part.images) == len(part.keypoints) == 24
    steps = {second - first for first, second in part.matches}
    assert {1, 2, 4} <= steps
    indices = [int(name) for name in part.names]
    gap = {later - earlier for earlier, later in itertools.pairwise(indices)}
    assert len(gap) == 1
    assert abs((indices[0] + indices[-1]) / 2 - (count - 1) / 2) <= 1.0


#: Displacement of every pixel per frame, column and row.
SHIFT = np.array([1.4, -0.7])
COUNT = 7
FEW = TrackSettings(corners=150)


def wall(offset=(0.0, 0.0)):
    """A textured wall, moved by an offset."""
    row, column = np.mgrid[:120, :160].astype(float)
    places = np.stack([column - offset[0], row - offset[1], 0.0 * row], axis=-1)
    return np.rint(texture(places / 3.0)).astype(np.uint8)


def tracked(folder, images, settings=FEW, mask=None):
    """The points of a video of images."""
    for index, image in enumerate(images):
        write_png(folder / f"{index}.png", image)
    return track_points(sorted(folder.iterdir()), settings, mask)


def moved(frames, first, second):
    """Displacements of the points that two frames have in common."""
    rows = shared_tracks(frames[first], frames[second])
    return frames[second].pixels[rows[:, 1]] - frames[first].pixels[rows[:, 0]]


def test_points_move_as_the_image_does(tmp_path):
    images = [wall(k * SHIFT) for k in range(COUNT)]
    frames = tracked(tmp_path, images)
    first, last = track_between(images, [None] * COUNT, FEW)
    assert len(first) > 60
    np.testing.assert_allclose(last - first, moved(frames, 0, COUNT - 1)[: len(first)], atol=1e-4)
    assert [frame.followed > 80 for frame in frames] == [False] + [True] * (COUNT - 1)
    shifts = moved(frames, 0, COUNT - 1)
    assert len(shifts) > 60
    np.testing.assert_allclose(np.median(shifts, axis=0), (COUNT - 1) * SHIFT, atol=0.1)
    assert np.percentile(np.linalg.norm(shifts - (COUNT - 1) * SHIFT, axis=1), 90) < 0.5
    assert frames[3].shift == pytest.approx(np.linalg.norm(SHIFT) / 160, rel=0.05)


def test_larger_images_are_reduced_and_pixels_are_theirs_but_masked_ones(tmp_path):
    images = [wall(k * SHIFT).repeat(2, axis=0).repeat(2, axis=1) for k in range(2)]
    mask = np.ones((240, 320), bool)
    mask[:, 240:] = False
    frames, again = (tracked(tmp_path, images, FEW.model_copy(update={"side": 160}), mask) for _ in range(2))
    np.testing.assert_allclose(np.median(moved(frames, 0, 1), axis=0), 2 * SHIFT, atol=0.15)
    assert all(frame.pixels[:, 0].max() < 240 for frame in frames)
    np.testing.assert_array_equal(again[1].ids, frames[1].ids)
    np.testing.assert_array_equal(again[1].pixels, frames[1].pixels)


def test_points_are_found_again_behind_a_covered_frame(tmp_path):
    images = [wall(k * SHIFT) for k in range(COUNT)]
    images[3] = np.full_like(images[3], 90)
    frames = tracked(tmp_path, images)
    assert frames[3].followed == 0 and frames[3].sharpness == 0.0
    shifts = moved(frames, 2, 4)
    assert len(shifts) > 50
    np.testing.assert_allclose(np.median(shifts, axis=0), 2 * SHIFT, atol=0.1)


def test_the_lamp_drops_out_of_the_texture():
    row = np.linspace(0.4, 1.0, 120)[:, None, None]
    bright, dim = wall(), np.clip(wall() * row, 0, 255).astype(np.uint8)
    inner = slice(20, -20)
    for lit, dim_lit in zip(wall_textures(bright)[:2], wall_textures(dim)[:2], strict=True):
        assert np.corrcoef(lit[inner, inner].ravel(), dim_lit[inner, inner].ravel())[0, 1] > 0.95


def test_points_that_fit_no_motion_are_outliers():
    """Points of a tube, seen from two poses; a fifth of them moved elsewhere."""
    first, second = tube_frames(2, 4.0)
    rng = np.random.default_rng(0)
    pixels = np.stack([rng.uniform(8, WIDTH - 8, 200), rng.uniform(8, HEIGHT - 8, 200)], axis=1)
    fx, fy, cx, cy = INTRINSICS
    rays = np.stack([(pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy, np.ones(200)], axis=1)
    depth = first.depth.numpy()[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]
    pose, second_pose = (frame.camera.camera_to_world.double().numpy() for frame in (first, second))
    local = ((rays * depth[:, None]) @ pose[:3, :3].T + pose[:3, 3] - second_pose[:3, 3]) @ second_pose[:3, :3]
    moved_to = local[:, :2] / local[:, 2:] * (fx, fy) + (cx, cy)
    wrong = np.arange(200) % 5 == 0
    moved_to[wrong] += rng.choice([-25.0, 25.0], (wrong.sum(), 2))
    inliers = epipolar_inliers(pixels - 0.5, moved_to - 0.5, (HEIGHT, WIDTH), 2.5)
    assert inliers[~wrong].mean() > 0.95 and inliers[wrong].mean() < 0.3
    assert not epipolar_inliers(pixels[:14], moved_to[:14], (HEIGHT, WIDTH), 2.5).any()


def test_long_videos_are_cut_where_few_points_are_followed():
    followed = [0, *[300] * 99]
    followed[40], followed[70] = 20, 30
    assert cut_where_lost(followed, 100) == [range(100)]
    assert cut_where_lost(followed, 80) == [range(40), range(40, 100)]
    windows = cut_where_lost(followed, 50)
    assert windows[:2] == [range(40), range(40, 70)]
    assert [frame for window in windows for frame in window] == list(range(100))
    assert max(map(len, windows)) <= 50


def test_fineness_is_that_of_a_known_blur():
    """In white noise blurred by s, Laplacians smoothed by t have a power in proportion to (s^2 + t^2)^-3."""
    noise = np.random.default_rng(0).normal(0.0, 1.0, (384, 384)).astype(np.float32)
    for blur in (2.0, 3.0, 6.0):
        image = cv2.GaussianBlur(noise, (0, 0), blur)
        gray = np.clip(128.0 + 40.0 * image / image.std(), 20, 230).round().astype(np.uint8)
        assert fineness(gray) == pytest.approx(((blur**2 + 16.0) / (blur**2 + 4.0)) ** 1.5, rel=0.1)
        assert fineness(gray // 2) == pytest.approx(fineness(gray), rel=0.1)
