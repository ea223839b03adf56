"""Frames on disk: when they are read, how often, what they keep, from how many threads; confidence in depth."""

from __future__ import annotations

import gc
import weakref
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scene_files import parallel_map
from coliags_plugin.core.scenes import Frame, PixelTensors, concatenate_targets
from coliags_plugin.datamanagers import shots
from coliags_plugin.datamanagers.file_formats import ScaledDepth, resize_nearest
from coliags_plugin.datamanagers.shots import StoredPixels
from coliags_plugin.engine.data_formats import find_format
from tests.datamanagers.kinds import change_frames, change_json, files, half_size, remove, repaint
from tests.datamanagers.wall_scenes import FRAMES, HEIGHT, WIDTH, manager, names, poses
from tests.scenes import camera_at


@pytest.fixture
def folder(walls):
    return walls("c3vd")


@pytest.fixture
def reads(monkeypatch):
    """Names of the colour images and of the depth files read, in order."""
    read: list[str] = []

    def counted(function):
        def call(*arguments):
            read.append(arguments[-1].name)
            return function(*arguments)

        return call

    monkeypatch.setattr(shots, "read_rgb", counted(shots.read_rgb))
    monkeypatch.setattr(ScaledDepth, "read", counted(ScaledDepth.read))
    return read


def frame_of(folder: Path, index: int, keep: bool = True) -> Frame:
    recording = manager("c3vd").open(folder)
    shot = recording.shots[index]
    seen = folder / f"truth/seen/{index:04d}_seen.png"
    source = StoredPixels(shot, keep, seen if seen.is_file() else None)
    return Frame(shot.name, index, source, shot.rectification.camera(shot.camera_to_world))


def test_a_frame_reads_nothing_until_asked_and_then_once_or_anew_where_pixels_are_not_kept(folder, reads):
    frame = frame_of(folder, 3)
    assert (frame.name, frame.camera.width) == ("0003_color", WIDTH)
    pose = frame.scaled(2.0).source.camera_to_world
    np.testing.assert_allclose(pose[:3, 3], 2.0 * poses(FRAMES)[3][:3, 3], rtol=1e-6)
    assert reads == []
    for _ in range(3):
        assert frame.image.shape == (HEIGHT, WIDTH, 3)
        assert frame.depth.shape == (HEIGHT, WIDTH)
        assert frame.valid.all()
    assert sorted(reads) == ["0003_color.png", "0003_depth.png"]
    reads.clear()
    frame = frame_of(folder, 3, keep=False)
    for part in ("depth", "depth", "image", "image", "valid"):
        getattr(frame, part)
    assert frame.mask is None
    assert reads == 2 * ["0003_depth.png"] + 2 * ["0003_color.png"]


@pytest.mark.parametrize("keep", [True, False])
def test_loading_reads_each_file_once_or_for_the_points_alone_and_tells_how_far_it_is(folder, reads, keep):
    calls = []
    training = names(manager("c3vd", keep_pixels=keep).load(folder, lambda *call: calls.append(call)).train)
    if keep:
        numbers = [*range(FRAMES), 0, 1]  # and the turned views
        assert sorted(reads) == sorted(f"{index:04d}_{kind}.png" for index in numbers for kind in ("color", "depth"))
    else:
        assert sorted(reads) == sorted(
            f"{name[:4]}_{kind}.png" for name in training for kind in ("color", "depth", "depth")
        )
    assert (("read images", FRAMES + 2, FRAMES + 2) in calls) == keep
    assert ("fuse depth", FRAMES - 2, FRAMES - 2) in calls
    assert all(0 < done <= total for _, done, total in calls)


def test_frames_of_a_lens_share_its_mask(walls):
    frames = manager("c3vd", focal_scale=0.4).load(walls("c3vd-raw")).train
    assert frames[0].mask.data_ptr() == frames[1].mask.data_ptr()


@pytest.mark.parametrize("keep", [True, False])
def test_to_a_device(folder, reads, keep):
    frame = frame_of(folder, 8, keep)
    moved = frame.to("cpu")
    assert type(moved.source) is PixelTensors and (moved.name, moved.index) == (frame.name, frame.index)
    assert sorted(reads) == ["0008_color.png", "0008_depth.png"]
    for part in ("image", "depth", "seen"):
        assert torch.equal(getattr(moved, part), getattr(frame, part))
    assert torch.equal(moved.camera.camera_to_world, frame.camera.camera_to_world)
    assert moved.mask is None and moved.depth_at_least is None
    moved = frame.to("meta")
    parts = (moved.image, moved.depth, moved.seen, moved.camera.camera_to_world)
    assert {part.device.type for part in parts} == {"meta"}


