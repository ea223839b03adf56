"""Particular to C3VD and C3VDv2: lenses, the octagon, depth, lens files; and options that all formats share."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.ply import point_properties, write_ply
from coliags_plugin.core.scene_files import read_unit, write_unit
from coliags_plugin.core.scenes import Scene
from coliags_plugin.core.splits import held_out, split_options
from coliags_plugin.datamanagers.c3vd import CANDIDATE_LENS, ORDER, C3VDSettings, read_camera_intrinsics
from coliags_plugin.geometry.lenses.models import LENSES
from tests.datamanagers.kinds import remove, repaint
from tests.datamanagers.wall_scenes import (
    colors,
    manager,
    names,
    worst_off_wall,
    write_wall,
)

KIND = "c3vd"
OMNIDIRECTIONAL = LENSES["omnidirectional"]


def load(folder: Path, name: str = "c3vd", **options) -> Scene:
    return manager(name, **options).load(folder)


# Lenses


@pytest.mark.parametrize("name", LENSES)
def test_undistorted_geometry_is_right_through_every_lens_and_no_other(tmp_path, name):
    folder = write_wall(tmp_path / "wall", "c3vd-raw", 2, 270, 216, lens=LENSES[name].resized(270, 216))
    scene = load(folder, width=90, height=72, lens=name)
    k, camera = LENSES[name].resized(90, 72).pinhole, scene.train[0].camera
    assert vars(camera.intrinsics) == pytest.approx(vars(k))
    assert worst_off_wall(scene.train[0]) < 0.2 and scene.provenance.lens == name
    points = scene.points.positions.double().numpy()
    assert np.abs(scene.points.colors.numpy().astype(int) - colors(points)).max() < 12
    other = "omnidirectional" if name == "legacy-pinhole" else "legacy-pinhole"
    assert worst_off_wall(load(folder, width=90, height=72, lens=other).train[0]) > 0.3


# C3VDv2's lens

#: As its file has it: pixel centres at integers.
CANDIDATE = {**vars(CANDIDATE_LENS), "cx": CANDIDATE_LENS.cx - 0.5, "cy": CANDIDATE_LENS.cy - 0.5, "a1": 0.0}


def as_text(form: str = "{} = {!r}", **changes: float) -> str:
    values = {**CANDIDATE, **changes}
    return "\n".join(form.format(name, values[name]) for name in ORDER)


@pytest.mark.parametrize(
    ("lens", "has_file", "source"),
    [
        ("file", False, "candidate calibration, unverified"),
        ("file", True, "camera_intrinsics.txt"),
        ("v2", True, "candidate calibration, unverified"),
        ("v1", True, "C3VD's omnidirectional calibration"),
    ],
)
def test_the_option_and_the_file_decide_on_the_lens(tmp_path, caplog, lens, has_file, source):
    used = OMNIDIRECTIONAL if lens == "v1" else CANDIDATE_LENS
    folder = write_wall(tmp_path / "c1/wall", "c3vd-v2", 3, 90, 72, lens=used.resized(90, 72))
    (folder / "camera_intrinsics.txt").unlink()
    if lens == "v2":
        (folder / "camera_intrinsics.txt").write_text("nobody knows")
    elif has_file:  # up to two folders up
        (tmp_path / "camera_intrinsics.txt").write_text(as_text())
    scene = load(folder, "c3vd-v2", lens=lens)
    assert worst_off_wall(scene.train[0]) < 0.5
    assert scene.provenance.lens_source.endswith(source)
    assert ("unverified" in caplog.text) == (not has_file)


@pytest.mark.parametrize(
    "text",
    [
        as_text(),
        as_text("{}: {!r}"),
        as_text("{}\t{!r}").upper(),
        "# calibration\n" + as_text() + "  # the last one",
        json.dumps({name: CANDIDATE[name] for name in ORDER}),
        "\n".join(line for line in as_text().splitlines() if line[:2] not in ("wi", "he", "a1", "c ", "d ", "e ")),
        as_text("{1!r}"),
        "\n".join(as_text("{1!r}").splitlines()[2:]),
    ],
    ids=["equals", "colons", "tabs", "comments", "json", "only what is needed", "twelve numbers", "ten numbers"],
)
def test_unmistakable_lens_files(tmp_path, text):
    (tmp_path / "camera_intrinsics.txt").write_text(text)
    assert read_camera_intrinsics(tmp_path / "camera_intrinsics.txt") == CANDIDATE_LENS


@pytest.mark.parametrize(
    ("text", "seen"),
    [
        ("see the paper", "text without names"),
        ("767.7 0 677.7 0 767.7 543.1 0 0 1", "9 numbers without names"),
        (as_text().replace("a2 = ", "k2 = "), "no a2; unknown k2"),
        (as_text() + "\ncx = 1", "twice cx"),
        (as_text(cx=337.0), "a centre (337, 543.058) far from the middle of 1350 x 1080"),
        (as_text(a0=4.0), "a focal length a0 = 4"),
        (as_text(a1=0.5), "a1 = 0.5"),
        (as_text(c=0.0, d=1.0), "c, d, e = 0, 1, 0"),
        (as_text(width=1350.5), "1350.5 x 1080 pixels"),
        (as_text(width=0.2), "an image of 0.2 x 1080"),
        (as_text(a3=float("inf")), "no a3"),
        ("\n".join(as_text("{1!r}").splitlines()[::-1]), "an image of"),
    ],
)
def test_whatever_else_is_refused_and_the_way_out_named(tmp_path, text, seen):
    (tmp_path / "camera_intrinsics.txt").write_text(text)
    with pytest.raises(InputError, match="is ambiguous or implausible") as refused:
        read_camera_intrinsics(tmp_path / "camera_intrinsics.txt")
    assert seen in str(refused.value)
    assert re.search(r"camera_intrinsics\.txt .*datamanager.lens=v2.*or v1", str(refused.value))


# Splits, rotation views, points and provenance, which all formats share


@pytest.mark.parametrize(
    ("options", "train", "test"),
    [
        ({"split": "block", "block": (0.5, 0.8)}, [0, 1, 2, 3, 4, 5, 9, 10], [6, 7, 8]),
        ({"frame_step": 2, "max_frames": 4}, [2, 4, 6], [0]),
        ({"split": "all-train"}, [*range(11)], []),
    ],
)
def test_options_choose_the_split(walls, options, train, test):
    scene = load(walls("c3vd"), **options)
    assert [frame.index for frame in scene.train] == train
    assert [frame.index for frame in scene.test_sets.get("test", [])] == test
    split = scene.provenance.split
    assert split.name == options.get("split", "every-8th")
    assert split.train == names(scene.train) and ("block" not in options or split.block == (0.5, 0.8))
    assert split.test_sets == {name: names(frames) for name, frames in scene.test_sets.items()}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_frames": 1}, r"split 'every-8th' of 1 frames .* leaves no training frames"),
        ({"split": "own"}, "does not specify its test frames"),
        ({"initial_points": "file", "points_file": "nothing.ply"}, r"no file .*nothing\.ply"),
    ],
)
def test_options_that_the_scene_does_not_allow(walls, options, message):
    with pytest.raises(InputError, match=message):
        load(walls("c3vd"), **options)


@pytest.mark.parametrize(
    "options",
    [{"block": (0.6, 0.4)}, {"block": (0.5, 1.5)}, {"split": "7:1"}, {"width": 0}, {"width": 5}, {"unit": "inch"}],
)
def test_settings_that_make_no_sense(options):
    with pytest.raises(ValidationError):
        C3VDSettings(**options)


def test_rotation_views_are_a_test_set_of_their_own(walls):
    scene = load(walls("c3vd"))
    assert names(scene.test_sets["rotation"]) == ["rotation-0000_color", "rotation-0001_color"]
    assert worst_off_wall(scene.test_sets["rotation"][1]) < 0.002
    assert scene.provenance.frames == {"in_sequence": 11, "train": 9, "test": 2, "rotation": 2}
    assert scene.provenance.rotation["layout"] == "undistorted"
    assert scene.provenance.intrinsics["cx"] == scene.train[0].camera.cx
    assert scene.provenance.record()["points"] == {"source": "depth of the training frames", "count": 11520, "seed": 0}


@pytest.mark.parametrize("colored", [True, False])
def test_points_come_from_the_scenes_ply_where_there_is_no_depth(mine, colored):
    positions, colors = np.random.default_rng(0).random((50, 3)), np.arange(150, dtype=np.uint8).reshape(50, 3)
    write_ply(mine / "points3D.ply", point_properties(positions, colors if colored else None))
    remove("depths/*")(mine)
    scene = load(mine)
    assert all(frame.depth is None for frame in scene.train)
    np.testing.assert_allclose(scene.points.positions, positions, atol=1e-7)
    assert (scene.points.colors.numpy() == colors).all() if colored else scene.points.colors is None
    assert scene.provenance.points.source == "points3D.ply" and scene.provenance.points.sha256


def test_points_come_from_a_named_file(mine, tmp_path):
    positions, colors = np.random.default_rng(0).random((50, 3)), np.arange(150, dtype=np.uint8).reshape(50, 3)
    np.savez(mine / "cloud.npz", positions=positions, colors=colors)
    scene = load(mine, initial_points="file", points_file="cloud.npz")
    np.testing.assert_allclose(scene.points.positions, positions, atol=1e-7)
    np.testing.assert_array_equal(scene.points.colors, colors)
    elsewhere = (mine / "cloud.npz").rename(tmp_path / "elsewhere.npz")
    other = load(mine, initial_points="file", points_file=str(elsewhere), points_count=7)
    assert len(other.points) == 7 and other.provenance.points.source == "elsewhere.npz"
    write_ply(mine / "points3D.ply", point_properties(positions))
    assert len(load(mine, initial_points="data").points) == 50
    assert len(load(mine, initial_points="none").points) == 0


def test_test_frames_leave_no_points(mine):
    for index in (*range(1, 8), 9, 10):
        repaint("depths/*", index, lambda depth: 0 * depth)(mine)
    with pytest.raises(InputError, match="none of the 9 training frames has a valid depth"):
        load(mine)


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="counts open files through /proc")
def test_no_file_stays_open(walls):
    load(walls("c3vd"))
    before = len(os.listdir("/proc/self/fd"))
    load(walls("c3vd"))
    assert len(os.listdir("/proc/self/fd")) <= before


# Held-out frames, and the unit of length that a scene states


@pytest.mark.parametrize(
    ("arguments", "test"),
    [
        (("every-8th", 25), [0, 8, 16, 24]),
        (("inner-8th", 21), [4, 12]),
        (("inner-8th", 22), [4, 12, 20]),
        (("endogslam", 25), [7, 15, 23]),
        (("block", 20), [8, 9, 10, 11]),
        (("block", 10, (0.0, 0.3)), [0, 1, 2]),
        (("all-train", 5), []),
    ],
)
def test_frames_that_are_held_out(arguments, test):
    assert np.flatnonzero(held_out(*arguments)).tolist() == test


@given(count=st.integers(1, 300), start=st.floats(0, 0.9), length=st.floats(0.05, 0.5))
def test_a_block_is_one_stretch_of_about_its_share(count, start, length):
    is_test = held_out("block", count, (start, min(start + length, 1.0)))
    assert (np.diff(np.flatnonzero(is_test)) == 1).all()
    assert abs(is_test.sum() - (min(start + length, 1.0) - start) * count) <= 1.0


@pytest.mark.parametrize(
    ("arguments", "options"),
    [
        (("every-8th",), []),
        (("inner-8th",), ["datamanager.split=inner-8th"]),
        (("block", (0.25, 0.5)), ["datamanager.split=block", "datamanager.block=[0.25, 0.5]"]),
    ],
)
def test_options_choose_a_split(arguments, options):
    assert split_options(*arguments) == options


def test_a_stated_unit_is_read_back_and_else_that_of_the_format(tmp_path: Path) -> None:
    assert read_unit(tmp_path, otherwise="mm") == "mm"
    assert read_unit(tmp_path) == "unknown"
    for unit in ("mm", "cm", "m", "unknown"):
        write_unit(tmp_path, unit)  # type: ignore[arg-type]
        assert read_unit(tmp_path, otherwise="mm") == unit
    (tmp_path / "unit.txt").write_text("inches\n")
    with pytest.raises(InputError, match="inches"):
        read_unit(tmp_path)
