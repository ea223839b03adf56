import struct

import cv2
import numpy as np
import PIL.Image
import pytest
import skimage.io
import tifffile
import torch

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import read_rgb
from coliags_plugin.reporting.image_files import (
    EncodedImage,
    read_depth_tiff,
    write_depth_tiff,
    write_png,
)


@pytest.fixture
def rgb():
    return np.random.default_rng(0).integers(0, 256, (7, 5, 3), dtype=np.uint8)


def test_lossless_pictures_hold_their_pixels_and_nothing_else(tmp_path, rgb):
    path = tmp_path / "new" / "folder" / "é.png"
    write_png(path, torch.from_numpy(rgb))
    np.testing.assert_array_equal(read_rgb(path), rgb)
    np.testing.assert_array_equal(skimage.io.imread(path), rgb)
    assert [file.name for file in path.parent.iterdir()] == [path.name]
    data, at, chunks = path.read_bytes(), 8, set()
    assert struct.unpack(">IIBB", data[16:26]) == (5, 7, 8, 2)  # 8 bits of RGB
    while at < len(data):
        chunks.add(data[at + 4 : at + 8])
        at += 12 + int.from_bytes(data[at : at + 4], "big")
    assert chunks == {b"IHDR", b"IDAT", b"IEND"}
    data = EncodedImage.webp(rgb).data
    assert data[:4] == b"RIFF" and data[8:12] == b"WEBP"
    assert (cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[:, :, ::-1] == rgb).all()


def test_jpeg_keeps_full_chroma(rgb):
    data = EncodedImage.jpeg(rgb).data
    frame = data.index(b"\xff\xc0")
    assert data[frame + 11] == 0x11  # sampling of the luma component: 1 x 1, as the chroma's
    small = EncodedImage.jpeg(np.zeros((30, 40, 3), np.uint8), width=20)
    assert (small.width, small.height) == (20, 15) and small.uri.startswith("data:image/jpeg;base64,/9j/")
    flat = np.full((8, 8, 3), (200, 60, 30), np.uint8)
    decoded = cv2.imdecode(np.frombuffer(EncodedImage.jpeg(flat).data, np.uint8), cv2.IMREAD_COLOR)[:, :, ::-1]
    assert np.abs(decoded.astype(int) - flat).max() <= 3


def test_tiff_keeps_float32_nan_and_infinity(tmp_path):
    depth = np.random.default_rng(0).normal(50, 20, (6, 9)).astype(np.float32)
    depth[0, 0], depth[1, 1], depth[2, 2] = np.nan, np.inf, np.float32(1e-30)
    path = tmp_path / "d.tiff"
    write_depth_tiff(path, torch.from_numpy(depth).requires_grad_())
    for stored in (read_depth_tiff(path), tifffile.imread(path)):
        assert stored.dtype == np.float32
        np.testing.assert_array_equal(stored, depth)
    texts = {270, 271, 272, 285, 305, 306, 315, 316, 33432, 34665, 34853}  # descriptions, makers, dates, names, places
    with PIL.Image.open(path) as image:
        assert not texts & set(image.tag_v2)
    write_depth_tiff(path, np.full((2, 3), 0.1))  # float64 is rounded
    np.testing.assert_array_equal(read_depth_tiff(path), np.full((2, 3), np.float32(0.1)))


def test_what_is_no_image_or_no_depth_is_refused(tmp_path):
    four, grey = np.zeros((4, 4, 4), np.uint8), np.zeros((4, 4), np.uint8)
    for wrong in (grey, four, np.zeros((4, 4, 3)), np.zeros((0, 4, 3), np.uint8)):
        for encode in (EncodedImage.png, EncodedImage.webp):
            with pytest.raises(InputError, match="8-bit RGB, uint8"):
                encode(wrong)
    for wrong in (np.zeros((3, 3), int), np.zeros((3, 3, 1)), np.zeros((0, 3))):
        with pytest.raises(InputError, match="depth map"):
            write_depth_tiff(tmp_path / "d.tiff", wrong)
    assert not list(tmp_path.iterdir())


def test_nothing_is_converted_on_reading(tmp_path, rgb):
    cv2.imwrite(str(tmp_path / "grey.png"), rgb[:, :, 0])
    cv2.imwrite(str(tmp_path / "deep.png"), rgb.astype(np.uint16))
    cv2.imwrite(str(tmp_path / "deep.tiff"), rgb[:, :, 0].astype(np.uint16))
    for name in ("grey.png", "deep.png"):
        with pytest.raises(InputError, match="8-bit RGB"):
            read_rgb(tmp_path / name)
    with pytest.raises(InputError, match="float32"):
        read_depth_tiff(tmp_path / "deep.tiff")
