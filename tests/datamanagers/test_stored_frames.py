"""Frames on disk: when they are read, how often, what they keep, and from how many threads."""

from __future__ import annotations

import gc
import weakref
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scene_files import parallel_map
from coliags_plugin.core.scenes import Frame, PixelTensors
from coliags_plugin.datamanagers import shots
from coliags_plugin.datamanagers.reading.depth import ScaledDepth
from coliags_plugin.datamanagers.shots import StoredPixels
from tests.datamanagers.wall_scenes import FRAMES, HEIGHT, WIDTH, manager, names, poses


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
    source = StoredPixels(shot, keep, recording.seen["video"].get(index))
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
