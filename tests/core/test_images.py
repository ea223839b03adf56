"""Encoding of images."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import encode_image, write_image, write_mask


def read(path):
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


@pytest.mark.parametrize("suffix", [".png", ".tiff"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_lossless_images_keep_their_numbers(suffix, dtype, tmp_path):
    pixels = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, (5, 7, 3)).astype(dtype)
    write_image(tmp_path / "folder" / f"rgb{suffix}", pixels)
    np.testing.assert_array_equal(read(tmp_path / "folder" / f"rgb{suffix}")[..., ::-1], pixels)
    write_image(tmp_path / f"grey{suffix}", pixels[..., 0])
    np.testing.assert_array_equal(read(tmp_path / f"grey{suffix}"), pixels[..., 0])


def test_masks_are_black_and_white(tmp_path):
    write_mask(tmp_path / "mask.png", np.array([[True, False]]))
    assert read(tmp_path / "mask.png").tolist() == [[255, 0]]


def test_what_a_format_cannot_hold_is_refused():
    with pytest.raises(InputError, match=r"a uint8 \[0, 4\] image cannot be written as \.png"):
        encode_image(np.zeros((0, 4), np.uint8))
    with pytest.raises(InputError, match=r"cannot be written as \.nothing"):
        encode_image(np.zeros((2, 2), np.uint8), ".nothing")
