"""Reading of images, files that others name, and initial points."""

from __future__ import annotations

import unicodedata
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
import pytest
import torch

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import has_alpha, read_8_bit, read_alpha, read_rgb
from coliags_plugin.core.scene_files import named_file, numbered, short_names
from coliags_plugin.core.scenes import Frame
from coliags_plugin.datamanagers.file_formats import read_mask, resize_nearest, resize_rgb, scaled_depth
from coliags_plugin.datamanagers.fusion import fuse_depth, load_points, subsampled

# Images


@pytest.mark.parametrize(
    ("reader", "pixels", "message"),
    [
        (read_rgb, np.zeros((4, 4, 3), np.uint16), "3 channels of uint16"),
        (read_mask, np.arange(16, dtype=np.uint8).reshape(4, 4), "values reach from 0 to 15 of 255"),
    ],
)
def test_the_wrong_kind_of_image(tmp_path, reader, pixels, message):
    cv2.imwrite(str(tmp_path / "x.png"), pixels)
    with pytest.raises(InputError, match=message):
        reader(tmp_path / "x.png")


#: Left of the middle hidden, transparency in the middle 127 and 128 of 255.
ALPHA = np.array([[0, 0, 127, 128, 255, 255]] * 4, np.uint8)
COLORS = np.full((4, 6, 3), (200, 100, 10), np.uint8)
GREY = COLORS[..., 1]


def with_alpha(*channels: np.ndarray, dtype=np.uint8) -> np.ndarray:
    return np.dstack([*channels, ALPHA]).astype(dtype) * (257 if dtype == np.uint16 else 1)


@pytest.mark.parametrize(
    ("name", "pixels", "options", "binary"),
    [
        ("rgba.png", with_alpha(COLORS), {}, False),
        ("rgba.webp", with_alpha(COLORS), {"lossless": True, "exact": True}, False),
        ("misnamed.png", with_alpha(COLORS), {"format": "WEBP", "lossless": True, "exact": True}, False),
        ("rgba.tif", with_alpha(COLORS), {}, False),
        ("la.png", with_alpha(GREY), {}, False),
        ("palette.png", np.uint8(ALPHA < 128), {"transparency": 1}, False),
        ("key.png", np.where(ALPHA[..., None] < 128, np.uint8(0), COLORS), {"transparency": (0, 0, 0)}, False),
        ("16.png", with_alpha(COLORS[..., ::-1], dtype=np.uint16), None, False),
        ("16.tif", with_alpha(COLORS[..., ::-1], dtype=np.uint16), None, False),
        ("opaque.png", np.dstack([COLORS, ALPHA | 128]), {}, True),
        ("unused.png", np.dstack([COLORS, ALPHA & 127]), {}, True),
        ("rgb.png", COLORS, {}, True),
        ("grey.png", GREY, {}, True),
        ("rgb.jpg", COLORS, {}, True),
    ],
)
def test_alpha_below_half_is_a_mask(tmp_path, name, pixels, options, binary):
    path = tmp_path / name
    if options is None:
        cv2.imwrite(str(path), pixels)
    else:
        image = PIL.Image.fromarray(pixels)
        if name == "palette.png":
            image = PIL.Image.fromarray(pixels).convert("P")
            image.putpalette([200, 100, 10, 255, 0, 255])
        image.save(path, **options)
    mask = read_alpha(path) if has_alpha(path) else None
    assert mask is None if binary else (mask == (ALPHA >= 128)).all()
    color = (100, 100, 100) if "la" in name or "grey" in name else (200, 100, 10)
    read = read_8_bit(path)
    np.testing.assert_allclose(read[:, 4:, :3], np.broadcast_to(color, (4, 2, 3)), atol=1)
    assert read.dtype == np.uint8


WHITE = np.repeat(np.uint8([0, 255]), 32)[None].repeat(48, 0)


