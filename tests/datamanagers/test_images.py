"""Reading and resizing images."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import read_rgb
from coliags_plugin.datamanagers.reading.depth_formats import C3VD_DEPTH
from coliags_plugin.datamanagers.reading.images import read_mask, resize_nearest, resize_rgb
from coliags_plugin.datamanagers.rectification import PAPER_SIZE, fitted


def test_colour_order_and_alpha(tmp_path):
    bgra = np.zeros((2, 3, 4), np.uint8)
    bgra[..., 0], bgra[..., 2], bgra[..., 3] = 10, 30, 99
    for name, pixels in (("a.png", bgra), ("b.png", bgra[..., :3])):
        cv2.imwrite(str(tmp_path / name), pixels)
        np.testing.assert_array_equal(read_rgb(tmp_path / name)[0, 0], [30, 0, 10])


@pytest.mark.parametrize(
    ("reader", "pixels", "message"),
    [
        (read_rgb, np.zeros((4, 4), np.uint8), "1 channel of uint8.*8-bit RGB"),
        (read_rgb, np.zeros((4, 4, 3), np.uint16), "3 channels of uint16"),
        (read_rgb, None, "cannot read"),
        (C3VD_DEPTH.read, np.zeros((4, 4), np.uint8), "1 channel of uint8.*16-bit"),
        (C3VD_DEPTH.read, np.zeros((4, 4, 3), np.uint16), "3 channels of uint16"),
        (read_mask, np.arange(48, dtype=np.uint8).reshape(4, 4, 3), "a colour image.*three equal ones"),
        (read_mask, np.zeros((4, 4), np.uint16), "1 channel of uint16.*8-bit mask"),
    ],
)
def test_the_wrong_kind_of_image(tmp_path, reader, pixels, message):
    if pixels is not None:
        cv2.imwrite(str(tmp_path / "x.png"), pixels)
    with pytest.raises(InputError, match=message):
        reader(tmp_path / "x.png")


@pytest.mark.parametrize("suffix", [".png", ".tiff", ".jpg"])
@pytest.mark.parametrize("share", [0.0, 0.5, 0.98])
def test_half_a_file_is_refused_by_name(tmp_path, suffix, share):
    pixels = np.random.default_rng(0).integers(0, 256, (64, 64), dtype=np.uint8)
    data = cv2.imencode(suffix, pixels)[1].tobytes()
    path = tmp_path / f"0003_color{suffix}"
    path.write_bytes(data[: int(len(data) * share)])
    with pytest.raises(InputError, match=r"0003_color.*cannot be decoded.*cut short"):
        read_mask(path)


def test_shrinking_averages_and_growing_interpolates():
    image = np.random.default_rng(0).integers(0, 256, (8, 12, 3), dtype=np.uint8)
    small = resize_rgb(image, 6, 4)
    np.testing.assert_allclose(small, image.reshape(4, 2, 6, 2, 3).mean(axis=(1, 3)), atol=0.51)
    assert resize_rgb(image, 12, 8) is image
    ramp = np.arange(0, 240, 20, dtype=np.uint8)[None, :, None].repeat(4, 0).repeat(3, 2)
    grown = resize_rgb(ramp, 24, 4)[0, 1:-1, 0].astype(int)
    np.testing.assert_allclose(np.diff(grown), 10, atol=1)


@pytest.mark.parametrize("size", [(4, 3), (12, 8), (16, 16)])
def test_nearest_takes_the_pixel_under_the_centre(size):
    values = np.arange(96, dtype=np.uint16).reshape(8, 12)
    reference = cv2.resize(values, size, interpolation=cv2.INTER_NEAREST_EXACT)
    result = resize_nearest(values, *size)
    assert result.dtype == np.uint16
    np.testing.assert_array_equal(result, reference)


def test_sizes_fit_the_papers_and_nothing_is_enlarged():
    assert fitted(800, 800, PAPER_SIZE) == (270, 270)
    assert fitted(3000, 10, PAPER_SIZE) == (338, 1)
    assert fitted(3000, 10, None) == (3000, 10)
