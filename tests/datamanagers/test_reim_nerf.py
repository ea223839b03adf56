"""Particular to REIM-NeRF's data: normalised poses, distance along the ray, its mask and its split."""

from __future__ import annotations

import json
import math
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from coliags_plugin.geometry.lenses.models import LENSES
from coliags_plugin.geometry.lenses.undistortion import undistortion_map
from tests.datamanagers.kinds import change_frames, remove
from tests.datamanagers.wall_scenes import FRAMES, HEIGHT, WIDTH, load_scene, manager, names, poses, write_wall

KIND = "reim-nerf"
LENS = LENSES["fisheye"].resized(WIDTH, HEIGHT)

load = partial(load_scene, KIND)


def content_of(folder: Path, part: str = "test") -> dict:
    return json.loads((folder / f"transforms_{part}.json").read_text())


def cosines() -> np.ndarray:
    """Ratio of z-depth to distance, at the rays that the preprocessing takes: those of integers + 0.5, by OpenCV."""
    row, column = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    calibrated = LENSES["fisheye"]
    bends = np.array([calibrated.k1, calibrated.k2, calibrated.k3, calibrated.k4])
    pixels = np.stack([column.ravel(), row.ravel()], 1)[None]
    tangents = cv2.fisheye.undistortPoints(pixels, LENS.pinhole.opencv_matrix(), bends)[0]
    return 1.0 / np.hypot(1.0, np.linalg.norm(tangents, axis=1)).reshape(HEIGHT, WIDTH)


def step(folder: Path) -> float:
    """Length of a step along the ray, mm."""
    content = content_of(folder)
    return content["distmap_scale"] / 65535 / content["scene_scale"]


@pytest.fixture
def folder(walls):
    return walls(KIND)


def test_its_own_split_leaves_validation_out(tmp_path):
    folder = write_wall(tmp_path, KIND, 27)
    scene = load(folder)
    assert names(scene.train) == [f"{index:04d}_color" for index in (0, 5, 10, 15, 20)]
    assert [frame.index for frame in scene.test_sets["test"]] == [index for index in range(27) if index % 5]
    assert scene.provenance.parts == {"train": 5, "val": 1, "test": 27, "true_test": 21}
    remove("transforms_true_test.json")(folder)
    other = load(folder, split="every-8th", initial_points="none")
    assert len(other.video) == 27
    assert [frame.index for frame in other.test_sets["test"]] == [0, 8, 16, 24]
    assert manager(KIND).recognise(folder) == "transforms_train.json beside distmaps"


def test_stored_poses_are_normalised_and_opengl(folder):
    content = content_of(folder)
    stored = np.array([frame["transform_matrix"] for frame in content["frames"]])
    assert np.abs(stored[:, :3, 3]).max() < 1.0
    np.testing.assert_allclose(stored[:, :3, 2], -poses(FRAMES)[:, :3, 2], atol=1e-12)
    shift = np.array(content["scene_T"])[:3, 3]
    np.testing.assert_allclose(stored[:, :3, 3] / content["scene_scale"] - shift, poses(FRAMES)[:, :3, 3], atol=1e-9)


def test_working_depth_is_that_of_the_nearest_stored_pixel(folder):
    frame = load(folder).train[1]
    stored = cv2.imread(str(folder / "distmaps" / f"{frame.name}.png"), cv2.IMREAD_UNCHANGED)
    columns, rows = (np.rint(part).astype(int) for part in undistortion_map(LENS, LENS.pinhole))
    expected = (stored * step(folder) * cosines())[rows, columns]
    finite = torch.isfinite(frame.depth).numpy()
    assert finite.mean() > 0.9
    np.testing.assert_allclose(frame.depth.numpy()[finite], expected[finite], atol=2e-4)


def test_what_ends_at_c3vds_range_is_there_or_beyond(mine):
    """A wall at C3VD's 100 mm on the left, one just before it in the middle, and none on the right."""
    z = np.full((HEIGHT, WIDTH), 99.9)
    z[:, : WIDTH // 3] = 100.0
    steps = np.floor(z / np.maximum(cosines(), 0.05) / step(mine))
    steps[:, 2 * WIDTH // 3 :] = 0
    cv2.imwrite(str(mine / "distmaps/0000_color.png"), steps.astype(np.uint16))
    cv2.imwrite(str(mine / "distmaps/0005_color.png"), np.full((HEIGHT, WIDTH), 9000, np.uint16))
    spoilt, unclipped, _ = load(mine).train
    clipped, middle, right = (np.s_[10:20, start : start + 6] for start in (2, 17, 31))
    depth, bound = spoilt.depth, spoilt.depth_at_least
    assert torch.isnan(depth[clipped]).all() and torch.isnan(depth[right]).all()
    torch.testing.assert_close(depth[middle], torch.full((10, 6), 99.9), atol=step(mine), rtol=0)
    torch.testing.assert_close(bound[clipped], torch.full((10, 6), 100.0), atol=step(mine), rtol=0)
    assert torch.isnan(bound[middle]).all() and torch.isnan(bound[right]).all()
    assert unclipped.depth_at_least is None


def test_without_distances_points_come_from_a_file(mine):
    change_frames("transforms_*.json", lambda _, entry: entry.pop("distmap_path"))(mine)
    np.savez(mine / "points.npz", positions=np.ones((3, 3)))
    scene = load(mine, initial_points="file", points_file="points.npz")
    assert scene.train[0].depth is None and len(scene.points) == 3
    assert math.isclose(scene.provenance.pose_convention["scene_scale"], content_of(mine)["scene_scale"])
