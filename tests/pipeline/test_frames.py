"""Frames written for a reconstruction."""

from __future__ import annotations

import json
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import read_alpha, read_rgb, write_image, write_mask
from coliags_plugin.pipeline.frame_selection import corner_motion, reduced
from coliags_plugin.pipeline.frame_sources import frame_source
from coliags_plugin.pipeline.frames import read_blurred, read_lens_mask, write_frames
from coliags_plugin.pipeline.settings import FrameSettings
from coliags_plugin.pipeline.survey import FrameSurvey, survey_video
from tests.pipeline.films import HEIGHT, WIDTH, blurred, film, write_images

FILM = film(range(0, 120, 6))


def write(source, out, settings, mask=None):
    return write_frames(source, survey_video(source), out, settings, mask)


def test_frames_are_written_without_loss_and_what_is_dropped_is_recorded(tmp_path):
    frames = [*FILM[:5], blurred(FILM[5]), *FILM[6:10], FILM[9], FILM[9], np.zeros_like(FILM[0]), *FILM[10:]]
    out = tmp_path / "frames"
    summary = write(frame_source(write_images(tmp_path / "film", frames)), out, FrameSettings())
    dropped = {10: "the camera rests", 11: "the camera rests", 12: "black or without any texture"}
    record = json.loads((out / "frames.json").read_text())
    assert {each["frame"]: each["why"] for each in record["dropped"]} == dropped
    kept = [index for index in range(len(frames)) if index not in dropped]
    assert [each["frame"] for each in record["kept"]] == kept
    assert read_blurred(out) == {"5"}
    assert sorted(path.name for path in (out / "images").iterdir()) == sorted(f"{index}.png" for index in kept)
    for index in kept:
        np.testing.assert_array_equal(read_rgb(out / "images" / f"{index}.png"), frames[index])
    assert summary.startswith(f"20 of 23 frames, {WIDTH} x {HEIGHT} px; 1 blurred, of use for poses alone, 1 black")
    assert read_lens_mask(out) is None


def test_a_slow_camera_does_not_rest(tmp_path):
    """Motion counts from the last frame kept, so that slow motion adds up."""
    frames = film([place // 3 for place in range(60)])
    write(frame_source(write_images(tmp_path / "film", frames)), tmp_path / "out", FrameSettings())
    kept = json.loads((tmp_path / "out" / "frames.json").read_text())["kept"]
    assert [each["frame"] for each in kept] == list(range(0, 60, 3))


def test_the_mask_is_found_or_given(tmp_path):
    ring = np.ones((HEIGHT, WIDTH), bool)
    ring[:, :20] = False
    frames = [np.where(ring[..., None], frame, 0).astype(np.uint8) for frame in FILM]
    source = frame_source(write_images(tmp_path / "film", frames))
    summary = write(source, tmp_path / "found", FrameSettings(least_motion=0.0))
    assert summary.endswith("% of the image masked")
    mask = read_lens_mask(tmp_path / "found")
    assert not mask[:, :20].any()
    assert mask[:, 24:].all()
    ring[:30] = False
    write_mask(tmp_path / "mask.png", ring)
    write(source, tmp_path / "given", FrameSettings(), tmp_path / "mask.png")
    np.testing.assert_array_equal(read_lens_mask(tmp_path / "given"), ring)
    write_mask(tmp_path / "small.png", ring[:50])
    with pytest.raises(InputError, match=r"small.png is 160 x 50, the frames 160 x 120"):
        write(source, tmp_path / "no", FrameSettings(), tmp_path / "small.png")
    assert not (tmp_path / "no").exists()


def test_frames_keep_the_alpha_channel_of_their_images(tmp_path):
    alpha = np.full((HEIGHT, WIDTH), 255, np.uint8)
    alpha[:, :30] = 0
    source = frame_source(write_images(tmp_path / "film", [np.dstack([frame, alpha]) for frame in FILM]))
    write(source, tmp_path / "out", FrameSettings())
    for index in range(len(FILM)):
        path = tmp_path / f"out/images/{index}.png"
        np.testing.assert_array_equal(read_rgb(path), FILM[index])
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
        write(frame_source(write_images(tmp_path / "film", frames)), tmp_path / "out", FrameSettings())
    assert not (tmp_path / "out").exists()


def surveyed(frames):
    survey = FrameSurvey(Path("film"))
    for frame in frames:
        survey.add(frame)
    return survey


def test_overlays_are_found():
    labelled = [frame.copy() for frame in FILM]
    for frame in labelled:
        frame[80:100, 20:70] = (250, 250, 250)
    mask = surveyed(labelled).mask()
    assert not mask[80:100, 20:70].any() and mask[:70].all()
    assert surveyed(labelled[:9]).mask() is None
    assert surveyed(FILM).mask() is None
    assert surveyed([*labelled, FILM[0][:50]]).mask() is None


@pytest.mark.thorough
def test_memory_of_large_frames():
    """Extremes and sum, and what finding the mask takes besides: 0.5 GB of frames of 3840 x 2160."""
    frames = [np.kron(frame, np.ones((9, 9, 1), np.uint8)) for frame in FILM[:10]]
    for frame in frames:
        frame[720:900, 180:630] = 250
    tracemalloc.start()
    assert surveyed(frames).mask() is not None
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 62 * frames[0].size / 3


def test_what_is_masked_does_not_rest():
    one, two = (reduced(frame) for frame in FILM[:2])
    two[:80] = one[:80]
    mask = np.zeros(one.shape, bool)
    mask[80:] = True
    assert corner_motion(one, two)[0] == pytest.approx(0.0, abs=1e-4)
    assert corner_motion(one, two, mask)[0] == pytest.approx(6 / WIDTH, rel=0.02)
