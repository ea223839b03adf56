"""Resampling: geometry, aliasing, values that must not be mixed."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from coliags_plugin.geometry.lenses.models import LENSES, Undistortion, octagon_mask, undistortion_map

NAMES = sorted(LENSES)
STRAIGHT = replace(LENSES["legacy-pinhole"], k1=0.0, k2=0.0)


def seen_by(lens):
    """The tangents (x, y) that every pixel of a raw image sees. [H, W, 2]"""
    columns, rows = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    return lens.unproject(np.stack([columns.ravel(), rows.ravel()], 1))[:, :2].reshape(lens.height, lens.width, 2)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("size", [(338, 270), (150, 130), (700, 540)])
def test_every_pixel_shows_what_its_pinhole_ray_sees(name, size):
    lens = LENSES[name].resized(675, 540)
    pinhole = LENSES[name].resized(*size).pinhole
    tangents = np.nan_to_num(seen_by(lens))
    image = np.rint(np.clip(128.0 + 100.0 * tangents, 0, 255)).astype(np.uint8)
    undistortion = Undistortion(lens, pinhole, octagon_mask(675, 540))
    assert undistortion.valid.all()
    result = undistortion.image(np.dstack([image, image[..., :1]]))
    x = (np.arange(size[0]) + 0.5 - pinhole.cx) / pinhole.fx
    y = (np.arange(size[1]) + 0.5 - pinhole.cy) / pinhole.fy
    # One grey level is 0.01; rounding at the start, in OpenCV's 1/32 pixel and at the end add up to less than two.
    np.testing.assert_allclose(result[..., 0], np.broadcast_to(128 + 100 * x, result.shape[:2]), atol=1.6)
    np.testing.assert_allclose(result[..., 1], np.broadcast_to(128 + 100 * y[:, None], result.shape[:2]), atol=1.6)


@pytest.mark.parametrize("name", NAMES)
def test_nearest_is_within_half_a_source_pixel_and_keeps_16_bits(name):
    lens = LENSES[name].resized(675, 540)
    pinhole = lens.resized(338, 270).pinhole
    undistortion = Undistortion(lens, pinhole)
    columns, rows = np.meshgrid(np.arange(675, dtype=np.uint16), np.arange(540, dtype=np.uint16))
    column, row = undistortion.nearest(columns, 0), undistortion.nearest(rows, 0)
    assert column.dtype == np.uint16
    x = (np.arange(338) + 0.5 - pinhole.cx) / pinhole.fx
    y = (np.arange(270) + 0.5 - pinhole.cy) / pinhole.fy
    x, y = np.meshgrid(x, y)
    exact = lens.project(np.stack([x.ravel(), y.ravel(), np.ones(x.size)], 1)).reshape(270, 338, 2)
    assert np.abs(np.stack([column, row], -1) + 0.5 - exact).max() <= 0.5 + 1e-4


def test_shrinking_by_a_whole_number_is_the_mean_of_blocks_and_the_same_size_changes_nothing():
    lens = STRAIGHT.resized(240, 192)
    image = np.random.default_rng(0).integers(0, 256, (192, 240, 3), dtype=np.uint8)
    nominal = lens.resized(60, 48).pinhole
    undistortion = Undistortion(lens, nominal)
    assert undistortion.supersampling == 4
    blocks = image.reshape(48, 4, 60, 4, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(undistortion.image(image), blocks, atol=0.51)
    same = Undistortion(lens, lens.pinhole)
    np.testing.assert_array_equal(same.image(image), image)
    np.testing.assert_array_equal(same.nearest(image[..., 0], 0), image[..., 0])
    # No more samples than of half the focal length.
    for fx, fy in ((0.5 * nominal.fx, 0.5 * nominal.fy), (1.0, nominal.fy)):
        assert Undistortion(lens, replace(nominal, fx=fx, fy=fy)).supersampling == 8


def test_fine_stripes_turn_grey_instead_of_aliasing():
    lens = LENSES["omnidirectional"]
    stripes = np.zeros((1080, 1350, 3), np.uint8)
    stripes[:, ::2] = 255
    result = Undistortion(lens, lens.resized(338, 270).pinhole).image(stripes)
    middle = result[100:170, 130:210].astype(float)
    assert middle.std() < 20
    once = undistortion_map(lens, lens.resized(338, 270).pinhole)
    sampled_once = cv2.remap(stripes, *once, cv2.INTER_LINEAR)
    assert sampled_once[100:170, 130:210].std() > 2 * middle.std()


def test_no_pixel_of_the_dark_corners_gets_in():
    lens = LENSES["omnidirectional"].resized(675, 540)
    octagon = octagon_mask(675, 540)
    nominal = lens.resized(169, 135).pinhole
    wide = replace(nominal, fx=nominal.fx * 0.45, fy=nominal.fy * 0.45)
    undistortion = Undistortion(lens, wide, octagon)
    assert 0.5 < undistortion.valid.mean() < 0.97
    image = np.where(octagon[..., None], 200, 0).astype(np.uint8).repeat(3, axis=2)
    assert (undistortion.image(image)[undistortion.valid] == 200).all()
    assert (undistortion.nearest(octagon, 0)[undistortion.valid]).all()


def test_legacy_pinhole_is_opencvs_undistort(shared_data):
    frame = cv2.imread(str(shared_data / "c3vd_official_frame" / "color.png"))
    lens = LENSES["legacy-pinhole"]
    matrix = lens.pinhole.opencv_matrix()
    reference = cv2.undistort(frame, matrix, np.array([lens.k1, lens.k2, 0.0, 0.0]))
    same_size = Undistortion(lens, lens.pinhole)
    assert same_size.supersampling == 1
    difference = np.abs(same_size.image(frame).astype(int) - reference.astype(int))
    assert difference.mean() < 0.1
    halved = Undistortion(lens, lens.resized(675, 540).pinhole).image(frame)
    resized = cv2.resize(reference, (675, 540), interpolation=cv2.INTER_AREA)
    assert np.abs(halved.astype(int) - resized.astype(int)).mean() < 0.5


@pytest.mark.thorough
def test_official_frame_through_the_true_lens_has_no_dark_corner(shared_data):
    frame = cv2.imread(str(shared_data / "c3vd_official_frame" / "color.png"))
    for name in NAMES:
        lens = LENSES[name]
        undistortion = Undistortion(lens, lens.resized(338, 270).pinhole, octagon_mask(1350, 1080))
        assert undistortion.valid.all()
        assert undistortion.image(frame).max(axis=2).min() > 20
