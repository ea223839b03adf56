"""A known point stays on its pixel through every format, whatever the format counts pixels from."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch

from coliags_plugin.config.registry import phantom_layouts
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.core.scenes import Frame
from coliags_plugin.geometry.lenses.models import Lens
from coliags_plugin.geometry.poses.formats import format_of, write_trajectory
from coliags_plugin.geometry.poses.trajectory import Trajectory
from coliags_plugin.phantom.layouts.base import PhantomFrame, WallPoints
from tests.commands import run
from tests.phantom.phantom_layouts import in_video_order, read

FORMAT_OF = {"c3vd-raw": "c3vd", "endogslam": "c3vd-endogslam", "pr-endo": "c3vd-endogslam"}
WIDTH, HEIGHT, COUNT = 338, 270, 9
#: Where every camera has a bright spot; camera axes, mm.
POINT = np.array([4.0, -3.0, 20.0])
#: The frame that is looked at.
INDEX = 3
DARK, SPREAD = 30, 2.0
#: Off-centre, pixels not square.
PINHOLE = Intrinsics(211.0, 205.0, 171.3, 128.6, WIDTH, HEIGHT)


def spot(lens: Lens) -> np.ndarray:
    """A dark image with a bright spot where the lens sees POINT; pixel centres at integers + 0.5. [H, W, 3]"""
    ((x, y),) = lens.project([POINT])
    across, down = np.arange(lens.width) + 0.5 - x, np.arange(lens.height) + 0.5 - y
    bright = np.exp(-(across**2 + down[:, None] ** 2) / (2.0 * SPREAD**2))
    return np.rint(DARK + 220.0 * bright).astype(np.uint8)[..., None].repeat(3, axis=2)


def spot_found(image: torch.Tensor) -> np.ndarray:
    """The middle of the bright spot: column and row. [2]"""
    light = np.maximum(image.double().mean(dim=2).numpy() - DARK - 2.0, 0.0)
    down, across = np.mgrid[: light.shape[0], : light.shape[1]] + 0.5
    return np.array([(across * light).sum(), (down * light).sum()]) / light.sum()


def poses() -> np.ndarray:
    """Camera-to-world. [N, 4, 4]"""
    result = np.tile(np.eye(4), (COUNT, 1, 1))
    result[:, 0, 3] = 0.3 * np.arange(COUNT)
    return result


def write_layout(folder: Path, name: str) -> Lens:
    """The spot in a phantom's layout: a point of the wall where frame INDEX sees it."""
    layout = phantom_layouts.get(name)()
    lens, _ = layout.lens(WIDTH, HEIGHT)
    depth = np.full((HEIGHT, WIDTH), 20.0)
    for index in range(COUNT):
        layout.write_frame(folder, PhantomFrame("video", index, spot(lens), depth))
    layout.write_sequence(folder, "video", poses(), lens)
    if layout.has_points:
        position, color = POINT + poses()[INDEX, :3, 3], np.full((1, 3), 200, np.uint8)
        layout.write_points(folder, WallPoints(position[None], color, lambda _: np.ones(1, bool)), poses(), lens)
    return lens


def check(folder: Path, name: str, wanted: Intrinsics) -> Frame:
    """The spot lies where the camera that is read projects POINT; the camera is the one that was written."""
    frame = in_video_order(read(folder, name, width=WIDTH, height=HEIGHT))[INDEX]
    camera = frame.camera.to(dtype=torch.float64)
    pixel, _ = camera.project(camera.center + torch.from_numpy(POINT)[None] @ camera.camera_to_world[:3, :3].T)
    # A lens bends the spot a little; half a pixel is ten times as much.
    np.testing.assert_allclose(spot_found(frame.image), pixel[0].numpy(), atol=0.05)
    for key, value in vars(wanted).items():
        assert getattr(camera, key) == pytest.approx(value, rel=1e-6), key
    return frame


@pytest.mark.parametrize("name", phantom_layouts)
def test_a_spot_is_read_where_a_layout_wrote_it(name, tmp_path):
    lens = write_layout(tmp_path, name)
    folder = tmp_path / "C3VD/phantom" if name == "pr-endo" else tmp_path
    # Images that a lens bends are undistorted to its nominal pinhole.
    frame = check(folder, FORMAT_OF.get(name, name), lens.pinhole)
    assert (frame.sparse_depth is not None) == (name == "colmap")
    if frame.sparse_depth is not None:
        np.testing.assert_allclose(frame.sparse_depth.pixels[0], spot_found(frame.image), atol=0.05)


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
        ("endogslam", of_params("params.npz"), -0.5),
        ("pr-endo", of_params("C3VD_endogslam_optimized/phantom/params.npz"), -0.5),
        ("nerfstudio", of_json("transforms.json"), 0.0),
        ("reim-nerf", of_json("transforms_train.json"), -0.5),
        ("rgbd", of_json("camera.json"), -0.5),
        ("endomapper", of_calibration, -0.5),
    ],
)
def test_files_count_as_their_format_does(name, stored, shift, tmp_path):
    lens = write_layout(tmp_path, name)
    assert stored(tmp_path) == pytest.approx(lens.pinhole.cx + shift, rel=1e-6)


def test_the_candidate_calibration_is_written_as_published(tmp_path):
    write_layout(tmp_path, "c3vd-v2")
    assert "\ncx = 677.739464094188\ncy = 543.057997844875\n" in (tmp_path / "camera_intrinsics.txt").read_text()


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
    write_trajectory(tmp_path / "given.tum", Trajectory(poses()), "tum")
    k = PINHOLE
    camera = ("--intrinsics", f"{k.fx},{k.fy},{k.cx},{k.cy}", "--size", f"{k.width}x{k.height}")
    assert run("poses", "convert", tmp_path / "given.tum", "-o", tmp_path / "poses", "--to", name, *camera) == 0
    assert stored(tmp_path) == pytest.approx(k.cx + shift, rel=1e-6)
    assert run("poses", "convert", tmp_path / "poses", "-o", tmp_path / "back", "--to", "nerfstudio") == 0
    for path in (tmp_path / "poses", tmp_path / "back"):
        assert vars(format_of(path).read(path).intrinsics) == pytest.approx(vars(k), rel=1e-6)
