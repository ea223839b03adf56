import cv2
import numpy as np
import pytest
import torch

from coliags_plugin.reporting.colormaps import (
    HATCH_GREYS,
    UNKNOWN_GREY,
    color_bar,
    color_table,
    colorize_depth,
    colorize_error,
    common_limits,
    depth_error,
    hatch,
    rgb_error,
    side_by_side,
)


@pytest.mark.parametrize("name", ["depth", "error"])
def test_maps_grow_brighter_and_are_far_from_the_greys_of_the_unknown(name):
    table = color_table(name)
    lab = cv2.cvtColor((table / 255.0).astype(np.float32)[None], cv2.COLOR_RGB2LAB)[0, :, 0]
    assert np.all(np.diff(lab) > -0.5) and lab[-1] - lab[0] > 70
    for grey in (UNKNOWN_GREY, *HATCH_GREYS):
        assert np.linalg.norm(table.astype(float) - grey, axis=1).min() > 25
    with pytest.raises(ValueError, match="read-only"):
        table[0] = 0


def test_depth_image():
    table = color_table("depth")
    image = colorize_depth(torch.tensor([[10.0, 60.0, 35.0, -5.0, 99.0]]), (10.0, 60.0))
    assert image.dtype == np.uint8
    np.testing.assert_array_equal(image[0], table[[0, 255, 128, 0, 255]])
    unknown = np.full((9, 12), 30.0)
    unknown[:4] = np.nan
    unknown[3, :2] = np.inf, -np.inf
    plain, hatched = (colorize_depth(unknown, (0.0, 60.0), hatched=each) for each in (False, True))
    assert (plain[4:] == hatched[4:]).all() and (plain[:4] == UNKNOWN_GREY).all()
    assert (hatched[:4] == hatch(9, 12)[:4]).all()


def test_depth_error_image():
    table = color_table("error")
    true = np.full((2, 4), 30.0, np.float32)
    rendered = true + np.array([[0.0, 1.0, -2.0, 7.0], [np.nan, 0.0, 0.0, 0.0]], np.float32)
    true[1, 1] = np.nan
    valid = np.ones((2, 4), bool)
    valid[1, 2] = False
    image = colorize_error(*depth_error(torch.from_numpy(rendered), true, valid), limit=2.0)
    np.testing.assert_array_equal(image[0], table[[0, 128, 255, 255]])
    np.testing.assert_array_equal(image[1, 0], table[255])  # nothing rendered where there is a truth
    np.testing.assert_array_equal(image[1, 1:3], hatch(2, 4)[1, 1:3])
    np.testing.assert_array_equal(image[1, 3], table[0])
    error, valid = depth_error(np.array([[1.0, np.nan, np.inf]]), np.array([[np.nan, 2.0, 2.0]]))
    np.testing.assert_array_equal(error, [[0.0, np.inf, np.inf]])
    np.testing.assert_array_equal(valid, [[False, True, True]])


def test_rgb_error_image():
    table = color_table("error")
    true = np.zeros((1, 3, 3), np.uint8)
    rendered = true.copy()
    rendered[0, 1] = (51, 0, 0)  # a mean of 17 levels: one third of 0.2
    rendered[0, 2] = 255
    expected = table[[0, 85, 255]]

    def image(*arguments):
        return colorize_error(*rgb_error(*arguments), limit=0.2)[0]

    np.testing.assert_array_equal(image(rendered, true), expected)
    np.testing.assert_array_equal(image(torch.from_numpy(rendered / 255.0), true), expected)
    masked = image(rendered, true, np.array([[True, True, False]]))
    np.testing.assert_array_equal(masked[2], hatch(1, 3)[0, 2])


def test_color_bar_runs_through_the_map_and_is_labelled():
    bar = color_bar((0.0, 2.0), "mm", "error", width=480)
    assert bar.shape[1] == 480
    row = bar[16].astype(int)
    colored = np.flatnonzero((row != 255).any(1))
    table = color_table("error")
    np.testing.assert_array_equal(row[colored[0]], table[0])
    assert (bar[16] == table[128]).all(1).any()
    assert (bar[34:] < 128).any(), "no tick labels"
    assert not np.array_equal(bar, color_bar((0.0, 2.0), "cm", "error", width=480)), "the unit is not drawn"
    assert not np.array_equal(bar, color_bar((0.0, 5.0), "mm", "error", width=480)), "the limits are not drawn"


def test_side_by_side():
    first, second = np.full((10, 40, 3), 9, np.uint8), np.full((10, 60, 3), 200, np.uint8)
    sheet = side_by_side([first, torch.from_numpy(second)], ["a", "b"])
    assert sheet.shape[1] == 40 + 8 + 60
    np.testing.assert_array_equal(sheet[-10:, :40], first)
    np.testing.assert_array_equal(sheet[-10:, 48:], second)
    assert (sheet[:, 40:48] == 255).all()
    assert (sheet[:-10, :40] < 128).any()
    assert (sheet[:-10, 48:] < 128).any()
    long = side_by_side([first, second], ["a label much longer than its image", ""])
    assert (long[:-10, 40:] == 255).all()


@pytest.mark.parametrize("unit", [1.0, 0.01, 1000.0])
def test_common_limits_follow_the_unit_and_leave_out_what_is_far_off(unit):
    depth = np.linspace(0.0, 4.0, 1001).reshape(7, 143)
    far = depth.copy()
    far[0, :3] = 1e6
    far[1, 0] = np.nan
    assert common_limits([unit * depth, unit * far]) == (0.0, pytest.approx(unit * 4.0))
    assert common_limits([np.full((2, 2), unit * 4.12)]) == (0.0, pytest.approx(unit * 4.2))
    assert common_limits([np.full((2, 2), np.nan)]) == (0.0, 1.0)
