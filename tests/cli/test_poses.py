"""``coliags poses`` as a user meets it."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coliags_plugin.config.registry import pose_formats
from coliags_plugin.geometry.poses.formats import format_named, format_of, write_trajectory
from coliags_plugin.geometry.poses.trajectory import Trajectory
from coliags_plugin.outputs.image_files import write_png
from tests.commands import refused, run

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
    said = caplog.text
    assert "c3vd (camera-to-world matrices, column-major); 20 poses, path" in said
    assert "mean step" in said
    assert "mean looking direction (" in said
    assert "the input has no image names: using 0000.png" in said
    assert "tum does not store names: dropped" in said
    assert "no timestamps: frame numbers are written instead" in said


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
        (("--to", "colmap", "--size", "64x48"), "--size without --intrinsics"),
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
    told = json.loads(capsys.readouterr().out)
    assert run(*argv, "--scale") == 0
    shown = capsys.readouterr().out
    assert "20 frames matched by index, of 20 estimated and 20 reference ones" in shown
    assert "Sim(3): rotation" in shown
    assert told["unit"] == "mm"
    assert told["scale"] == pytest.approx(4.0, rel=0.02)
    assert 0.05 < told["ate"]["rmse"] < 0.2
    assert f"{told['ate']['rmse']:.4g}" in shown
    assert run(*argv, "--json") == 0
    without_scale = json.loads(capsys.readouterr().out)
    assert without_scale["ate"]["rmse"] > told["ate"]["rmse"]


def test_align_warns_where_positions_determine_no_rotation(tmp_path, capsys, caplog):
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 2, 3] = np.arange(5.0)
    write_trajectory(tmp_path / "line", Trajectory(poses), "c3vd")
    turned = poses.copy()
    turned[:, :3, :3] = Rotation.from_euler("z", 178, degrees=True).as_matrix()
    write_trajectory(tmp_path / "turned", Trajectory(turned), "c3vd")
    argv = ("poses", "align", tmp_path / "turned", tmp_path / "line")
    assert run(*argv) == 0
    assert "the positions lie on a line" in caplog.text
    assert "the rotation is that by orientations about the path" in caplog.text
    assert "ATE rmse: 0 % of the path, 4 mm" in capsys.readouterr().out
    assert run(*argv, "--json") == 0
    assert json.loads(capsys.readouterr().out)["rotation_deg"]["max"] < 1e-9


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (("--delta", 20), "over 20 frames"),
        (("--match", "name"), "not both have names"),
        (("--estimate-format", "c3vd"), "line 1"),
    ],
)
def test_what_align_refuses(estimate, truth, capsys, argv, message):
    assert message in refused(capsys, "poses", "align", estimate, truth, *argv)


def test_align_warns_where_names_were_passed_over(tmp_path, caplog):
    for name in ("a", "b"):
        names = tuple(f"{name}{index}.png" for index in range(20))
        write_trajectory(tmp_path / name, Trajectory(spiral(), names=names), "nerfstudio")
    assert run("poses", "align", tmp_path / "a", tmp_path / "b") == 0
    (record,) = [record for record in caplog.records if record.levelname == "WARNING"]
    assert "matched by index" in record.getMessage()
    assert "by name: no name in common" in record.getMessage()


def test_align_with_the_truth_inside_params_npz(truth, tmp_path, capsys):
    params = tmp_path / "params.npz"
    assert run("poses", "convert", truth, "-o", params, "--to", "endogslam", *PINHOLE) == 0
    assert run("poses", "align", params, params, "--reference-format", "endogslam-truth") == 0
    assert "20 frames matched by index" in capsys.readouterr().out


def test_align_of_training_frames(truth, tmp_path, capsys):
    kept = [index for index in range(20) if index % 8 != 7]
    write_trajectory(tmp_path / "train.txt", Trajectory(spiral()[kept]), "c3vd")
    assert "--match endogslam-train" in refused(capsys, "poses", "align", tmp_path / "train.txt", truth)
    assert run("poses", "align", tmp_path / "train.txt", truth, "--match", "endogslam-train") == 0
    assert "18 frames matched by endogslam-train" in capsys.readouterr().out
