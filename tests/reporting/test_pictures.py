"""Colour maps, image files and videos: arrays in, the same pixels out."""

import math
import struct

import av
import cv2
import numpy as np
import PIL.Image
import pytest
import skimage.io
import tifffile
import torch

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import read_rgb
from coliags_plugin.reporting import video
from coliags_plugin.reporting.colormaps import (
    HATCH_GREYS,
    UNKNOWN_GREY,
    color_bar,
    color_table,
    colorize_depth,
    colorize_error,
    depth_error,
    depth_limits,
    depth_scale_text,
    hatch,
    rgb_error,
    scale_ticks,
    side_by_side,
)
from coliags_plugin.reporting.image_files import EncodedImage, read_depth_tiff, write_depth_tiff, write_png
from coliags_plugin.reporting.video import write_video

# Colour maps


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
    np.testing.assert_array_equal(image[0], table[[0, 255, round(255 * math.log(3.5) / math.log(6.0)), 0, 255]])
    unknown = np.full((9, 12), 30.0)
    unknown[:4] = np.nan
    unknown[3, :2] = np.inf, -np.inf
    plain, hatched = (colorize_depth(unknown, (6.0, 60.0), hatched=each) for each in (False, True))
    assert (plain[4:] == hatched[4:]).all() and (plain[:4] == UNKNOWN_GREY).all()
    assert (hatched[:4] == hatch(9, 12)[:4]).all()


def test_depth_error_image():
    table = color_table("error")
    true = np.full((2, 4), 30.0, np.float32)
    rendered = true + np.array([[0.0, 1.0, -2.0, 7.0], [np.nan, 0.0, 0.0, 0.0]], np.float32)
    true[1, 1] = np.nan
    valid = np.ones((2, 4), bool)
    valid[1, 2] = False
    image = colorize_error(depth_error(torch.from_numpy(rendered), true, valid), limit=2.0)
    np.testing.assert_array_equal(image[0], table[[0, 180, 255, 255]])  # square roots: 0.71 of the scale at half of it
    np.testing.assert_array_equal(image[1, 0], table[255])  # nothing rendered where there is a truth
    np.testing.assert_array_equal(image[1, 1:3], hatch(2, 4)[1, 1:3])
    np.testing.assert_array_equal(image[1, 3], table[0])
    error = depth_error(np.array([[1.0, np.nan, np.inf]]), np.array([[np.nan, 2.0, 2.0]]))
    np.testing.assert_array_equal(error, [[np.nan, np.inf, np.inf]])


def test_rgb_error_image():
    table = color_table("error")
    true = np.zeros((1, 3, 3), np.uint8)
    rendered = true.copy()
    rendered[0, 1] = (51, 0, 0)  # a mean of 17 levels: one third of 0.2
    rendered[0, 2] = 255
    expected = table[[0, round(255 / math.sqrt(3)), 255]]

    def image(*arguments):
        return colorize_error(rgb_error(*arguments), limit=0.2)[0]

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
def test_depth_limits_follow_the_unit_and_leave_out_what_is_far_off(unit):
    depth = np.linspace(10.0, 50.0, 1001).reshape(7, 143)
    far = depth.copy()
    far[0, :3], far[3, :3] = 1e6, 1e-6
    far[1, :4] = np.nan, np.inf, 0.0, -7.0
    # Percentiles of 10.4 and 49.6; two digits, outwards.
    expected = (pytest.approx(unit * 10.0), pytest.approx(unit * 50.0))
    assert depth_limits([unit * depth, torch.from_numpy(unit * far)]) == expected
    low, high = depth_limits([np.full((2, 2), unit * 4.15)])
    assert (low, high) == (pytest.approx(unit * 4.1), pytest.approx(unit * 4.2))
    low, high = depth_limits([np.full((2, 2), unit * 4.0)])
    assert low <= unit * 4.0 * (1 + 1e-9) and low < high <= unit * 4.2
    assert depth_limits([np.full((2, 2), np.nan)]) == (1.0, 10.0)


def test_a_scale_of_depth_is_logarithmic_and_names_its_limits():
    assert scale_ticks((10.0, 1000.0), "depth") == [(value, pytest.approx(math.log10(value) / 2 - 0.5)) for value in
                                                    (10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0)]  # fmt: skip
    assert [tick for tick, _ in scale_ticks((12.0, 85.0), "depth")] == [12.0, 20.0, 40.0, 60.0, 85.0]
    assert scale_ticks((0.0, 2.0), "error") == [(pytest.approx(tick), pytest.approx(math.sqrt(tick / 2.0))) for tick in
                                                (0.0, 0.1, 0.4, 1.0, 2.0)]  # fmt: skip
    assert depth_scale_text((12.0, 85.0), "mm") == "12 to 85 mm, logarithmic"


# Image files


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


# Videos


def ramp(count, height, width):
    """Frames of one colour each; the red channel counts."""
    return [np.full((height, width, 3), (20 * index, 80, 30), np.uint8) for index in range(count)]


def read_back(path):
    with av.open(f"file:{path}") as file:
        frames = [frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)]
        return float(file.streams.video[0].average_rate), frames


@pytest.mark.parametrize("size", [(48, 64), (47, 63)])
def test_frames_come_back_in_order_and_color_and_odd_sizes_lose_no_line(tmp_path, size):
    frames = ramp(9, *size)
    write_video(map(torch.from_numpy, frames), tmp_path / "run 12:30" / "v.mp4", fps=12.5)
    fps, decoded = read_back(tmp_path / "run 12:30" / "v.mp4")
    assert fps == pytest.approx(12.5, rel=1e-3)
    assert len(decoded) == 9
    for wrote, read in zip(frames, decoded, strict=True):
        assert read.shape == (48, 64, 3)
        assert np.abs(wrote[0, 0].astype(float) - read).mean() < 6
        assert np.abs(read[-1].astype(float) - read[20]).mean() < 6
    assert [file.name for file in (tmp_path / "run 12:30").iterdir()] == ["v.mp4"]


def test_an_existing_video_stays_when_frames_fail(tmp_path):
    path = tmp_path / "v.mp4"
    write_video(ramp(2, 48, 64), path, fps=10)
    before = path.read_bytes()

    def failing():
        yield from ramp(2, 48, 64)
        raise RuntimeError("renderer")

    with pytest.raises(RuntimeError, match="renderer"):
        write_video(failing(), path, fps=10)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_refusals_of_videos(tmp_path, monkeypatch):
    frames = ramp(2, 48, 64)
    cases = [
        ("v.avi", frames, 10, "ends in .mp4"),
        ("v.mp4", frames, 0, "frames a second"),
        ("v.mp4", [], 10, "no frames"),
        ("v.mp4", [frames[0], frames[1][:40]], 10, "frame 1 is 64 x 40 px"),
        ("v.mp4", [frames[0] / 255.0], 10, "frame 0 is float64"),
    ]
    for name, images, fps, message in cases:
        with pytest.raises(InputError, match=message):
            write_video(images, tmp_path / name, fps)
    monkeypatch.setattr(video, "_CODEC", "none")
    with pytest.raises(InputError, match="PNG"):
        write_video(frames, tmp_path / "v.mp4", fps=10)
    assert not list(tmp_path.iterdir())