def test_what_is_kept_is_as_small_as_on_disk_and_goes_with_the_frame(folder):
    frame = frame_of(folder, 8)
    assert frame.depth.dtype == torch.float32
    frame.source.preload()
    parts = frame.source._cache
    assert parts["depth"].dtype == np.uint16 and parts["mask"] is None
    assert sum(parts[name].nbytes for name in ("image", "depth", "seen")) == WIDTH * HEIGHT * (3 + 2 + 1)
    image = weakref.ref(parts["image"])
    del frame, parts
    gc.collect()
    assert image() is None


@pytest.mark.parametrize("keep", [True, False])
def test_many_threads_at_one_frame_see_the_same(folder, keep):
    frame, alone = frame_of(folder, 4, keep), frame_of(folder, 4)
    with ThreadPoolExecutor(16) as pool:
        images = list(pool.map(lambda _: frame.image, range(64)))
        depths = list(pool.map(lambda _: frame.to("cpu").depth, range(64)))
    assert all(torch.equal(image, alone.image) for image in images)
    assert all(torch.equal(depth, alone.depth) for depth in depths)


def test_results_come_in_order_and_after_a_failure_the_rest_is_left_undone():
    calls, begun = [], []
    squares = parallel_map(lambda number: number**2, list(range(50)), "square", lambda *call: calls.append(call))
    assert squares == [number**2 for number in range(50)]
    assert calls == [("square", done, 50) for done in range(1, 51)]
    assert parallel_map(lambda number: number, [], "nothing") == []

    def work(number):
        begun.append(number)
        if number == 1:
            raise InputError("one", "two")

    with pytest.raises(InputError, match="one"):
        parallel_map(work, list(range(5000)), "work")
    assert len(begun) < 5000


# Confidence in estimated depth, which rgbd and nerfstudio have, and targets


def stored(index: int) -> np.ndarray:
    """Confidence of frame ``index``, all of 0..255. [H, W]"""
    return np.roll(np.arange(WIDTH * HEIGHT) % 256, 7 * index).astype(np.uint8).reshape(HEIGHT, WIDTH)


def load(folder: Path, **options):
    return manager(find_format(folder), **options).load(folder)


@pytest.fixture(params=["rgbd-by-order", "nerfstudio"])
def estimated(request, copied) -> Path:
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
def test_stored_values_are_255ths_and_resized_by_the_nearest_like_depth(estimated, keep):
    scene = load(estimated, keep_pixels=keep)
    assert scene.provenance.depth_is_estimated is True
    for frame in scene.video:
        expected = torch.from_numpy(stored(frame.index)).float() / 255.0
        for values in (frame.depth_confidence, frame.to("cpu").depth_confidence, frame.target.depth_confidence):
            torch.testing.assert_close(values, expected, rtol=0, atol=1e-7)
        assert frame.true_depth is None
    frame = load(estimated, width=25, height=20, keep_pixels=keep).train[0]
    nearest = resize_nearest(stored(frame.index), 25, 20)
    np.testing.assert_array_equal(np.rint(frame.depth_confidence.numpy() * 255), nearest)
    assert frame.depth.shape == (20, 25)


def test_it_is_part_of_the_fingerprint_and_can_be_left_out(estimated):
    name = find_format(estimated)
    before = manager(name).fingerprint(estimated)
    cv2.imwrite(str(files(estimated, "confidence/*.png")[3]), np.zeros((HEIGHT, WIDTH), np.uint8))
    assert manager(name).fingerprint(estimated) != before
    if name == "rgbd":
        shots = manager(name, depth="none").open(estimated).shots
        assert all(shot.confidence is None and shot.depth is None for shot in shots)
        (estimated / "confidence").rename(estimated / "aside")
    else:
        change_frames("transforms.json", lambda _, entry: entry.pop("confidence_file_path"))(estimated)
    scene = load(estimated)
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
def test_confidence_that_does_not_go_with_depth_is_refused(estimated, spoil, message):
    spoil(estimated)
    with pytest.raises(InputError, match=message):
        load(estimated)


def test_initial_points_are_fused_from_trusted_depth(estimated):
    cv2.imwrite(str(files(estimated, "confidence/*.png")[1]), np.full((HEIGHT, WIDTH), 127, np.uint8))
    scene = load(estimated)
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
