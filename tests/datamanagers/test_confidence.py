"""Confidence in estimated depth: read by the rgbd and nerfstudio data managers, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scenes import Frame, concatenate_targets
from coliags_plugin.datamanagers.nerfstudio.reader import NerfstudioDataManager, NerfstudioSettings
from coliags_plugin.datamanagers.reading.images import resize_nearest
from coliags_plugin.datamanagers.recorded import RecordedDataManager
from coliags_plugin.datamanagers.rgbd.reader import RGBDDataManager, RGBDSettings
from coliags_plugin.geometry.poses import tum
from coliags_plugin.geometry.poses.rigid import FLIP_Y_AND_Z
from coliags_plugin.geometry.poses.trajectory import Trajectory
from tests.datamanagers.wall_scenes import PINHOLE, look, poses, rays
from tests.scenes import camera_at

WIDTH, HEIGHT, COUNT = 64, 48, 9
#: Steps per mm.
SCALE = 1000.0


def stored(index: int) -> np.ndarray:
    """Confidence of frame ``index``, all of 0..255. [H, W]"""
    return np.roll(np.arange(WIDTH * HEIGHT) % 256, 7 * index).astype(np.uint8).reshape(HEIGHT, WIDTH)


def write_frames(folder: Path, place: str) -> None:
    for name in (place, "depth", "confidence"):
        (folder / name).mkdir(parents=True)
    for index, pose in enumerate(poses(COUNT)):
        depth, color = look(pose, rays(PINHOLE))
        cv2.imwrite(str(folder / place / f"{index}.png"), color[..., ::-1])
        cv2.imwrite(str(folder / "depth" / f"{index}.png"), np.rint(depth * SCALE).astype(np.uint16))
        cv2.imwrite(str(folder / "confidence" / f"{index}.png"), stored(index))


def write_rgbd(folder: Path) -> Path:
    write_frames(folder, "rgb")
    tum.write(folder / "groundtruth.txt", Trajectory(poses(COUNT), timestamps=np.arange(COUNT, dtype=float)))
    center = {"cx": PINHOLE.cx - 0.5, "cy": PINHOLE.cy - 0.5}
    size = {"w": WIDTH, "h": HEIGHT, "depth_scale": SCALE}
    (folder / "camera.json").write_text(json.dumps({"fx": PINHOLE.fx, "fy": PINHOLE.fy, **center, **size}))
    return folder


def write_nerfstudio(folder: Path) -> Path:
    write_frames(folder, "images")
    frames = [
        {
            "file_path": f"images/{index}.png",
            "depth_file_path": f"depth/{index}.png",
            "confidence_file_path": f"confidence/{index}.png",
            "transform_matrix": (pose @ FLIP_Y_AND_Z).tolist(),
        }
        for index, pose in enumerate(poses(COUNT))
    ]
    camera = {"fl_x": PINHOLE.fx, "fl_y": PINHOLE.fy, "cx": PINHOLE.cx, "cy": PINHOLE.cy, "w": WIDTH, "h": HEIGHT}
    content = {"camera_model": "PINHOLE", **camera, "depth_unit_scale_factor": 1 / SCALE, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def manager(folder: Path, **options) -> RecordedDataManager:
    size = {"width": WIDTH, "height": HEIGHT}
    if (folder / "transforms.json").is_file():
        return NerfstudioDataManager(NerfstudioSettings(**{**size, **options}))
    return RGBDDataManager(RGBDSettings(**{**size, **options}))


@pytest.fixture(params=[write_rgbd, write_nerfstudio])
def folder(request, tmp_path):
    return request.param(tmp_path / "wall")


def edit(folder: Path, change) -> None:
    """Change the entries of transforms.json."""
    path = folder / "transforms.json"
    content = json.loads(path.read_text())
    for index, entry in enumerate(content["frames"]):
        change(index, entry)
    path.write_text(json.dumps(content))


@pytest.mark.parametrize("keep", [True, False])
def test_stored_values_are_255ths(folder, keep):
    scene = manager(folder, keep_pixels=keep).load(folder)
    assert scene.provenance["depth_is_estimated"] is True
    for frame in [*scene.train, *scene.test_sets["test"]]:
        expected = torch.from_numpy(stored(frame.index)).float() / 255.0
        for values in (frame.depth_confidence, frame.to("cpu").depth_confidence, frame.target.depth_confidence):
            torch.testing.assert_close(values, expected, rtol=0, atol=1e-7)


def test_it_is_resized_by_the_nearest_like_depth(folder):
    frame = manager(folder, width=40, height=30).load(folder).train[0]
    expected = resize_nearest(stored(frame.index), 40, 30)
    np.testing.assert_array_equal(np.rint(frame.depth_confidence.numpy() * 255), expected)
    assert frame.depth.shape == (30, 40)


def test_it_is_part_of_the_fingerprint(folder):
    before = manager(folder).fingerprint(folder)
    file = folder / "confidence" / "3.png"
    cv2.imwrite(str(file), np.zeros((HEIGHT, WIDTH), np.uint8))
    assert manager(folder).fingerprint(folder) != before


def test_without_it_depth_is_true(folder):
    edit_or_remove(folder)
    scene = manager(folder).load(folder)
    assert scene.provenance["depth_is_estimated"] is False
    assert scene.train[0].depth_confidence is None and scene.train[0].depth is not None


def edit_or_remove(folder: Path) -> None:
    if (folder / "transforms.json").is_file():
        edit(folder, lambda index, entry: entry.pop("confidence_file_path"))
    else:
        (folder / "confidence").rename(folder / "aside")


def test_depth_none_ignores_it(tmp_path):
    folder = write_rgbd(tmp_path / "wall")
    shots = manager(folder, depth="none").open(folder).shots
    assert all(shot.confidence is None and shot.depth is None for shot in shots)


def test_initial_points_are_fused_from_trusted_depth(folder):
    cv2.imwrite(str(folder / "confidence" / "1.png"), np.full((HEIGHT, WIDTH), 127, np.uint8))  # a frame without any
    scene = manager(folder).load(folder)
    trusted = {frame.index: int((stored(frame.index) >= 128).sum()) for frame in scene.train}
    trusted[1] = WIDTH * HEIGHT
    assert len(scene.points) == sum(trusted.values())


# Refused


def test_confidence_for_some_frames_only(folder):
    if (folder / "transforms.json").is_file():
        edit(folder, lambda index, entry: entry.pop("confidence_file_path") if index == 4 else None)
        said = r"8 of 9 frames have a confidence_file_path; images/4\.png has not"
    else:
        (folder / "confidence" / "4.png").unlink()
        said = r"confidence has no confidence for 4\.png"
    with pytest.raises(InputError, match=said):
        manager(folder).load(folder)


def test_confidence_without_depth(folder):
    if (folder / "transforms.json").is_file():
        edit(folder, lambda index, entry: entry.pop("depth_file_path"))
        said = "have a confidence_file_path, but no depth_file_path"
    else:
        (folder / "depth").rename(folder / "aside")
        said = "holds confidence/, but no depth"
    with pytest.raises(InputError, match=said):
        manager(folder).load(folder)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        (np.zeros((HEIGHT // 2, WIDTH // 2), np.uint8), r"confidence/2\.png is 32 x 24, but .* says 64 x 48"),
        (np.zeros((HEIGHT, WIDTH), np.uint16), r"confidence/2\.png is an image of 1 channel of uint16.*255 = 1"),
        (np.zeros((HEIGHT, WIDTH, 3), np.uint8), r"confidence/2\.png is an image of 3 channels"),
    ],
)
def test_another_size_or_kind_of_image(folder, values, said):
    cv2.imwrite(str(folder / "confidence" / "2.png"), values)
    with pytest.raises(InputError, match=said):
        manager(folder).load(folder)


# Targets


@pytest.fixture
def frame():
    generator = torch.Generator().manual_seed(0)
    image = torch.randint(0, 256, (5, 6, 3), generator=generator, dtype=torch.uint8)
    depth, confidence = torch.rand(2, 5, 6, generator=generator)
    return Frame("0001", 1, image, camera_at(0.0, 0.0, 0.0, 6, 5), 20 + depth, depth_confidence=confidence)


def test_targets_at_pixels_have_their_confidence(frame):
    pixels = torch.tensor([[0, 0], [5, 4], [2, 3]])
    target = frame.target_at(pixels)
    assert target.depth_confidence.tolist() == frame.depth_confidence[pixels[:, 1], pixels[:, 0]][:, None].tolist()
    assert frame.to("cpu").target_at(pixels).depth_confidence.tolist() == target.depth_confidence.tolist()


def test_concatenated_targets_trust_true_depth(frame):
    pixels = torch.tensor([[0, 0], [5, 4]])
    true = replace(frame, depth_confidence=None).target_at(pixels)
    both = concatenate_targets([frame.target_at(pixels), true])
    assert both.depth_confidence[2:].tolist() == [[1.0], [1.0]]
    assert both.depth_confidence[:2].tolist() == frame.target_at(pixels).depth_confidence.tolist()
    assert concatenate_targets([true, true]).depth_confidence is None
