"""Confidence in estimated depth: read by the rgbd and nerfstudio data managers, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from coliags_plugin.config.registry import datamanagers
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scenes import Frame, concatenate_targets
from coliags_plugin.datamanagers.reading.images import resize_nearest
from coliags_plugin.datamanagers.recognition import find_format
from coliags_plugin.datamanagers.recorded import RecordedDataManager
from tests.datamanagers.spoiling import HEIGHT, WIDTH, change_json, files
from tests.scenes import camera_at

PIXELS = WIDTH * HEIGHT


def stored(index: int) -> np.ndarray:
    """Confidence of frame ``index``, all of 0..255. [H, W]"""
    return np.roll(np.arange(PIXELS) % 256, 7 * index).astype(np.uint8).reshape(HEIGHT, WIDTH)


def manager(folder: Path, **options) -> RecordedDataManager:
    kind = datamanagers.get(find_format(folder))
    return kind(kind.Settings(**options))


@pytest.fixture(params=["rgbd-by-order", "nerfstudio"])
def folder(request, copied) -> Path:
    """A scene whose depth has a confidence; nerfstudio's without its lens, which resamples images."""
    scene = copied(request.param)
    for index, path in enumerate(files(scene, "depth/*.png")):
        (scene / "confidence").mkdir(exist_ok=True)
        cv2.imwrite(str(scene / "confidence" / path.name), stored(index))
    if request.param == "nerfstudio":
        plain = {"k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0}
        change_json("transforms.json", lambda content: content.update(plain))(scene)
        edit(
            scene,
            lambda _, entry: entry.update(confidence_file_path=entry["depth_file_path"].replace("depth", "confidence")),
        )
    return scene


def edit(folder: Path, change) -> None:
    """Change the entries of transforms.json."""
    change_json("transforms.json", lambda content: [change(*entry) for entry in enumerate(content["frames"])])(folder)


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
    cv2.imwrite(str(files(folder, "confidence/*.png")[3]), np.zeros((HEIGHT, WIDTH), np.uint8))
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


@pytest.mark.parametrize("folder", ["rgbd-by-order"], indirect=True)
def test_depth_none_ignores_it(folder):
    shots = manager(folder, depth="none").open(folder).shots
    assert all(shot.confidence is None and shot.depth is None for shot in shots)


def test_initial_points_are_fused_from_trusted_depth(folder):
    without_any = files(folder, "confidence/*.png")[1]
    cv2.imwrite(str(without_any), np.full((HEIGHT, WIDTH), 127, np.uint8))
    scene = manager(folder).load(folder)
    known = {frame.index: torch.isfinite(frame.depth).numpy() for frame in scene.train}
    trusted = {index: pixels & (stored(index) >= 128) if index != 1 else pixels for index, pixels in known.items()}
    assert len(scene.points) == sum(pixels.sum() for pixels in trusted.values())


# Refused


def test_confidence_for_some_frames_only(folder):
    if (folder / "transforms.json").is_file():
        edit(folder, lambda index, entry: entry.pop("confidence_file_path") if index == 4 else None)
        said = r"10 of 11 frames have a confidence_file_path; images/frame_00005\.png has not"
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
        (np.zeros((HEIGHT // 2, WIDTH // 2), np.uint8), r"confidence/\S*\.png is 32 x 25, but .* says 64 x 51"),
        (np.zeros((HEIGHT, WIDTH), np.uint16), r"confidence/\S*\.png is an image of 1 channel of uint16.*255 = 1"),
        (np.zeros((HEIGHT, WIDTH, 3), np.uint8), r"confidence/\S*\.png is an image of 3 channels"),
    ],
)
def test_another_size_or_kind_of_image(folder, values, said):
    cv2.imwrite(str(files(folder, "confidence/*.png")[2]), values)
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
