"""``coliags poses track`` as a user meets it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from coliags_plugin.datamanagers.recognition import find_format
from coliags_plugin.datamanagers.rgbd.writer import write_rgbd_scene
from coliags_plugin.engine.data_formats import open_scene
from coliags_plugin.geometry.poses import tum
from coliags_plugin.geometry.poses.trajectory import Trajectory
from tests import commands
from tests.commands import run
from tests.scenes import SMALL
from tests.textured_tube import tube_frames

FAST = ("--set", "tracking.method=hybrid", "--set", "tracking.pose_graph=false")


def refused(capsys, *argv):
    """The last line of what a command that must fail says."""
    return commands.refused(capsys, *argv).splitlines()[-1]


@pytest.fixture(scope="module")
def posed(tmp_path_factory):
    """A tube, filmed, with its poses."""
    folder = tmp_path_factory.mktemp("tube") / "posed"
    frames = tube_frames(6, step=0.5)
    write_rgbd_scene(folder, frames, torch.stack([frame.camera.camera_to_world for frame in frames]).numpy())
    return folder


@pytest.fixture
def unposed(posed, tmp_path):
    """The same as whoever has no poses has it."""
    folder = Path(shutil.copytree(posed, tmp_path / "unposed"))
    (folder / "trajectory.txt").unlink()
    return folder


def test_track_a_folder_without_poses_and_train_on_it(unposed, tmp_path, capsys):
    out = tmp_path / "out"
    assert run("poses", "track", unposed, "--output", out, *FAST) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0] == "6 frames, 6 tracked by hybrid; lost edges: 0 of 5"
    assert "fitness 0.9" in said[1]
    assert "inlier RMSE" in said[1]
    assert not any("own poses" in line for line in said)
    assert said[-3:] == [
        f"written: {out / 'trajectory.txt'}",
        f"written: {out}",
        f"next:    coliags train coliags --data {out}",
    ]
    # What was written is a scene whose poses are the trajectory's.
    assert find_format(out) == "rgbd"
    scene = open_scene(out)
    trajectory = tum.read(out / "trajectory.txt")
    video = sorted([*scene.train, *scene.test_sets["test"]], key=lambda frame: frame.index)
    np.testing.assert_allclose(
        np.stack([frame.camera.camera_to_world.numpy() for frame in video]), trajectory.camera_to_world, atol=1e-6
    )
    np.testing.assert_allclose(trajectory.camera_to_world[0], np.eye(4), atol=1e-12)
    for frame, made in zip(video, tube_frames(6, step=0.5), strict=True):
        assert torch.equal(frame.image, made.image)
        assert float((frame.depth - made.depth).abs().max()) < 0.01
        assert (frame.camera.fx, frame.camera.cx) == pytest.approx((made.camera.fx, made.camera.cx))
    small = [part for override in (*SMALL, "schedule.steps=3") for part in ("--set", override)]
    assert run("train", "coliags", "--data", out, "--output", tmp_path / "run", "--seed", "0", *small) == 0
    losses = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert losses[-1]["step"] == 3


def test_given_poses_only_judge_the_result(posed, tmp_path, capsys):
    """The same bits come out whatever poses the scene has; the errors told are another matter."""
    scrambled = Path(shutil.copytree(posed, tmp_path / "scrambled"))
    given = tum.read(posed / "trajectory.txt")
    tum.write(
        scrambled / "trajectory.txt", Trajectory(given.camera_to_world[[3, 0, 5, 1, 4, 2]], timestamps=given.timestamps)
    )
    told = []
    for scene in (posed, scrambled):
        assert run("poses", "track", scene, "--output", tmp_path / f"of-{scene.name}", *FAST) == 0
        told.append(next(line for line in capsys.readouterr().out.splitlines() if "own poses" in line))
    one, other = (tmp_path / f"of-{name}" / "trajectory.txt" for name in ("posed", "scrambled"))
    assert one.read_bytes() == other.read_bytes()
    ate, worse = (float(line.split("ATE rmse ")[1].split(" ")[0]) for line in told)
    assert ate < 0.2  # measured 0.03 mm
    assert worse > 1.0


def test_masks_stay_and_lost_frames_are_said(unposed, tmp_path, capsys, caplog):
    (unposed / "masks").mkdir()
    for path in (unposed / "rgb").iterdir():
        mask = np.full((128, 160), 255, np.uint8)
        mask[:, :20] = 0
        cv2.imwrite(str(unposed / "masks" / path.name), mask)
    cv2.imwrite(str(unposed / "rgb" / "0003.png"), np.zeros((128, 160, 3), np.uint8))
    assert run("poses", "track", unposed, "--output", tmp_path / "out", *FAST) == 0
    assert "5 tracked by hybrid; lost edges: 1 of 5" in capsys.readouterr().out
    assert "frames 3 are lost" in caplog.text
    frame = open_scene(tmp_path / "out").train[0]
    assert not frame.mask[:, :20].any()
    assert frame.mask[:, 20:].all()
    assert frame.depth[:, :20].isnan().all()


def test_options_of_the_data_manager_reach_it(posed, tmp_path, capsys):
    options = ("--set", "max_frames=3", "--set", "width=80", "--set", "height=64", *FAST)
    assert run("poses", "track", posed, "--output", tmp_path / "out", *options) == 0
    assert capsys.readouterr().out.startswith("3 frames")
    assert json.loads((tmp_path / "out" / "camera.json").read_text())["w"] == 80


def test_what_is_refused(posed, unposed, tmp_path, capsys):
    out = tmp_path / "out"
    assert "already exists" in refused(capsys, "poses", "track", posed, "--output", unposed)
    assert "a folder apart from the input" in refused(capsys, "poses", "track", posed, "--output", posed / "out")
    assert "--set tracking.method" in refused(
        capsys, "poses", "track", posed, "--output", out, "--set", "tracking.method=icp"
    )
    assert "unknown key 'widht'" in refused(capsys, "poses", "track", posed, "--output", out, "--set", "widht=3")
    assert "1 frame." in refused(capsys, "poses", "track", posed, "--output", out, "--set", "max_frames=1")
    assert "has no depth" in refused(capsys, "poses", "track", posed, "--output", out, "--set", "depth=none")
    cv2.imwrite(str(unposed / "rgb" / "0002.png"), np.zeros((64, 80, 3), np.uint8))
    assert "0002.png is 80 x 64" in refused(capsys, "poses", "track", unposed, "--output", out)
    for path in (unposed / "rgb").iterdir():
        cv2.imwrite(str(path), np.zeros((128, 160, 3), np.uint8))
    message = refused(capsys, "poses", "track", unposed, "--output", out, *FAST)
    assert "no two consecutive frames of 6 could be registered" in message
    shutil.rmtree(unposed / "depth")
    assert "none of the formats" in refused(capsys, "poses", "track", unposed, "--output", out)
    assert not out.exists()
