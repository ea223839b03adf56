"""``coliags poses`` as a user meets it."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coliags_plugin.config.yaml_tree import settings_of
from coliags_plugin.core.images import write_image, write_mask
from coliags_plugin.core.registry import pose_formats
from coliags_plugin.core.scene_files import read_unit
from coliags_plugin.engine.data_formats import open_scene
from coliags_plugin.geometry.poses.formats import format_named, format_of, write_trajectory
from coliags_plugin.geometry.poses.trajectory import Trajectory
from coliags_plugin.reconstruction.structure.sfm_settings import SfmSettings
from coliags_plugin.reporting.image_files import write_png
from tests.commands import refused, run
from tests.scenes import SETS
from tests.textured_tube import INTRINSICS, tube_frames, write_tube

PINHOLE = ("--intrinsics", "61,55,33.5,21.5", "--size", "64x48")


def spiral(count=20):
    """Cameras on a spiral that look along it."""
    turns = np.linspace(0.0, 3.0, count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(turns[:, None] * [0.0, 1.0, 0.0]).as_matrix()
    poses[:, :3, 3] = np.stack([5 * np.sin(turns), 5 * np.cos(turns), 10 * turns], axis=1)
    return poses


@pytest.fixture
def truth(tmp_path):
    write_trajectory(tmp_path / "pose.txt", Trajectory(spiral()), "c3vd")
    return tmp_path / "pose.txt"


@pytest.fixture
def estimate(tmp_path):
    """The truth in another world, in units of its own, and a little off."""
    rng = np.random.default_rng(0)
    poses = spiral()
    poses[:, :3, 3] += rng.normal(0.0, 0.1, (20, 3))
    turned = np.eye(4)
    turned[:3, :3] = Rotation.from_rotvec([0.3, -1.0, 0.2]).as_matrix()
    poses = turned @ poses
    poses[:, :3, 3] *= 0.25
    write_trajectory(tmp_path / "estimate.tum", Trajectory(poses), "tum")
    return tmp_path / "estimate.tum"


def test_convert_through_every_format(truth, tmp_path, capsys):
    steps = [name for name in pose_formats if format_named(name).write is not None and name != "endogslam"]
    source = truth
    for name in steps:
        target = tmp_path / f"as-{name}"
        assert run("poses", "convert", source, "-o", target, "--to", name, *PINHOLE) == 0
        assert capsys.readouterr().out == f"written: {target}\n"
        source = target
    np.testing.assert_allclose(format_of(source).read(source).camera_to_world, spiral(), atol=1e-9)


def test_convert_says_what_it_read_and_what_it_lost(truth, tmp_path, caplog):
    caplog.set_level("INFO")
    assert run("poses", "convert", truth, "-o", tmp_path / "t.json", "--to", "nerfstudio") == 0
    assert run("poses", "convert", tmp_path / "t.json", "-o", tmp_path / "t.tum", "--to", "tum") == 0
    text = caplog.text
    assert "c3vd (camera-to-world matrices, column-major); 20 poses, path" in text
    assert "mean step" in text
    assert "mean looking direction (" in text
    assert "the input has no image names: using 0000.png" in text
    assert "t.json has no camera, which its readers need; --intrinsics and --size give it one" in text
    assert "tum does not store names: dropped" in text
    assert "no timestamps: frame numbers are written instead" in text


def test_images_give_names(truth, tmp_path, capsys):
    (tmp_path / "images").mkdir()
    for index in range(20):
        write_png(tmp_path / "images" / f"{index}_color.png", np.zeros((2, 2, 3), np.uint8))
    argv = ("poses", "convert", truth, "-o", tmp_path / "model", "--to", "colmap-text", *PINHOLE)
    assert run(*argv, "--images", tmp_path / "images") == 0
    assert format_named("colmap").read(tmp_path / "model").names == tuple(f"{index}_color.png" for index in range(20))
    (tmp_path / "images" / "7_color.png").unlink()
    assert "holds 19 images for 20 poses" in refused(capsys, *argv, "--images", tmp_path / "images", "--overwrite")
    assert "a folder of images" in refused(capsys, *argv, "--images", truth)


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (("--to", "tumm"), "no pose format 'tumm'"),
        (("--to", "tum", "--from", "colmap"), "holds no COLMAP model"),
        (("--to", "tum", "--from", "tum"), "line 1:"),
        (("--to", "endogslam"), "no intrinsics"),
        (("--to", "endogslam-truth"), "is read-only"),
        (("--to", "colmap", "--size", "64x48"), "--intrinsics without --size, or the reverse"),
        (("--to", "colmap", "--intrinsics", "1,2,3,4"), "--intrinsics without --size"),
        (("--to", "colmap", "--intrinsics", "1,2,3", "--size", "64x48"), "--intrinsics 1,2,3. Expected four numbers"),
        (("--to", "colmap", "--intrinsics", "0,2,3,4", "--size", "64x48"), "--intrinsics, --size: intrinsics fx 0"),
        (("--to", "colmap", "--intrinsics", "1,2,3,4", "--size", "64"), "--size 64"),
    ],
)
def test_what_convert_refuses(truth, tmp_path, capsys, argv, message):
    assert message in refused(capsys, "poses", "convert", truth, "-o", tmp_path / "out", *argv)
    assert [path.name for path in tmp_path.iterdir()] == ["pose.txt"]


def test_convert_replaces_only_when_asked_and_never_its_input(truth, tmp_path, capsys):
    before = truth.read_bytes()
    argv = ("poses", "convert", truth, "-o", tmp_path / "out.tum", "--to", "tum")
    assert run(*argv) == 0
    assert "already exists" in refused(capsys, *argv)
    assert run(*argv, "--overwrite") == 0
    message = refused(capsys, "poses", "convert", truth, "-o", truth, "--to", "tum", "--overwrite")
    assert "is the input itself" in message
    assert truth.read_bytes() == before
    assert "no file or folder" in refused(
        capsys, "poses", "convert", tmp_path / "x", "-o", tmp_path / "y", "--to", "tum"
    )


def test_align_prints_errors(estimate, truth, capsys):
    argv = ("poses", "align", estimate, truth)
    assert run(*argv, "--scale", "--json") == 0
    errors = json.loads(capsys.readouterr().out)
    assert run(*argv, "--scale") == 0
    shown = capsys.readouterr().out
    assert "20 frames matched by index, of 20 estimated and 20 reference ones" in shown
    assert "Sim(3): rotation" in shown
    assert errors["unit"] == "mm"
    assert errors["scale"] == pytest.approx(4.0, rel=0.02)
    assert 0.05 < errors["ate"]["rmse"] < 0.2
    assert f"{errors['ate']['rmse']:.4g}" in shown
    assert run(*argv, "--json") == 0
    without_scale = json.loads(capsys.readouterr().out)
    assert without_scale["ate"]["rmse"] > errors["ate"]["rmse"]


def test_align_of_training_frames_and_with_the_truth_inside_params_npz(truth, tmp_path, capsys):
    write_trajectory(tmp_path / "train.txt", Trajectory(spiral()[np.arange(20) % 8 != 7]), "c3vd")
    assert "--match endogslam-train" in refused(capsys, "poses", "align", tmp_path / "train.txt", truth)
    assert run("poses", "align", tmp_path / "train.txt", truth, "--match", "endogslam-train") == 0
    assert "18 frames matched by endogslam-train" in capsys.readouterr().out
    params = tmp_path / "params.npz"
    assert run("poses", "convert", truth, "-o", params, "--to", "endogslam", *PINHOLE) == 0
    assert run("poses", "align", params, params, "--reference-format", "endogslam-truth") == 0
    assert "20 frames matched by index" in capsys.readouterr().out


def test_what_align_refuses(estimate, truth, capsys):
    for option, value, message in (("--delta", 20, "over 20 frames"), ("--match", "name", "not both have names")):
        assert message in refused(capsys, "poses", "align", estimate, truth, option, value)


def test_align_warns_where_names_were_passed_over(tmp_path, caplog):
    for name in ("a", "b"):
        names = tuple(f"{name}{index}.png" for index in range(20))
        write_trajectory(tmp_path / name, Trajectory(spiral(), names=names), "nerfstudio")
    assert run("poses", "align", tmp_path / "a", tmp_path / "b") == 0
    (record,) = [record for record in caplog.records if record.levelname == "WARNING"]
    assert "matched by index" in record.getMessage()
    assert "by name: no name in common" in record.getMessage()


MODEL = "camera.model=PINHOLE"
CAMERA = ("--camera", "PINHOLE", "--params", ",".join(map(str, INTRINSICS)))
COUNT = 9


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
    assert open_scene(out).provenance.unit == "unknown"
    assert end == [
        f"written: {out}",
        f"next:    coliags depth {out} --output {out}-depth",
        f"next:    coliags train coliags-plus --data {out}-depth",
    ]
    assert sorted(path.name for path in (out / "images").iterdir()) == [f"{n:04d}_color.png" for n in range(0, 9, 2)]
    argv = ("train", "coliags-plus", "--data", out, "--output", tmp_path / "run", "--renderer", "torch")
    assert run(*argv, "--steps", 2, *SETS) == 0
    rows = (tmp_path / "run/metrics.jsonl").read_text().splitlines()
    assert json.loads(rows[-1])["terms"]["depth"] > 0.0
    capsys.readouterr()
    assert run("poses", "convert", tube / "camera_pose.txt", "-o", tmp_path / "true", "--to", "colmap", "--images",
               tube / "images", "--intrinsics", "1,1,1,1", "--size", "2x2") == 0  # fmt: skip
    capsys.readouterr()
    assert run("poses", "align", out / "sparse" / "0", tmp_path / "true", "--scale", "--json") == 0
    errors = json.loads(capsys.readouterr().out)
    assert errors["matched_by"] == "name"
    assert errors["ate"]["rmse"] < 0.2


def test_a_known_distance_or_diameter_fixes_the_scale(tube, tmp_path, capsys, caplog):
    truth = np.stack([frame.camera.camera_to_world.numpy() for frame in tube_frames(COUNT)])
    first, last = truth[0, :3, 3], truth[8, :3, 3]
    argv = ("poses", "sfm", tube / "images", *CAMERA, "--every", 4)
    distance = ("0000_color.png", "0008_color", np.linalg.norm(last - first))
    assert run(*argv, "--output", tmp_path / "by-distance", "--distance", *distance) == 0
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
        (("--diameter", "0"), "0 mm by --diameter or --distance. Expected one length above 0"),
        (("--diameter", "40", "--distance", "a", "b", "1"), "40 mm and 1 mm by --diameter or --distance. Expected one"),
        (("--distance", "a", "b", "nan"), "nan mm by --diameter or"),
        (("--camera", "c3vd", "--params", "1,2"), "--params, and --camera c3vd"),
        (("--set", "camera.field_of_view=[90, 20]"), "two ascending angles"),
        (("--camera", "PINHOLE", "--params", "1,2"), "2 parameters for PINHOLE"),
        (("--params", "1,two"), "setting camera.params"),
        (("--params", "1,2"), "parameters (--params) without their camera model (--camera)"),
        (("--set", "overlapp=3"), "unknown key 'overlapp'"),
        (("--max-frames", "1"), "--max-frames 1"),
        (("--every", "20"), "1 image"),
        (("--mask", "tube/nothing"), "has no mask for 0000_color.png"),
        (("--output", "tube/images"), "a folder apart from the input"),
    ],
)
def test_what_sfm_refuses(tube, monkeypatch, capsys, argv, message):
    monkeypatch.chdir(tube.parent)
    assert message in " ".join(refused(capsys, "poses", "sfm", "tube/images", "--output", "new", *argv).split())
    assert [path.name for path in tube.parent.iterdir()] == ["tube"]


def test_images_too_dark_for_sfm_are_refused_with_a_mask_too(tmp_path, capsys):
    for index in range(3):
        write_image(tmp_path / f"frames/{index}.png", np.full((48, 64), 4095, np.uint16))
    write_mask(tmp_path / "mask.png", np.ones((48, 64), bool))
    for more in ((), ("--mask", tmp_path / "mask.png")):
        text = refused(capsys, "poses", "sfm", tmp_path / "frames", "--output", tmp_path / "out", *more)
        assert "no pixel of the 3 frames" in text and "brighter than 15 of 255" in text


def test_an_option_of_a_part_leaves_its_other_defaults():
    changed = settings_of(
        SfmSettings, ["features.upright=false", "camera.model=PINHOLE", "camera.params=[1, 2.5, 3, 4]"]
    )
    assert changed.features == SfmSettings().features.model_copy(update={"upright": False})
    assert changed.camera.params == (1.0, 2.5, 3.0, 4.0)
