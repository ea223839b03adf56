"""Frames of video files and folders."""

from __future__ import annotations

import logging
from types import SimpleNamespace

import numpy as np
import pytest

from coliags_plugin.cli.reconstruct import every_of, seconds_of
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import write_image
from coliags_plugin.pipeline.frame_sources import Span, frame_source
from coliags_plugin.reporting.video import write_video
from tests.pipeline.films import film, write_film, write_images


def test_frames_are_read_in_order(tmp_path):
    frames = film(range(0, 72, 6))
    write_video(frames, tmp_path / "film.mp4", 15.0)
    for path, names in (
        (tmp_path / "film.mp4", [f"frame_{index:06d}" for index in range(12)]),
        (write_images(tmp_path / "images", frames), [str(index) for index in range(12)]),
    ):
        source = frame_source(path)
        assert source.expected == len(frames)
        for _ in range(2):
            read = list(source)
            assert [name for name, _ in read] == names
            for (_, image), frame in zip(read, frames, strict=True):
                # Videos are lossy; red and blue are not swapped.
                np.testing.assert_allclose(image.mean(axis=(0, 1)), frame.mean(axis=(0, 1)), atol=5.0)
                assert np.mean(np.abs(image.astype(float) - frame)) < (10.0 if path.suffix else 1e-9)


def test_what_cannot_be_read_is_refused(tmp_path):
    frames = film([0, 5])
    (tmp_path / "noise.mp4").write_bytes(np.random.default_rng(0).bytes(5000))
    write_image(tmp_path / "one.png", frames[0])
    (tmp_path / "empty").mkdir()
    write_images(tmp_path / "two", [frames[0], frames[1][:100]])
    write_video(film(range(0, 30, 3)), tmp_path / "film.mp4", 15.0)
    for name, first, message in (
        ("noise.mp4", 0, r"noise.mp4 \(5000 bytes\) cannot be opened as a video.*Make images with ffmpeg"),
        ("one.png", 0, "is a single image"),
        ("missing.mp4", 0, "no .*missing.mp4. Expected a video file, or a folder of images"),
        ("empty", 0, "empty holds 0 images"),
        ("two", 0, r"1.png is 160 x 100 at 1, what is before 160 x 120. Expected frames of one size"),
        ("film.mp4", 50, r"film.mp4 has no frame 50. Expected one of about 10 frames"),
    ):
        with pytest.raises(InputError, match=message):
            list(frame_source(tmp_path / name, Span(first)))


@pytest.mark.parametrize("name", ["film.mp4", "images"])
def test_some_frames_are_those_of_the_whole(tmp_path, name):
    frames = film(range(0, 120, 3))
    if name == "images":
        write_images(tmp_path / name, frames)
    else:
        write_video(frames, tmp_path / name, 15.0)
    whole = list(frame_source(tmp_path / name))
    for first, last in ((0, 5), (1, 1), (17, 30), (38, 99), (5, None)):
        source = frame_source(tmp_path / name, Span(first, last))
        some, stop = list(source), len(whole) if last is None else last + 1
        assert [name for name, _ in some] == [name for name, _ in whole[first:stop]]
        assert all(np.array_equal(one, other) for (_, one), (_, other) in zip(some, whole[first:stop], strict=True))
        assert source.expected == len(some)


def test_times_are_frames(tmp_path):
    write_video(film(range(0, 30, 3)), tmp_path / "film.mp4", 15.0)
    source = frame_source(tmp_path / "film.mp4")
    assert source.rate == pytest.approx(15.0)
    for text, frame in (("0", 0), ("3:20", 3000), ("1:00:00.2", 54003), ("0.4", 6)):
        assert source.frame_at(seconds_of(text)) == frame
    for text in ("", "3:x", "-1", "1:2:3:4"):
        with pytest.raises(InputError, match="seconds, or hours, minutes and seconds"):
            seconds_of(text)
    with pytest.raises(InputError, match=r"does not tell how many frames a second.*frames.first"):
        frame_source(write_images(tmp_path / "images", film([0, 5]))).frame_at(200.0)


