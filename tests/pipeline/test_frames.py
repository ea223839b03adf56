"""Frames of use: sharpness, motion, masks of lens and overlays, deinterlacing, and what is written of them."""

from __future__ import annotations

import json
import logging
import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import coliags_plugin as cp
from coliags_plugin.core.arrays import dilated
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import read_alpha, read_rgb, write_image, write_mask
from coliags_plugin.pipeline.frame_sources import (
    chosen_frames,
    frame_source,
    image_files,
    looks_interlaced,
    one_field,
)
from coliags_plugin.pipeline.frames import (
    EMPTY,
    RESTING,
    THINNED,
    blurred_frames,
    read_blurred,
    read_lens_mask,
    sharpest_frames,
    write_frames,
)
from coliags_plugin.pipeline.settings import FrameSettings
from coliags_plugin.pipeline.survey import (
    FrameSurvey,
    corner_motion,
    lens_mask,
    overlays,
    reduced,
    survey_video,
)
from coliags_plugin.reconstruction.structure.point_tracks import sharpness
from coliags_plugin.reporting.video import write_video
from tests.pipeline.films import HEIGHT, KNOWN, WIDTH, blurred, film, write_images

RNG = np.random.default_rng(0)
FILM = film(range(0, 120, 6))
#: Fields of an interlaced video, at twice the rate of its frames.
FIELDS = film([150 - abs(6 * index % 300 - 150) for index in range(120)])


# Choice of frames


@pytest.mark.parametrize(
    ("settings", "times", "chosen"),
    [
        ({"every": 3}, None, [1, 3, 6]),
        ({"every": 2}, None, [1, 3, 5, 6]),
        ({"every": 2, "per_second": 2.0}, None, [1, 3, 5, 6]),
        ({"every": 2, "per_second": 2.0}, [0.0, 0.04, 0.08, 0.12, 1.0, 1.3, 1.7], [1, 5, 6]),
    ],
)
def test_the_sharpest_of_every_few_or_of_every_stretch_of_time_is_used(settings, times, chosen):
    values = [0.5, 0.9, 0.6, 0.8, 0.7, 0.75, 0.6]
    stamps = None if times is None else np.array(times)
    assert sharpest_frames(values, FrameSettings(**settings), stamps) == (
        chosen,
        dict.fromkeys(set(range(7)) - set(chosen), THINNED),
    )


def test_empty_frames_are_dropped_and_those_less_sharp_than_their_neighbours_are_blurred():
    values = [0.5] * 20
    values[4], values[5], values[9] = 0.1, 0.2, 0.0
    used, dropped = sharpest_frames(values, FrameSettings())
    assert dropped == {9: EMPTY} and used == [index for index in range(20) if index != 9]
    assert blurred_frames(used, values, FrameSettings()) == {4, 5}
    assert not blurred_frames(used, values, FrameSettings(least_sharpness=0.0))
    smooth_wall = blurred_frames(range(120), [1.0] * 60 + [0.2] * 60, FrameSettings())
    assert len(smooth_wall) < 12 and smooth_wall <= set(range(60, 70))


# Measures of frames


