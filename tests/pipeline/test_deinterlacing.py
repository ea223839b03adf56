"""Interlaced videos: recognised, and read as frames of one moment each."""

from __future__ import annotations

import json
import logging
from itertools import pairwise

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import coliags_plugin as cp
from coliags_plugin.core.images import read_rgb
from coliags_plugin.pipeline.frame_selection import corner_motion, looks_interlaced, one_field, reduced
from coliags_plugin.pipeline.frame_sources import chosen_frames, frame_source, image_files
from coliags_plugin.pipeline.frames import write_frames
from coliags_plugin.pipeline.settings import FrameSettings
from coliags_plugin.pipeline.survey import survey_video
from coliags_plugin.reporting.video import write_video
from tests.pipeline.films import WIDTH, film, write_images

RNG = np.random.default_rng(0)
#: Fields, at twice the rate of the frames.
FIELDS = film([150 - abs(6 * index % 300 - 150) for index in range(120)])


def woven(fields):
    """Every two fields as one frame: its even rows from the first, its odd rows from the second."""
    frames = [first.copy() for first in fields[::2]]
    for frame, second in zip(frames, fields[1::2], strict=True):
        frame[1::2] = second[1::2]
    return frames


INTERLACED = woven(FIELDS)


@given(arrays(np.uint8, st.tuples(st.integers(2, 9), st.integers(1, 4), st.just(3))))
def test_one_field_is_interpolated_along_columns(image):
    rows = np.arange(len(image))
    expected = np.apply_along_axis(lambda column: np.interp(rows, rows[::2], column[::2]), 0, image)
    np.testing.assert_array_equal(one_field(image), np.floor(expected + 0.5))


@pytest.mark.thorough
def test_it_is_nearer_to_the_frame_of_its_first_moment_and_is_followed_as_that_is():
    """On a camera that shakes: where its motion is even, combs move along with it and are followed, to wrong places."""
    places = np.clip(80 + np.cumsum(RNG.integers(-8, 9, 120)), 0, 159)
    fields = film(places)
    true, interlaced = fields[::2], woven(fields)
    mended = [one_field(frame) for frame in interlaced]

    def error(frames):
        return np.mean([np.abs(one.astype(float) - other).mean() for one, other in zip(frames, true, strict=True)])

    def followed(frames):
        """Error of the motion, pixels, and survival of corners."""
        found = np.array([corner_motion(*pair) for pair in pairwise(map(reduced, frames))])
        return np.median(np.abs(found[:, 0] * WIDTH - np.abs(np.diff(places[::2])))), found[:, 1].mean()

    assert error(mended) < 0.2 * error(interlaced)
    (bad, few), (good, many), (_, all_of_them) = map(followed, (interlaced, mended, true))
    assert bad > 0.5 and good < 0.05
    assert few < 0.85 * many and many > 0.95 * all_of_them


def test_which_videos_look_interlaced():
    noise = [np.clip(128 + RNG.normal(0, 20, (120, 160, 3)), 0, 255).astype(np.uint8) for _ in range(20)]
    sharpened = [cv2.addWeighted(one, 3.0, cv2.GaussianBlur(one, (0, 0), 0.8), -2.0, 0.0) for one in noise]
    waiting = [np.zeros_like(FIELDS[0])] * 900 + [FIELDS[0]] * 900
    assert looks_interlaced(INTERLACED)
    assert looks_interlaced([*waiting, *INTERLACED]), "whatever rests at the beginning"
    assert looks_interlaced([*FIELDS[:50], *INTERLACED]), "a camera that is still at first"
    assert looks_interlaced([np.clip(one + RNG.normal(0, 8, one.shape), 0, 255).astype(np.uint8) for one in INTERLACED])
    for progressive in (FIELDS, noise, sharpened, waiting, [*FIELDS[:50], INTERLACED[0]], []):
        assert not looks_interlaced(progressive)


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["video", "images"])
def test_it_is_read_so_where_it_looks_so_and_all_else_is_as_it_is(tmp_path, kind, caplog):
    def source(name, frames, **options):
        if kind == "images":
            path = write_images(tmp_path / name, frames)
        else:
            path = tmp_path / f"{name}.mp4"
            write_video(frames, path, 25.0)
        plain = [image for _, image in frame_source(path)]
        with caplog.at_level(logging.INFO):
            return plain, chosen_frames(path, FrameSettings(**options))

    plain, read = source("interlaced", INTERLACED)
    assert read.span.deinterlace and "one field is kept" in caplog.text
    assert all(np.array_equal(image, one_field(one)) for one, (_, image) in zip(plain, read, strict=True))
    for name, frames, options in (("progressive", FIELDS[::2], {}), ("as-it-is", INTERLACED, {"deinterlace": False})):
        plain, read = source(name, frames, **options)
        assert not read.span.deinterlace
        assert all(np.array_equal(image, one) for one, (_, image) in zip(plain, read, strict=True))
    plain, read = source("forced", FIELDS[:4], deinterlace=True, first=2)
    assert [np.array_equal(image, one_field(one)) for one, (_, image) in zip(plain[2:], read, strict=True)] == [
        True
    ] * 2


def test_frames_are_written_so_and_the_record_says_it(tmp_path):
    video = tmp_path / "film.mp4"
    write_video(INTERLACED, video, 25.0)
    source = chosen_frames(video, FrameSettings())
    summary = write_frames(source, survey_video(source), tmp_path / "frames", FrameSettings(least_motion=0.0))
    assert summary.startswith("60 of 60 frames, 160 x 120 px, deinterlaced")
    assert json.loads((tmp_path / "frames" / "frames.json").read_text())["deinterlaced"]
    with image_files(video) as files:
        for (name, image), file in zip(source, files, strict=True):
            for written in (tmp_path / "frames" / "images" / f"{name}.png", file):
                np.testing.assert_array_equal(read_rgb(written), image)


@pytest.mark.thorough
def test_a_procedure_decides_once(tmp_path, done, workers):
    """Of which the last segment would not look interlaced by itself."""
    file = tmp_path / "long.mp4"
    write_video([*INTERLACED, *FIELDS[:120]], file, 25.0)
    executor = workers()
    options = {"frames.segment": 100, "frames.least_motion": 0.0, "frames.least_sharpness": 0.0}
    known = {"sfm.camera.model": "PINHOLE", "sfm.camera.params": (100.0, 100.0, 80.0, 60.0)}
    made = cp.reconstruct(file, tmp_path / "out", settings={**options, **known})
    video = made.stages["survey"].figures
    assert video["deinterlace"] and len(video["segments"]) >= 2
    tasks = [json.loads(task.settings)["frames"]["deinterlace"] for task in executor.tasks]
    assert tasks and all(tasks)
    last = tmp_path / "out" / video["segments"][-1]["name"] / "frames" / "images" / "frame_000179.png"
    frames = [image for _, image in frame_source(file)]
    np.testing.assert_array_equal(read_rgb(last), one_field(frames[179]))
    assert "180 frames, 7.2 s, 160 x 120 px, deinterlaced" in (tmp_path / "out" / "index.html").read_text()