@pytest.mark.parametrize(
    ("rate", "wanted", "every"), [(50.0, 10.0, 5), (60.0, 24.0, 2), (59.94, 15.0, 4), (15.0, 30.0, 1), (15.0, 0.5, 30)]
)
def test_of_how_many_frames_one_is_used(rate, wanted, every, caplog):
    with caplog.at_level(logging.INFO):
        assert every_of(SimpleNamespace(path="film.mp4", known_rate=rate, is_variable=False), wanted) == every
    assert f"{rate:.4g} frames a second" in caplog.text and f"every {every} is used" in caplog.text


@pytest.mark.thorough
def test_a_damaged_stretch_is_black_and_the_rest_is_read(tmp_path, caplog):
    generator = np.random.default_rng(0)
    images = [
        np.clip(image + generator.normal(0, 12, image.shape), 0, 255).astype(np.uint8) for image in film(range(150))
    ]
    write_video(images, tmp_path / "film.mp4", 15.0)
    whole = list(frame_source(tmp_path / "film.mp4"))
    data = bytearray((tmp_path / "film.mp4").read_bytes())
    data[len(data) // 3 : len(data) // 2] = generator.bytes(len(data) // 2 - len(data) // 3)
    (tmp_path / "damaged.mp4").write_bytes(data)
    read = list(frame_source(tmp_path / "damaged.mp4"))
    assert [name for name, _ in read] == [name for name, _ in whole]
    black = [index for index, (_, image) in enumerate(read) if not image.any()]
    assert 10 < len(black) < 100 and "cannot be decoded: black here" in caplog.text
    assert all(np.array_equal(read[index][1], whole[index][1]) for index in (0, 20, 149))
    for first in (0, black[0] - 2, *black[:2], black[-1] - 1, black[-1], black[-1] + 1, 140):
        for last in (first, first + 3, black[-1], black[-1] + 2):
            if first <= last:
                some = list(frame_source(tmp_path / "damaged.mp4", Span(first, last)))
                assert [name for name, _ in some] == [name for name, _ in read[first : last + 1]]
                assert all(np.array_equal(one, read[first + n][1]) for n, (_, one) in enumerate(some))


def test_sound_is_left_out(tmp_path):
    frames = film(range(0, 60, 3))
    options = {"codec": "mjpeg", "rate": 20, "pix_fmt": "yuvj420p"}
    silent, loud = (write_film(frames, tmp_path / f"{sound}.avi", sound=sound, **options) for sound in (False, True))
    assert loud.stat().st_size > silent.stat().st_size + 20 * 400
    source = frame_source(loud)
    assert source.expected == 20 and source.rate == pytest.approx(20.0)
    for span in (Span(), Span(7, 12)):
        pairs = list(zip(frame_source(silent, span), frame_source(loud, span), strict=True))
        assert len(pairs) == (20 if span == Span() else 6)
        assert all(one[0] == other[0] and np.array_equal(one[1], other[1]) for one, other in pairs)


def test_the_videos_of_a_folder_are_one(tmp_path):
    for name, places in (("part 2.mp4", range(30, 60)), ("part 10.mp4", range(60, 80)), ("part 1.mp4", range(30))):
        write_video(film(places), tmp_path / "parts" / name, 15.0)
    parts = [image for n in (1, 2, 10) for _, image in frame_source(tmp_path / "parts" / f"part {n}.mp4")]
    source = frame_source(tmp_path / "parts")
    assert source.expected == 80 and source.rate == pytest.approx(15.0)
    whole = list(source)
    assert [name for name, _ in whole] == [f"frame_{number:06d}" for number in range(80)]
    assert all(np.array_equal(image, part) for (_, image), part in zip(whole, parts, strict=True))
    for first, last in ((0, 10), (25, 64), (31, 31), (70, None)):
        some = list(frame_source(tmp_path / "parts", Span(first, last)))
        expected = whole[first : None if last is None else last + 1]
        assert [name for name, _ in some] == [name for name, _ in expected]
        assert all(np.array_equal(one, other) for (_, one), (_, other) in zip(some, expected, strict=True))
    write_video([image[:100] for image in film([0, 5])], tmp_path / "parts" / "part 11.mp4", 15.0)
    with pytest.raises(InputError, match=r"part 11.mp4 is 160 x 100 at frame_000080, what is before 160 x 120"):
        list(frame_source(tmp_path / "parts"))