def test_sharpness_tells_blur_whatever_the_brightness_and_the_highlights():
    image = film([0])[0]
    values = [sharpness(reduced(image if sigma == 0 else blurred(image, sigma))) for sigma in (0, 1, 2, 4)]
    assert values == sorted(values, reverse=True) and values[-1] < 0.3 * values[0]
    assert sharpness(reduced(image) // 2) == pytest.approx(values[0], rel=0.03)
    assert sharpness(np.zeros((40, 60), np.uint8)) == sharpness(np.full((40, 60), 100, np.uint8)) == 0.0
    highlights = blurred(image)
    highlights[50:54, 60:66] = 255
    assert sharpness(reduced(highlights)) == pytest.approx(values[-1], rel=0.05)
    assert reduced(np.zeros((1080, 1350, 3), np.uint8)).shape == (384, 480)


def test_motion_is_the_shift_of_corners_unknown_in_another_scene_and_not_of_what_is_masked():
    for shift, lamp in ((0, 1.0), (1, 1.0), (3, 1.0), (8, 1.0), (2, 0.7)):
        before, after = (reduced(frame) for frame in film([20, 20 + shift]))
        motion = corner_motion(before, cv2.convertScaleAbs(after, alpha=lamp))[0]
        assert motion * WIDTH == pytest.approx(shift, abs=0.3)
    one, other = reduced(film([0])[0]), reduced(film([0], seed=1)[0])
    assert corner_motion(one, other)[0] > 0.02
    assert corner_motion(np.full((100, 100), 80, np.uint8), one[:100, :100])[0] == float("inf")
    one, two = (reduced(frame) for frame in FILM[:2])
    two[:80] = one[:80]
    mask = np.zeros(one.shape, bool)
    mask[80:] = True
    assert corner_motion(one, two)[0] == pytest.approx(0.0, abs=1e-4)
    assert corner_motion(one, two, mask)[0] == pytest.approx(6 / WIDTH, rel=0.02)


# Masks


def test_the_mask_of_a_round_lens():
    rows, columns = np.mgrid[:120, :160]
    inside = (rows - 60) ** 2 + (columns - 80) ** 2 < 58**2
    image = np.where(inside, 90, 5).astype(np.uint8)
    image[50:70, 70:90] = 3  # the lumen is dark, and no border
    mask = lens_mask(image)
    assert not mask[~inside].any()
    assert mask[(rows - 60) ** 2 + (columns - 80) ** 2 < 53**2].all()
    for level in (90, 2):  # that of a full image, and of a black video
        assert lens_mask(np.full((120, 160), level, np.uint8)) is None


def titled(image: np.ndarray) -> np.ndarray:
    written = image.copy()
    cv2.putText(written, "NAME 12:34", (10, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (250, 250, 250), 1, cv2.LINE_AA)
    written[90:110, 120:150] = (20, 120, 200)
    return written


def test_overlays_are_found_where_the_rest_moves():
    def found(frames):
        stack = np.stack(frames)
        return overlays(stack.min(axis=0), stack.max(axis=0), stack.mean(axis=0, dtype=np.float32))

    plain = film(range(0, 150, 5))
    written, marked = (titled(np.zeros_like(plain[0])) > 0).any(axis=2), found([titled(image) for image in plain])
    assert marked[written].all() and not marked[~dilated(written, 8)].any()
    assert not found(plain).any()
    assert not found([titled(film([0])[0])] * 9).any(), "the camera rests"
    assert not found([titled(image) for image in film([0, 1, 0, 1])]).any()


def surveyed(frames):
    survey = FrameSurvey(Path("film"))
    for frame in frames:
        survey.add(frame)
    return survey.mask()


def test_the_mask_of_a_video_is_of_ten_frames_of_one_size_or_more():
    labelled = [titled(frame) for frame in FILM]
    mask = surveyed(labelled)
    assert not mask[90:110, 120:150].any() and mask[30:85].all()
    assert surveyed(labelled[:9]) is surveyed(FILM) is surveyed([*labelled, FILM[0][:50]]) is None


@pytest.mark.thorough
def test_memory_of_large_frames():
    """Extremes and sum, and what finding the mask takes besides: 0.5 GB of frames of 3840 x 2160."""
    frames = [np.kron(frame, np.ones((9, 9, 1), np.uint8)) for frame in FILM[:10]]
    for frame in frames:
        frame[720:900, 180:630] = 250
    tracemalloc.start()
    assert surveyed(frames) is not None
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 62 * frames[0].size / 3


# Interlaced videos


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


def test_which_videos_look_interlaced():
    noise = [np.clip(128 + RNG.normal(0, 20, (120, 160, 3)), 0, 255).astype(np.uint8) for _ in range(20)]
    sharpened = [cv2.addWeighted(one, 3.0, cv2.GaussianBlur(one, (0, 0), 0.8), -2.0, 0.0) for one in noise]
    waiting = [np.zeros_like(FIELDS[0])] * 900 + [FIELDS[0]] * 900
    noisy = [np.clip(one + RNG.normal(0, 8, one.shape), 0, 255).astype(np.uint8) for one in INTERLACED]
    for interlaced in (INTERLACED, noisy, [*waiting, *INTERLACED], [*FIELDS[:50], *INTERLACED]):
        assert looks_interlaced(interlaced)
    for progressive in (FIELDS, noise, sharpened, waiting, [*FIELDS[:50], INTERLACED[0]], []):
        assert not looks_interlaced(progressive)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("frames", "options", "is_mended"),
    [
        (INTERLACED, {}, True),
        (FIELDS[::2], {}, False),
        (INTERLACED, {"deinterlace": False}, False),
        (FIELDS[:4], {"deinterlace": True, "first": 2}, True),
    ],
)
def test_it_is_read_so_where_it_looks_so_and_all_else_is_as_it_is(tmp_path, frames, options, is_mended, caplog):
    path = write_images(tmp_path, frames)
    with caplog.at_level(logging.INFO):
        read = chosen_frames(path, FrameSettings(**options))
    assert bool(read.span.deinterlace) is is_mended and ("one field is kept" in caplog.text) == (
        not options and is_mended
    )
    plain = [image for _, image in frame_source(path)][options.get("first", 0) :]
    for (_, image), stored in zip(read, plain, strict=True):
        np.testing.assert_array_equal(image, one_field(stored) if is_mended else stored)


@pytest.mark.thorough
def test_a_long_video_is_found_interlaced_once(tmp_path, calls, workers):
    """The last segment would not look interlaced by itself."""
    file = tmp_path / "long.mp4"
    write_video([*INTERLACED, *FIELDS[:120]], file, 25.0)
    executor = workers()
    options = {"frames.segment": 100, "frames.least_motion": 0.0, "frames.least_sharpness": 0.0}
    video = cp.reconstruct(file, tmp_path / "out", settings={**options, **KNOWN}).stages["survey"].figures
    assert video["deinterlace"] and len(video["segments"]) >= 2
    assert {json.loads(task.settings)["frames"]["deinterlace"] for task in executor.tasks} == {True}
    last = tmp_path / "out" / video["segments"][-1]["name"] / "frames" / "images" / "frame_000179.png"
    frames = [image for _, image in frame_source(file)]
    np.testing.assert_array_equal(read_rgb(last), one_field(frames[179]))
    assert "180 frames, 7.2 s, 160 x 120 px, deinterlaced" in (tmp_path / "out" / "index.html").read_text()


# Written frames


def write(source, out, settings=FrameSettings(), mask=None):  # noqa: B008
    return write_frames(source, survey_video(source), out, settings, mask)


def written(out):
    """Frames of use, and why others are dropped, as the record has them."""
    record = json.loads((out / "frames.json").read_text())
    return [each["frame"] for each in record["kept"]], {each["frame"]: each["why"] for each in record["dropped"]}


def test_frames_are_written_without_loss_and_what_is_dropped_is_recorded(tmp_path):
    frames = [*FILM[:5], blurred(FILM[5]), *FILM[6:10], FILM[9], FILM[9], np.zeros_like(FILM[0]), *FILM[10:]]
    out = tmp_path / "frames"
    summary = write(frame_source(write_images(tmp_path / "film", frames)), out)
    used, dropped = written(out)
    assert dropped == {10: RESTING, 11: RESTING, 12: EMPTY}
    assert used == [index for index in range(len(frames)) if index not in dropped]
    assert read_blurred(out) == {"5"} and read_lens_mask(out) is None
    assert sorted(path.name for path in (out / "images").iterdir()) == sorted(f"{index}.png" for index in used)
    for index in used:
        np.testing.assert_array_equal(read_rgb(out / "images" / f"{index}.png"), frames[index])
    assert summary.startswith(f"20 of 23 frames, {WIDTH} x {HEIGHT} px; 1 blurred, of use for poses alone, 1 black")


def test_a_slow_camera_does_not_rest(tmp_path):
    """Motion counts from the last frame kept, so that slow motion adds up."""
    frames = film([place // 3 for place in range(60)])
    write(frame_source(write_images(tmp_path / "film", frames)), tmp_path / "out")
    assert written(tmp_path / "out")[0] == list(range(0, 60, 3))


def test_interlaced_frames_are_written_mended_and_the_record_says_it(tmp_path):
    video = tmp_path / "film.mp4"
    write_video(INTERLACED, video, 25.0)
    source = chosen_frames(video, FrameSettings())
    summary = write(source, tmp_path / "frames", FrameSettings(least_motion=0.0))
    assert summary.startswith("60 of 60 frames, 160 x 120 px, deinterlaced")
    with image_files(video) as files:
        for (name, image), file in zip(source, files, strict=True):
            for path in (tmp_path / "frames" / "images" / f"{name}.png", file):
                np.testing.assert_array_equal(read_rgb(path), image)


def test_the_mask_is_found_or_given(tmp_path):
    ring = np.ones((HEIGHT, WIDTH), bool)
    ring[:, :20] = False
    frames = [np.where(ring[..., None], frame, 0).astype(np.uint8) for frame in FILM]
    source = frame_source(write_images(tmp_path / "film", frames))
    assert write(source, tmp_path / "found", FrameSettings(least_motion=0.0)).endswith("% of the image masked")
    mask = read_lens_mask(tmp_path / "found")
    assert not mask[:, :20].any() and mask[:, 24:].all()
    ring[:30] = False
    write_mask(tmp_path / "mask.png", ring)
    write(source, tmp_path / "given", mask=tmp_path / "mask.png")
    np.testing.assert_array_equal(read_lens_mask(tmp_path / "given"), ring)
    write_mask(tmp_path / "small.png", ring[:50])
    with pytest.raises(InputError, match=r"small.png is 160 x 50, the frames 160 x 120"):
        write(source, tmp_path / "no", mask=tmp_path / "small.png")
    assert not (tmp_path / "no").exists()


def test_frames_keep_the_alpha_channel_of_their_images(tmp_path):
    alpha = np.full((HEIGHT, WIDTH), 255, np.uint8)
    alpha[:, :30] = 0
    write(
        frame_source(write_images(tmp_path / "film", [np.dstack([frame, alpha]) for frame in FILM])), tmp_path / "out"
    )
    for index, frame in enumerate(FILM):
        path = tmp_path / f"out/images/{index}.png"
        np.testing.assert_array_equal(read_rgb(path), frame)
        np.testing.assert_array_equal(read_alpha(path), alpha > 0)


def test_images_of_12_bits_in_16_are_refused(tmp_path):
    for index, frame in enumerate(FILM[:4]):
        write_image(tmp_path / f"{index}.png", frame.astype(np.uint16) * 16)
    with pytest.raises(InputError, match=r"no pixel of the 4 frames of .* is brighter than 14 of 255.*by 16"):
        survey_video(frame_source(tmp_path))


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        (FILM[:2], "2 of 2 frames .* it has no more. Expected at least 4"),
        ([FILM[0]] * 9, "1 of 9 frames .* 8 the camera rests"),
        ([np.full_like(FILM[0], 70)] * 9, "0 of 9 frames .* 9 black or without any texture"),
    ],
)
def test_too_few_frames_of_use_are_refused(tmp_path, frames, message):
    with pytest.raises(InputError, match=message):
        write(frame_source(write_images(tmp_path / "film", frames)), tmp_path / "out")
    assert not (tmp_path / "out").exists()
