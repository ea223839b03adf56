"""``coliags poses sfm`` as a user meets it."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import numpy as np
import pytest

from coliags_plugin.config.assignments import settings_of
from coliags_plugin.datamanagers.scene_settings import read_unit
from coliags_plugin.engine.data_formats import open_scene
from coliags_plugin.reconstruction.structure.sfm_settings import SfmSettings
from tests import commands
from tests.commands import run
from tests.scenes import SMALL
from tests.textured_tube import INTRINSICS, tube_frames, write_tube

CAMERA = ("--camera", "PINHOLE", "--params", ",".join(map(str, INTRINSICS)))
COUNT = 9


def refused(capsys, *argv):
    """What a command that must fail says, in one line."""
    return " ".join(commands.refused(capsys, *argv).split())


def trains(command, folder):
    """Take the command that was printed, for a few steps; its last losses."""
    words = shlex.split(command)
    assert words.pop(0) == "coliags"
    small = [word for override in SMALL for word in ("--set", override)]
    assert run(*words, "--output", folder, "--steps", 2, "--renderer", "torch", *small) == 0
    return json.loads((folder / "metrics.jsonl").read_text().splitlines()[-1])["terms"]


@pytest.fixture(scope="module")
def tube(tmp_path_factory):
    return write_tube(tmp_path_factory.mktemp("tubes") / "tube", COUNT)


@pytest.mark.thorough
def test_sfm_makes_a_scene_that_trains_and_aligns(tube, tmp_path, capsys, caplog):
    out = tmp_path / "out"
    assert run("poses", "sfm", tube / "images", "--output", out, *CAMERA, "--every", 2, "--max-frames", 5) == 0
    summary, unit, *end = capsys.readouterr().out.splitlines()
    assert summary.startswith("5 of 5 images posed")
    assert unit.startswith("unit: unknown, as images alone do not determine it; the median depth of the points is")
    assert read_unit(out) == "unknown"
    assert open_scene(out).provenance["unit"] == "unknown"
    assert end == [
        f"written: {out}",
        f"next:    coliags depth estimate {out} --output {out}-depth",
        f"next:    coliags train coliags-in-vivo --data {out}-depth",
    ]
    assert sorted(path.name for path in (out / "images").iterdir()) == [f"{n:04d}_color.png" for n in range(0, 9, 2)]
    command = f"coliags train coliags-sparse-depth --data {out}"
    assert trains(command, tmp_path / "run")["depth"] > 0.0
    capsys.readouterr()
    assert run("poses", "convert", tube / "camera_pose.txt", "-o", tmp_path / "true", "--to", "colmap", "--images",
               tube / "images", "--intrinsics", "1,1,1,1", "--size", "2x2") == 0  # fmt: skip
    capsys.readouterr()
    assert run("poses", "align", out / "sparse" / "0", tmp_path / "true", "--scale", "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert told["matched_by"] == "name"
    assert told["ate"]["rmse"] < 0.2


def test_a_known_distance_or_diameter_fixes_the_scale(tube, tmp_path, capsys, caplog):
    truth = np.stack([frame.camera.camera_to_world.numpy() for frame in tube_frames(COUNT)])
    first, last = truth[0, :3, 3], truth[8, :3, 3]
    argv = ("poses", "sfm", tube / "images", *CAMERA, "--every", 4)
    known = f"0000_color.png,0008_color,{np.linalg.norm(last - first)}"
    assert run(*argv, "--output", tmp_path / "by-distance", "--distance", known) == 0
    assert "unit: mm, " in capsys.readouterr().out
    assert read_unit(tmp_path / "by-distance") == "mm"
    scene = open_scene(tmp_path / "by-distance", options=["split=all-train"])
    centers = np.stack([frame.camera.center.numpy() for frame in scene.train])
    assert np.linalg.norm(centers[2] - centers[0]) == pytest.approx(np.linalg.norm(last - first), rel=1e-5)
    assert np.linalg.norm(centers[1] - centers[0]) == pytest.approx(np.linalg.norm(truth[4, :3, 3] - first), rel=0.02)
    # The wall is ahead of so short a path: the poses are kept, in an unknown unit.
    assert run(*argv, "--output", tmp_path / "by-diameter", "--diameter", 40) == 0
    assert "lie beside the camera's path" in caplog.text
    assert "unit: unknown" in capsys.readouterr().out
    assert read_unit(tmp_path / "by-diameter") == "unknown"


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (("--diameter", "0"), "--diameter 0. Expected a length in mm above 0"),
        (("--diameter", "40", "--distance", "a,b,1"), "--diameter and --distance. Expected one of them"),
        (("--distance", "a,b"), "IMAGE,IMAGE,MM"),
        (("--distance", "a,b,nan"), "a length in mm above 0"),
        (("--camera", "c3vd", "--params", "1,2"), "--params, and --camera c3vd"),
        (("--set", "camera.field_of_view=[90, 20]"), "two ascending angles"),
        (("--camera", "PINHOLES"), "camera model PINHOLES"),
        (("--camera", "PINHOLE", "--params", "1,2"), "2 parameters for PINHOLE"),
        (("--params", "1,two"), "--set camera.params"),
        (("--params", "1,2"), "parameters (--params) without their camera model (--camera)"),
        (("--set", "overlapp=3"), "unknown key 'overlapp'"),
        (("--every", "0"), "--every 0"),
        (("--max-frames", "1"), "--max-frames 1"),
        (("--every", "20"), "1 image"),
        (("--mask", "tube/nothing"), "has no mask for 0000_color.png"),
        (("--output", "tube/images"), "a folder apart from the input"),
    ],
)
def test_what_sfm_refuses(tube, monkeypatch, capsys, argv, message):
    monkeypatch.chdir(tube.parent)
    assert message in refused(capsys, "poses", "sfm", "tube/images", "--output", "new", *argv)
    assert [path.name for path in tube.parent.iterdir()] == ["tube"]


def test_defaults_of_a_part_stay_where_one_of_its_options_is_set():
    given = settings_of(SfmSettings, ["features.upright=false", "camera.model=PINHOLE", "camera.params=[1, 2.5, 3, 4]"])
    assert given.features == SfmSettings().features.model_copy(update={"upright": False})
    assert given.camera.params == (1.0, 2.5, 3.0, 4.0)


def test_the_table_of_the_documentation_tells_the_defaults():
    header, settings = "| option of `--set` | default | what |", SfmSettings()
    lines = (Path(__file__).parents[2] / "docs/poses.md").read_text().splitlines()
    rows = lines[lines.index(header) + 2 :]
    rows = [line.replace("`", "").strip("|").split("|") for line in rows[: rows.index("")]]
    assert len(rows) > 5
    for names, defaults, _ in rows:
        for name, default in zip(names.split(","), defaults.split(","), strict=True):
            value = settings
            for part in name.strip().split("."):
                value = getattr(value, part)
            assert json.loads(default) == value, name
