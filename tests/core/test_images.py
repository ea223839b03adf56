"""Encoding and decoding of images."""

from __future__ import annotations

import resource
import struct
import zlib

import cv2
import numpy as np
import pytest

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import decode_image, encode_image, write_image, write_mask


@pytest.mark.parametrize(("suffix", "bits"), [(".png", 8), (".png", 16), (".tiff", 8), (".tiff", 16), (".bmp", 8)])
def test_lossless_images_keep_their_numbers_and_masks_are_black_and_white(suffix, bits, tmp_path):
    path = tmp_path / "folder" / f"a{suffix}"
    pixels = np.random.default_rng(0).integers(0, 2**bits, (5, 7, 3)).astype(f"u{bits // 8}")
    write_image(path, pixels)
    path.write_bytes(path.read_bytes() + b"behind the end")
    for read in (decode_image, lambda file: cv2.imread(str(file), cv2.IMREAD_UNCHANGED)):
        np.testing.assert_array_equal(read(path)[..., ::-1], pixels)
        write_image(tmp_path / f"grey{suffix}", pixels[..., 0])
        np.testing.assert_array_equal(read(tmp_path / f"grey{suffix}"), pixels[..., 0])
        write_mask(tmp_path / f"mask{suffix}", np.array([[True, False]]))
        assert read(tmp_path / f"mask{suffix}").tolist() == [[255, 0]]
    assert decode_image(path, cv2.IMREAD_GRAYSCALE).shape == (5, 7)


def test_what_a_format_cannot_hold_is_refused():
    with pytest.raises(InputError, match=r"a uint8 \[0, 4\] image cannot be written as \.png"):
        encode_image(np.zeros((0, 4), np.uint8))
    with pytest.raises(InputError, match=r"cannot be written as \.nothing"):
        encode_image(np.zeros((2, 2), np.uint8), ".nothing")


def chunk(kind, data, length=None):
    length = len(data) if length is None else length
    return length.to_bytes(4, "big") + kind + data + zlib.crc32(kind + data).to_bytes(4, "big")


def test_damaged_images_are_refused_before_memory_is_asked_for(tmp_path):
    whole = encode_image(np.zeros((5, 7), np.uint8))
    start, rest = whole[:33], whole[33:]
    noise = np.random.default_rng(0).integers(0, 255, (40, 50, 3)).astype(np.uint8)
    png, tiff = (bytearray(encode_image(noise, suffix)) for suffix in (".png", ".tiff"))
    png[len(png) // 2] ^= 0xFF
    # OpenCV would allocate what the length of a chunk says.
    long = start + chunk(b"IDAT", b"x" * 20, 1 << 30) + rest
    sizes = ((60_000, 60_000), (30_000, 30_000), (40_000, 10), (2**31 - 1, 1))
    damaged = {
        "cut": (whole[:-13], "cannot be decoded"),
        "cut in the last chunk": (whole[:-1], "cannot be decoded"),
        "empty": (b"", "cannot be decoded"),
        "long": (long, "cannot be decoded"),
        **{
            f"{width} x {height}": (
                start[:8] + chunk(b"IHDR", struct.pack(">II", width, height) + start[24:29]) + rest,
                f"{width} x {height} pixels|decompression bomb|cannot be decoded",
            )
            for width, height in sizes
        },
        "text": (b"no image at all", "cannot be decoded"),
        "wrong checksum": (bytes(png), "cannot be decoded"),
        "half of a TIFF": (bytes(tiff[: len(tiff) // 2]), "cannot be decoded"),
    }
    for name, (data, message) in damaged.items():
        path = tmp_path / f"{name}.png"
        path.write_bytes(data)
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        with pytest.raises(InputError, match=message):
            decode_image(path)
        assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000, name  # KiB
    with pytest.raises(InputError, match="cannot read"):
        decode_image(tmp_path / "missing.png")