@pytest.mark.parametrize(
    ("name", "stored"),
    [
        ("a.png", WHITE),
        ("a.png", WHITE // 255),  # 0 and 1
        ("a.png", WHITE // 64),  # 0 and 3
        ("a.png", np.dstack([WHITE] * 3)),
        ("a.png", np.dstack([WHITE] * 4)),  # the same by colour and by transparency
        ("a.png", np.dstack([np.full_like(WHITE, 255)] * 3 + [WHITE])),
        ("a.png", WHITE.astype(np.uint16) * 257),
        ("a.png", WHITE.astype(np.uint16)),  # 8 bits in 16
        ("a.png", WHITE.astype(np.uint16) // 255),
        ("a.tif", WHITE),
        ("a.bmp", WHITE),
        ("a.jpg", WHITE),
        ("a.png", cv2.GaussianBlur(WHITE, (0, 0), 2.0)),
        ("a.png", cv2.GaussianBlur(WHITE.astype(np.uint16) * 257, (0, 0), 2.0)),
    ],
)
@pytest.mark.parametrize("quality", [40, 95])
def test_a_mask_is_what_is_at_least_half_white(tmp_path, name, stored, quality):
    cv2.imwrite(str(tmp_path / name), stored, [cv2.IMWRITE_JPEG_QUALITY, quality])
    np.testing.assert_array_equal(read_mask(tmp_path / name), WHITE > 0)


def test_masks_of_one_value_of_one_bit_and_of_a_colour(tmp_path):
    for value in (0, 1, 255):
        cv2.imwrite(str(tmp_path / "a.png"), np.full((4, 4), value, np.uint8))
        assert (read_mask(tmp_path / "a.png") == (value > 0)).all()
    PIL.Image.fromarray(WHITE > 0).save(tmp_path / "bit.png")
    np.testing.assert_array_equal(read_mask(tmp_path / "bit.png"), WHITE > 0)
    cv2.imwrite(str(tmp_path / "red.png"), np.dstack([WHITE * 0, WHITE * 0, WHITE // 2]))
    np.testing.assert_array_equal(read_mask(tmp_path / "red.png", colored=True), WHITE > 0)
    with pytest.raises(InputError, match=r"red\.png is a colour image.*8 or 16 bits: one channel"):
        read_mask(tmp_path / "red.png")


def test_what_holds_several_images_or_another_format_is_refused_by_name(tmp_path):
    single, small = (PIL.Image.fromarray(COLORS[: 4 // n]) for n in (1, 2))
    for name, others, count in (("a.tif", [single] * 3, 4), ("a.png", [PIL.Image.fromarray(COLORS // 2)], 2)):
        single.save(tmp_path / name, save_all=True, append_images=others)
        with pytest.raises(InputError, match=f"{name} holds {count} images. Expected one image in a file"):
            read_rgb(tmp_path / name)
    single.save(tmp_path / "preview.tif", save_all=True, append_images=[small])
    np.testing.assert_array_equal(read_rgb(tmp_path / "preview.tif"), COLORS)
    (tmp_path / "a.heic").write_bytes(b"\0\0\0\x18ftypheic\0\0\0\0mif1heic")
    with pytest.raises(InputError, match=r"a\.heic .* is HEIF \(\.heic, \.avif\): convert it"):
        read_rgb(tmp_path / "a.heic")
    with pytest.raises(InputError, match=r"float32\. Expected an image of 8 or 16 bits"):
        cv2.imwrite(str(tmp_path / "f.tif"), COLORS.astype(np.float32))
        read_8_bit(tmp_path / "f.tif")


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".webp"])
def test_the_orientation_in_exif_is_ignored_by_all_readers(tmp_path, suffix):
    exif = PIL.Image.Exif()
    exif[0x112] = 6
    PIL.Image.fromarray(COLORS).save(tmp_path / f"a{suffix}", exif=exif)
    assert read_rgb(tmp_path / f"a{suffix}").shape == read_8_bit(tmp_path / f"a{suffix}").shape == (4, 6, 3)


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


# Depth


@pytest.mark.parametrize("suffix", [".png", ".tiff", ".tif", ".npy"])
def test_depth_files_hold_numbers_proportional_to_depth(tmp_path, suffix):
    steps, path = np.array([[0.0, 1.0, 300.0], [25.0, 7.0, 65535.0]]), tmp_path / f"0{suffix}"
    unknown = steps == 0.0
    if suffix in (".npy", ".tif"):
        steps = np.vstack([steps, [[-1.0, np.nan, np.inf]]]).astype(np.float32)
        unknown = np.vstack([unknown, [[True] * 3]])
        np.save(path, steps) if suffix == ".npy" else cv2.imwrite(str(path), steps)
    else:
        cv2.imwrite(str(path), steps.astype(np.uint16))
    form = scaled_depth(path, 0.02)
    np.testing.assert_allclose(form.decode(form.read(path))[0], np.where(unknown, np.nan, 0.02 * steps), rtol=1e-6)


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.zeros((4, 5, 3)), r"an array \[4, 5, 3\] of float64"),
        (np.zeros((4, 5), complex), "complex128"),
        (np.array([None, {}]), "cannot read"),
    ],
)
def test_depth_arrays_of_another_kind(tmp_path, array, message):
    np.save(tmp_path / "0.npy", array)
    with pytest.raises(InputError, match=message):
        scaled_depth(tmp_path / "0.npy", 1.0).read(tmp_path / "0.npy")


@pytest.mark.parametrize("suffix", [".npz", ".EXR"])
def test_depth_files_that_are_not_read_are_refused_by_kind(suffix):
    with pytest.raises(InputError, match=rf"0\{suffix}: depth in \{suffix}\. Expected .*\.npy\. Convert"):
        scaled_depth(Path(f"0{suffix}"), 1.0)


def test_numbered_files_of_no_known_kind_are_said(tmp_path, caplog):
    for name in ("0_depth.jpg", "1_depth.jpg", "notes.txt"):
        (tmp_path / name).touch()
    assert not numbered(tmp_path, "depth", frozenset({".png"})) and "0_depth.jpg, 1_depth.jpg are not" in caplog.text
    (tmp_path / "0_depth.png").touch()
    caplog.clear()
    assert len(numbered(tmp_path, "depth", frozenset({".png"}))) == 1 and not caplog.records


# Names of files


OUTSIDE, NO_NAME = r"x\.json names .* outside of .*outside_files=true", r"x\.json names .*Expected the name of a file"


@pytest.mark.parametrize(
    ("names", "refused"),
    [
        (["a.png", "images/a.png", "images/../a.png", "./a.png", "", "..png", "{folder}/a.png"], None),
        (["../a.png", "images/../../a.png", "/etc/hostname", ".."], OUTSIDE),
        (["a\0b", "a" * 300, "a/" * 3000], NO_NAME),
    ],
)
def test_names_of_files_within_the_folder_outside_and_of_none(tmp_path, names, refused):
    for name in (name.replace("{folder}", str(tmp_path)) for name in names):
        if refused is not None:
            with pytest.raises(InputError, match=refused):
                named_file(tmp_path, name, "x.json", outside=False)
        if refused != NO_NAME:
            assert named_file(tmp_path, name, "x.json", outside=refused is not None) == tmp_path / name


@pytest.mark.parametrize(
    ("paths", "names"),
    [
        (["cam1/10.png", "cam0/20.jpg"], ["cam1-10", "cam0-20"]),
        (["./images/frame_10", "images/frame_9"], ["frame_10", "frame_9"]),
        (["images/cam1/2.jpg", "images/cam0/10.jpg"], ["cam1-2", "cam0-10"]),
        (["a/1.png", "a/1.jpg"], ["1.png", "1.jpg"]),
    ],
)
def test_names_are_as_short_as_they_can_be(paths, names):
    assert short_names(paths) == names


# Initial points


def frame(depth, index=0, mask=None):
    height, width = depth.shape
    c2w = torch.eye(4)
    c2w[:3, 3] = torch.tensor([5.0, -3.0, float(index)])
    camera = Camera(9.0, 7.0, 2.25, 4.5, width, height, c2w)
    image = torch.arange(height * width * 3).remainder(256).to(torch.uint8).reshape(height, width, 3)
    return Frame.of(f"{index:04d}", index, image, camera, torch.as_tensor(depth, dtype=torch.float32), mask)


def read_points(path, count, generator):
    return subsampled(load_points(path), count, generator, path)


def rng(seed=0):
    return np.random.default_rng(seed)


def test_all_usable_pixels_are_taken_where_there_are_few_and_the_true_centre_is_used():
    depth, mask = torch.rand(6, 5) * 10 + 3, torch.ones(6, 5, dtype=torch.bool)
    depth[0], mask[:, 0] = torch.nan, False
    view, usable = frame(depth, mask=mask), mask & ~depth.isnan()
    points = fuse_depth([view], 1000, rng())
    torch.testing.assert_close(points.positions, view.camera.unproject(view.depth)[usable])
    torch.testing.assert_close(points.colors, view.image[usable])
    pixels, z = view.camera.project(points.positions)
    torch.testing.assert_close(pixels[7], torch.tensor([4.5, 2.5]))
    torch.testing.assert_close(z, depth[usable])


def test_a_draw_is_without_replacement_repeatable_and_fair():
    near, far = torch.full((40, 50), 5.0), torch.full((40, 50), 9.0)
    far[:20] = torch.nan
    frames = [frame(near, 0), frame(far, 1)]
    points = fuse_depth(frames, 1500, rng())
    assert len(points) == 1500
    assert len(torch.unique(points.positions, dim=0)) == 1500
    again, other = fuse_depth(frames, 1500, rng()), fuse_depth(frames, 1500, rng(1))
    assert torch.equal(points.positions, again.positions)
    assert not torch.equal(points.positions, other.positions)
    # 2000 and 1000 pixels: hypergeometric, standard deviation 13.
    share = int((points.positions[:, 2] < 7).sum())
    assert abs(share - 1000) < 60


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("none.ply", None, "no file"),
        ("bad.ply", "not a ply", "cannot be read as PLY"),
        ("bad.npz", "not an npz", "cannot read"),
        ("other.npz", {"xyz": np.ones((2, 3))}, "positions"),
        ("flat.npz", {"positions": np.ones((2, 2))}, "shape"),
        ("words.npz", {"positions": np.full((2, 3), "a")}, "numbers"),
        ("float.npz", {"positions": np.ones((2, 3)), "colors": np.ones((2, 3))}, "uint8"),
        ("nan.npz", {"positions": np.full((2, 3), np.nan)}, "holds no points"),
        ("p.obj", "v 0 0 0", "neither"),
    ],
)
def test_files_that_hold_no_points(tmp_path, name, content, message):
    if isinstance(content, dict):
        np.savez(tmp_path / name, **content)
    elif content is not None:
        (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=message):
        read_points(tmp_path / name, 10, rng())


@pytest.mark.parametrize("stored", ["NFC", "NFD"])
@pytest.mark.parametrize("said", ["NFC", "NFD"])
def test_letters_with_marks_are_found_however_they_are_spelled(tmp_path, said, stored):
    path = tmp_path / unicodedata.normalize(stored, "Fälle é.png")
    path.touch()
    assert named_file(tmp_path, unicodedata.normalize(said, "Fälle é.png"), "a file", outside=False) == path
