"""Frames of video files and folders."""

from __future__ import annotations

import logging

import numpy as np
import pytest

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import write_image
from coliags_plugin.outputs.video import write_video
from coliags_plugin.pipeline.frame_sources import ImageFolder, VideoFile, frame_source
from tests.pipeline.films import film, write_images


def test_a_video_is_read_in_order(tmp_path):
    frames = film(range(0, 60, 10))
    write_video(frames, tmp_path / "film.mp4", 15.0)
    source = frame_source(tmp_path / "film.mp4")
    assert isinstance(source, VideoFile)
    assert source.expected == len(frames)
    for _ in range(2):
        read = list(source)
        assert [name for name, _ in read] == [f"frame_{index:06d}" for index in range(6)]
        for (_, image), frame in zip(read, frames, strict=True):
            # Lossy; red and blue are not swapped.
            np.testing.assert_allclose(image.mean(axis=(0, 1)), frame.mean(axis=(0, 1)), atol=5.0)
            assert np.mean(np.abs(image.astype(float) - frame)) < 10.0


def test_a_folder_is_read_in_natural_order(tmp_path):
    frames = film(range(0, 24, 2))
    source = frame_source(write_images(tmp_path, frames))
    assert isinstance(source, ImageFolder)
    assert source.expected == 12
    read = list(source)
    assert [name for name, _ in read] == [str(index) for index in range(12)]
    for (_, image), frame in zip(read, frames, strict=True):
        np.testing.assert_array_equal(image, frame)


def test_what_is_no_video_is_refused(tmp_path):
    (tmp_path / "noise.mp4").write_bytes(np.random.default_rng(0).bytes(5000))
    write_image(tmp_path / "one.png", film([0])[0])
    (tmp_path / "empty").mkdir()
    for name, message in (
        ("noise.mp4", r"noise.mp4 \(5000 bytes\) cannot be opened as a video.*Make images with ffmpeg"),
        ("one.png", "is a single image"),
        ("missing.mp4", "no .*missing.mp4. Expected a video file, or a folder of images"),
        ("empty", "empty holds 0 images"),
    ):
        with pytest.raises(InputError, match=message):
            frame_source(tmp_path / name)


def test_a_truncated_video_is_read_as_far_as_it_goes_or_refused(tmp_path, caplog):
    write_video(film(range(0, 160, 4)), tmp_path / "film.mp4", 15.0)
    whole = (tmp_path / "film.mp4").read_bytes()
    (tmp_path / "cut.mp4").write_bytes(whole[: len(whole) // 2])
    try:
        with caplog.at_level(logging.WARNING):
            count = len(list(frame_source(tmp_path / "cut.mp4")))
    except InputError as error:
        assert "cut.mp4" in str(error)
    else:
        assert 0 < count < 40
        assert "is it complete?" in caplog.text


def test_images_of_two_sizes_are_refused(tmp_path):
    frames = film([0, 5])
    write_images(tmp_path, [frames[0], frames[1][:100]])
    with pytest.raises(InputError, match=r"1.png is 160 x 100, 0.png 160 x 120. Expected frames of one size"):
        list(frame_source(tmp_path))
