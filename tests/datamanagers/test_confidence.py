"""Confidence in estimated depth: read by the rgbd and nerfstudio data managers, and passed on to targets."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scenes import Frame, concatenate_targets
from coliags_plugin.datamanagers.reading.images import resize_nearest
from coliags_plugin.engine.data_formats import find_format
from tests.datamanagers.kinds import change_frames, change_json, files, half_size, remove, repaint
from tests.datamanagers.wall_scenes import HEIGHT, WIDTH, manager
from tests.scenes import camera_at


def stored(index: int) -> np.ndarray:
    """Confidence of frame ``index``, all of 0..255. [H, W]"""
    return np.roll(np.arange(WIDTH * HEIGHT) % 256, 7 * index).astype(np.uint8).reshape(HEIGHT, WIDTH)


def load(folder: Path, **options):
    return manager(find_format(folder), **options).load(folder)


@pytest.fixture(params=["rgbd-by-order", "nerfstudio"])
def folder(request, copied) -> Path:
    """A scene whose depth has a confidence; nerfstudio's without its lens, which resamples images."""
    scene = copied(request.param)
    (scene / "confidence").mkdir()
    for index, path in enumerate(files(scene, "depth/*.png")):
        cv2.imwrite(str(scene / "confidence" / path.name), stored(index))
    if request.param == "nerfstudio":
        change_json("transforms.json", **dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0))(scene)

        def add(_: int, entry: dict) -> None:
            entry["confidence_file_path"] = entry["depth_file_path"].replace("depth", "confidence")

        change_frames("transforms.json", add)(scene)
    return scene


@pytest.mark.parametrize("keep", [True, False])
def test_stored_values_are_255ths_and_resized_by_the_nearest_like_depth(folder, keep):
    scene = load(folder, keep_pixels=keep)
    assert scene.provenance.depth_is_estimated is True
    for frame in scene.video:
        expected = torch.from_numpy(stored(frame.index)).float() / 255.0
        for values in (frame.depth_confidence, frame.to("cpu").depth_confidence, frame.target.depth_confidence):
            torch.testing.assert_close(values, expected, rtol=0, atol=1e-7)
        assert frame.true_depth is None
    frame = load(folder, width=25, height=20, keep_pixels=keep).train[0]
    nearest = resize_nearest(stored(frame.index), 25, 20)
    np.testing.assert_array_equal(np.rint(frame.depth_confidence.numpy() * 255), nearest)
    assert frame.depth.shape == (20, 25)


def test_it_is_part_of_the_fingerprint_and_can_be_left_out(folder):
    name = find_format(folder)
    before = manager(name).fingerprint(folder)
    cv2.imwrite(str(files(folder, "confidence/*.png")[3]), np.zeros((HEIGHT, WIDTH), np.uint8))
    assert manager(name).fingerprint(folder) != before
    if name == "rgbd":
        shots = manager(name, depth="none").open(folder).shots
        assert all(shot.confidence is None and shot.depth is None for shot in shots)
        (folder / "confidence").rename(folder / "aside")
    else:
        change_frames("transforms.json", lambda _, entry: entry.pop("confidence_file_path"))(folder)
    scene = load(folder)
    assert scene.provenance.depth_is_estimated is False
    assert scene.train[0].depth_confidence is None and scene.train[0].true_depth is not None


def without(part: str, place: int | None = None):
    """Leave out the files of a part, or one of them."""

    def spoil(folder: Path) -> None:
        if find_format(folder) == "rgbd":
            return remove(f"{part}/*.png", place)(folder)
        change_frames(
            "transforms.json",
            lambda index, entry: entry.pop(f"{part}_file_path") if place in (None, index) else None,
        )(folder)

    return spoil


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (without("confidence", 3), r"10 of 11 frames have a confidence(_file_path)?;"),
        (without("depth"), "confidence.*, but no depth"),
        (repaint("confidence/*.png", 2, half_size), r"confidence/\S*\.png is 20 x 16, but .* says 40 x 32"),
        (repaint("confidence/*.png", 2, np.uint16), r"confidence/\S*\.png is an image of 1 channel of uint16.*255 = 1"),
    ],
)
def test_confidence_that_does_not_go_with_depth_is_refused(folder, spoil, message):
    spoil(folder)
    with pytest.raises(InputError, match=message):
        load(folder)


def test_initial_points_are_fused_from_trusted_depth(folder):
    cv2.imwrite(str(files(folder, "confidence/*.png")[1]), np.full((HEIGHT, WIDTH), 127, np.uint8))
    scene = load(folder)
    finite = {frame.index: torch.isfinite(frame.depth).numpy() for frame in scene.train}
    trusted = {index: pixels & (stored(index) >= 128) if index != 1 else pixels for index, pixels in finite.items()}
    assert len(scene.points) == sum(pixels.sum() for pixels in trusted.values())


def test_targets_have_the_confidence_of_their_pixels():
    generator = torch.Generator().manual_seed(0)
    image = torch.randint(0, 256, (5, 6, 3), generator=generator, dtype=torch.uint8)
    depth, confidence = torch.rand(2, 5, 6, generator=generator)
    frame = Frame.of("0001", 1, image, camera_at(0.0, 0.0, 0.0, 6, 5), 20 + depth, depth_confidence=confidence)
    pixels = torch.tensor([[0, 0], [5, 4]])
    target, expected = frame.target_at(pixels), confidence[pixels[:, 1], pixels[:, 0]][:, None]
    assert torch.equal(target.depth_confidence, expected)
    assert torch.equal(frame.to("cpu").target_at(pixels).depth_confidence, expected)
    # True depth is trusted beside estimates.
    true = frame.with_maps(depth_confidence=None).target_at(pixels)
    both = concatenate_targets([target, true])
    assert torch.equal(both.depth_confidence, torch.cat([expected, torch.ones(2, 1)]))
    assert concatenate_targets([true, true]).depth_confidence is None
