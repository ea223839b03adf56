"""Seen masks: read for a run whose training frames they tell of, and for no other."""

from __future__ import annotations

import logging
import shutil
from pathlib import Path

import pytest

from coliags_plugin.config.registry import datamanagers
from coliags_plugin.core.scenes import Frame, Scene
from coliags_plugin.datamanagers.recognition import find_format
from tests.phantom.phantom_layouts import write_phantom

#: Layouts with rotation views, and the split whose training frames their masks tell of.
SPLITS = {
    "c3vd": "every-8th",
    "c3vd-raw": "every-8th",
    "c3vd-v2": "every-8th",
    "endogslam": "endogslam",
    "rotatecolon": "all-train",
}
#: Layouts without.
OTHERS = ("pr-endo", "colmap", "nerfstudio", "rgbd", "endomapper", "reim-nerf")
COARSE = {"mesh_spacing": 3.0, "texture_spacing": 1.0, "path_length": 20.0}


def load(folder: Path, **options) -> Scene:
    manager = datamanagers.get(find_format(folder))
    return manager(manager.Settings(initial_points="none", **options)).load(folder)


def apart(scene: Scene) -> list[Frame]:
    """Frames of the video that are held out, and rotation views."""
    return [frame for frames in scene.test_sets.values() for frame in frames]


def warnings(caplog) -> list[str]:
    return [record.getMessage() for record in caplog.records if "seen masks" in record.getMessage()]


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Phantoms of nine frames, by layout, made when asked for."""
    made: dict[str, Path] = {}

    def folder(layout: str) -> Path:
        if layout not in made:
            made[layout] = write_phantom(tmp_path_factory.mktemp("seen") / layout, layout, 48, 38, **COARSE)
        return made[layout] / ("C3VD/phantom" if layout == "pr-endo" else ".")

    return folder


@pytest.mark.parametrize("layout", [*SPLITS, *OTHERS])
def test_masks_are_read_with_the_default_split(folders, layout, caplog):
    scene = load(folders(layout))
    frames = apart(scene)
    assert frames and all(frame.seen is not None and frame.seen.any() for frame in frames)
    assert all(frame.seen is None for frame in scene.train)
    assert (len(frames) > len(scene.test_sets["test"])) == (layout in SPLITS and layout != "rotatecolon")
    assert not warnings(caplog)


@pytest.mark.parametrize(
    "options", [{"max_frames": 6}, {"frame_step": 2}, {"split": "block"}], ids=["max_frames", "frame_step", "block"]
)
@pytest.mark.parametrize("layout", SPLITS)
def test_masks_are_left_out_where_other_frames_are_trained_on(folders, layout, options, caplog):
    folder = folders(layout)
    scene = load(folder, **options)
    turned = scene.test_sets.get("rotation") or scene.test_sets["test"]
    assert len(turned) == 2
    assert all(frame.seen is None for frame in (*scene.train, *apart(scene)))
    assert warnings(caplog) == [
        f"{folder}: seen masks are for split '{SPLITS[layout]}' of all frames; this run trains on other frames, so "
        "metrics on seen pixels are unavailable"
    ]


@pytest.mark.parametrize(
    ("layout", "options"),
    [
        # Frame 8, the last, is tested on: without it training is the same.
        ("c3vd", {"max_frames": 8}),
        ("c3vd", {"max_frames": 9}),
        ("rotatecolon", {"max_frames": 100}),
        ("rotatecolon", {"split": "own"}),
        # Frame 7 alone.
        ("endogslam", {"split": "block", "block": (7 / 9, 8 / 9)}),
    ],
)
def test_other_options_with_the_same_training_frames_are_as_good(folders, layout, options, caplog):
    frames = apart(load(folders(layout), **options))
    assert all(frame.seen is not None for frame in frames)
    assert not warnings(caplog)


def test_a_scene_without_masks_says_nothing_of_them(folders, tmp_path, caplog):
    folder = Path(shutil.copytree(folders("c3vd"), tmp_path / "colon"))
    for place in ("truth/seen", "rotation/seen"):
        shutil.rmtree(folder / place)
    for options in ({}, {"frame_step": 2}):
        assert all(frame.seen is None for frame in apart(load(folder, **options)))
    assert not warnings(caplog)


def test_nothing_is_left_out_where_nothing_is_tested(folders, caplog):
    scene = load(folders("colmap"), split="all-train")
    assert scene.test_sets == {} and len(scene.train) == 9
    assert not warnings(caplog)


@pytest.mark.parametrize(
    ("layout", "images"), [("colmap", "images"), ("nerfstudio", "images"), ("rotatecolon", "train_views")]
)
def test_images_without_a_pose_put_masks_out_of_step(folders, tmp_path, layout, images, caplog):
    folder = Path(shutil.copytree(folders(layout), tmp_path / "colon"))
    first = min((folder / images).iterdir())
    shutil.copy(first, first.with_name("0099.png"))
    with caplog.at_level(logging.WARNING):
        assert all(frame.seen is None for frame in apart(load(folder)))
    assert len(warnings(caplog)) == 1 and "are for all images, but some are left out" in caplog.text
