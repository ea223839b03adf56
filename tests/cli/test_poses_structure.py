"""``coliags poses triangulate`` and ``sfm`` as a user meets them."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch

from coliags_plugin.cli.poses.structure import _held_out
from coliags_plugin.config.assignments import settings_of
from coliags_plugin.core.images import read_rgb
from coliags_plugin.core.scenes import PointCloud, Scene
from coliags_plugin.datamanagers.units import read_unit
from coliags_plugin.engine.data_formats import open_scene
from coliags_plugin.reconstruction.structure.sfm_settings import SfmSettings
from coliags_plugin.reconstruction.structure.triangulation import TriangulationSettings, triangulate
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
def test_triangulate_makes_a_scene_that_trains(tube, tmp_path, capsys):
    assert "coliags poses triangulate" in refused(capsys, "train", "scaffold-gs", "--data", tube)
    out = tmp_path / "out"
    assert run("poses", "triangulate", tube, "--output", out) == 0
    summary, *end = capsys.readouterr().out.splitlines()
    assert "points of" in summary
    assert "mean reprojection error 0." in summary
    assert "frames each" in summary
    assert "depth uncertainty" in summary
    assert end == [
        f"written: {out}",
        f"next:    coliags depth estimate {out} --output {out}-depth",
        f"next:    coliags train coliags-in-vivo --data {out}-depth",
    ]
    assert read_unit(out) == "mm"
    scene, source = open_scene(out), open_scene(tube)
    assert summary.startswith(f"{len(scene.points)} points")
    for one, other in zip(
        [*scene.train, *scene.test_sets["test"]], [*source.train, *source.test_sets["test"]], strict=True
    ):
        assert one.name == other.name
        torch.testing.assert_close(one.camera.camera_to_world, other.camera.camera_to_world, atol=1e-5, rtol=0)
        np.testing.assert_array_equal(one.image, other.image)
    terms = trains(f"coliags train coliags-sparse-depth --data {out}", tmp_path / "run")
    assert 0.0 < terms["depth"] < 50.0
    # Also where no loss asks for depth, and no option is given.
    assert trains(f"coliags train scaffold-gs --data {out}", tmp_path / "run-2")


@pytest.mark.thorough
def test_options_of_reading_and_of_triangulation(tube, tmp_path, capsys, caplog):
    out = tmp_path / "out"
    caplog.set_level("INFO")
    options = ("--set", "split=endogslam", "--set", "triangulation.min_track_length=5", "--format", "c3vd")
    assert run("poses", "triangulate", tube, "--output", out, *options, "--set", "width=120", "--set", "height=96") == 0
    command = capsys.readouterr().out.splitlines()[-1]
    assert command.endswith("--set datamanager.split=endogslam")
    assert "points come from the 8 training frames; the 1 test frames see none" in caplog.text
    scene = open_scene(out, options=["split=endogslam"])
    assert [frame.name for frame in scene.test_sets["test"]] == ["0007_color"]
    assert scene.test_sets["test"][0].sparse_depth is None
    assert scene.train[0].image.shape == (96, 120, 3)
    argv = ("poses", "triangulate", tube, "--output", out)
    assert "already exists" in refused(capsys, *argv)
    assert run(*argv, "--overwrite", "--set", "split=all-train") == 0
    assert capsys.readouterr().out.splitlines()[-1].endswith("--set datamanager.split=all-train")


@pytest.mark.thorough
def test_features_are_detected_at_the_stored_size(tube, tmp_path, capsys, caplog):
    caplog.set_level("INFO")
    whole, half = tmp_path / "whole", tmp_path / "half"
    assert run("poses", "triangulate", tube, "--output", whole) == 0
    assert "detected at" not in caplog.text
    assert run("poses", "triangulate", tube, "--output", half, "--set", "width=80", "--set", "height=64") == 0
    assert "features are detected at the stored size, 160 x 128" in caplog.text
    models = [pycolmap.Reconstruction(str(folder / "sparse" / "0")) for folder in (whole, half)]
    # The same points from the same images, in pixels of half the size.
    assert models[0].num_points3D() == models[1].num_points3D() > 200
    for number, point in models[0].points3D.items():
        np.testing.assert_allclose(models[1].points3D[number].xyz, point.xyz)
        assert models[1].points3D[number].error == pytest.approx(point.error / 2, rel=1e-3)
    for number, image in models[0].images.items():
        for one, other in zip(image.points2D, models[1].images[number].points2D, strict=True):
            np.testing.assert_allclose(other.xy, one.xy / 2)
    assert read_rgb(half / "images" / "0001_color.png").shape == (64, 80, 3)
    scene = open_scene(tube, options=["initial_points=none", "width=120", "height=96"])
    assert len(triangulate(scene.train)) < 0.8 * models[0].num_points3D()


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (("--set", "triangulation.overlapp=3"), "--set triangulation.overlapp: unknown key 'overlapp'"),
        (("--set", "triangulation.min_angle=90"), "--set triangulation.min_angle: Input should be less than 90"),
        (
            ("--set", "triangulation.features.upright=7"),
            "--set triangulation.features.upright: Input should be a valid",
        ),
        (("--set", "splitt=block"), "unknown key 'splitt'"),
        (("--set", "triangulation.min_angle"), "key.path=value"),
        (("--set", "max_frames=1", "--set", "split=all-train"), "1 frames. Expected at least 2"),
        (("--output", "tube/out"), "a folder apart from the input"),
        (("--output", "."), "a folder apart from the input"),
        (("--format", "rgbd"), "coliags: "),
    ],
)
def test_what_triangulate_refuses(tube, monkeypatch, capsys, argv, message):
    monkeypatch.chdir(tube.parent)
    assert message in refused(capsys, "poses", "triangulate", "tube", "--output", "new", *argv)
    assert [path.name for path in tube.parent.iterdir()] == ["tube"]


def test_splits_are_kept_where_a_rule_tells_them(caplog):
    frames = tube_frames(17)

    def scene(test, **split):
        held = set(test)
        train = [frame for frame in frames if frame.index not in held]
        others = {"test": [frames[index] for index in test], "rotation": frames[:3]}
        return Scene("tube", train, others, PointCloud(torch.zeros(0, 3)), {"split": split})

    test, options = _held_out(scene([0, 8, 16], name="own"))
    assert [frame.index for frame in test] == [0, 8, 16]
    assert options == []
    assert "left out: test set rotation (3 frames)" in caplog.text
    test, options = _held_out(scene(range(5, 9), name="block", block=[0.3, 0.55]))
    assert [frame.index for frame in test] == [5, 6, 7, 8]
    assert options == ["datamanager.split=block", "datamanager.block=[0.3, 0.55]"]
    test, options = _held_out(scene([3, 4, 9], name="own"))
    assert (test, options) == ([], ["datamanager.split=all-train"])
    assert "left out: the 3 test frames" in caplog.text


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
    # Points of a scene keep its unit.
    assert run("poses", "triangulate", tmp_path / "by-diameter", "--output", tmp_path / "points", "--set",
               "split=all-train", "--set", "triangulation.min_share=0") == 0  # fmt: skip
    assert read_unit(tmp_path / "points") == "unknown"


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


@pytest.mark.parametrize(
    ("header", "settings"),
    [
        ("| `--set triangulation.` | default | what |", TriangulationSettings()),
        ("| option of `--set` | default | what |", SfmSettings()),
    ],
)
def test_tables_of_the_documentation_tell_the_defaults(header, settings):
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
