"""Files count pixel centres as their format does, in scenes and in conversions of poses.

That what is read lies on the pixels it was written for, to the subpixel, is shown by the wall in every format
(test_contract.py).
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from coliags_plugin.geometry.poses.formats import format_of, write_trajectory
from coliags_plugin.geometry.poses.trajectory import Trajectory
from tests.commands import run
from tests.datamanagers.kinds import KINDS
from tests.datamanagers.wall_scenes import HEIGHT, PINHOLE, WIDTH, layout_of, poses


def of_json(name: str, key: str = "cx") -> Callable[[Path], float]:
    return lambda folder: json.loads((folder / name).read_text())[key]


def of_params(name: str) -> Callable[[Path], float]:
    return lambda folder: float(np.load(folder / name)["intrinsics"][0, 2])


def of_calibration(folder: Path) -> float:
    return float((folder / "calibration.xml").read_text().split("[")[1].split(";")[2])


def of_model(name: str) -> Callable[[Path], float]:
    return lambda folder: pycolmap.Reconstruction(str(folder / name)).cameras[1].principal_point_x


@pytest.mark.parametrize(
    ("name", "stored", "shift"),
    [
        ("c3vd", of_json("camera.json"), -0.5),
        ("colmap", of_model("sparse/0"), 0.0),
        ("c3vd-endogslam", of_params("params.npz"), -0.5),
        ("pr-endo", of_params(KINDS["pr-endo"].params), -0.5),
        ("nerfstudio", of_json("transforms.json"), 0.0),
        ("reim-nerf", of_json("transforms_train.json"), -0.5),
        ("rgbd", of_json("camera.json"), -0.5),
        ("endomapper", of_calibration, -0.5),
    ],
)
def test_files_count_as_their_format_does(walls, name, stored, shift):
    lens, _ = layout_of(KINDS[name].layout).lens(WIDTH, HEIGHT)
    assert stored(walls(name)) == pytest.approx(lens.pinhole.cx + shift, rel=1e-6)


def test_the_candidate_calibration_is_written_as_published(walls):
    text = (walls("c3vd-v2") / "camera_intrinsics.txt").read_text()
    assert "\ncx = 677.739464094188\ncy = 543.057997844875\n" in text


@pytest.mark.parametrize(
    ("name", "stored", "shift"),
    [
        ("colmap", of_model("poses"), 0.0),
        ("colmap-text", of_model("poses"), 0.0),
        ("endogslam", of_params("poses"), -0.5),
        ("nerfstudio", of_json("poses"), 0.0),
    ],
)
def test_conversions_of_poses_keep_the_camera(name, stored, shift, tmp_path):
    """There and, by way of nerfstudio's form, back."""
    write_trajectory(tmp_path / "given.tum", Trajectory(poses(9)), "tum")
    k = PINHOLE
    camera = ("--intrinsics", f"{k.fx},{k.fy},{k.cx},{k.cy}", "--size", f"{k.width}x{k.height}")
    assert run("poses", "convert", tmp_path / "given.tum", "-o", tmp_path / "poses", "--to", name, *camera) == 0
    assert stored(tmp_path) == pytest.approx(k.cx + shift, rel=1e-6)
    assert run("poses", "convert", tmp_path / "poses", "-o", tmp_path / "back", "--to", "nerfstudio") == 0
    for path in (tmp_path / "poses", tmp_path / "back"):
        assert vars(format_of(path).read(path).intrinsics) == pytest.approx(vars(k), rel=1e-6)
