"""Frames on disk: when they are read, how often, what they keep, and from how many threads."""

from __future__ import annotations

import gc
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scenes import Frame, Scene
from coliags_plugin.datamanagers import stored_frames
from coliags_plugin.datamanagers.c3vd.reader import C3VDDataManager, C3VDSettings
from coliags_plugin.datamanagers.reading.parallel import parallel_map
from coliags_plugin.datamanagers.stored_frames import StoredFrame
from tests.datamanagers.wall_scenes import write_undistorted


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = write_undistorted(tmp_path_factory.mktemp("stored") / "wall")
    (folder / "truth" / "seen").mkdir(parents=True)
    seen = np.zeros((48, 64), np.uint8)
    seen[:, 32:] = 255
    cv2.imwrite(str(folder / "truth" / "seen" / "0008_seen.png"), seen)
    return folder


@pytest.fixture
def reads(monkeypatch):
    """Names of the colour images and of the depth files read, in order."""
    read: dict[str, list[str]] = {"image": [], "depth": []}
    rgb = stored_frames.read_rgb

    def counted(path):
        read["image"].append(path.name)
        return rgb(path)

    from coliags_plugin.datamanagers.reading.depth_formats import DepthSteps

    depth = DepthSteps.read

    def counted_depth(self, path):
        read["depth"].append(path.name)
        return depth(self, path)

    monkeypatch.setattr(stored_frames, "read_rgb", counted)
    monkeypatch.setattr(DepthSteps, "read", counted_depth)
    return read


def shots(folder: Path):
    return C3VDDataManager(C3VDSettings(width=64, height=48)).open(folder).shots


def load(folder: Path, **options) -> Scene:
    return C3VDDataManager(C3VDSettings(width=64, height=48, **options)).load(folder)


class TestLaziness:
    def test_a_frame_reads_nothing_until_asked_and_then_once(self, folder, reads):
        frame = StoredFrame(shots(folder)[3], 3)
        assert frame.name == "0003_color"
        assert frame.camera.width == 64
        assert "0003_color.png" in repr(frame)
        assert reads == {"image": [], "depth": []}
        for _ in range(3):
            assert frame.image.shape == (48, 64, 3)
            assert frame.depth.shape == (48, 64)
            assert frame.valid.all()
        assert reads == {"image": ["0003_color.png"], "depth": ["0003_depth.png"]}

    def test_opening_reads_no_pixels(self, folder, reads):
        shots(folder)
        assert reads == {"image": [], "depth": []}

    def test_loading_reads_each_file_once(self, folder, reads):
        load(folder)
        assert sorted(reads["image"]) == [f"{index:04d}_color.png" for index in range(9)]
        assert sorted(reads["depth"]) == [f"{index:04d}_depth.png" for index in range(9)]

    def test_not_keeping_reads_depth_twice_and_images_once_for_the_points(self, folder, reads):
        scene = load(folder, keep_pixels=False)
        training = [frame.name for frame in scene.train]
        assert sorted(reads["image"]) == [f"{name}.png" for name in training]
        assert sorted(reads["depth"]) == sorted(2 * [f"{name[:4]}_depth.png" for name in training])

    def test_not_keeping_reads_anew_and_only_what_is_asked_for(self, folder, reads):
        frame = StoredFrame(shots(folder)[3], 3, keep=False)
        for _ in range(2):
            frame.depth  # noqa: B018
        assert reads == {"image": [], "depth": 2 * ["0003_depth.png"]}
        for _ in range(2):
            frame.image  # noqa: B018
        assert reads["image"] == 2 * ["0003_color.png"]
        assert frame.valid.all()
        assert frame.mask is None
        assert len(reads["image"]) == 2

    def test_not_keeping_sees_what_changed_and_keeping_does_not(self, folder, tmp_path):
        mine = Path(shutil.copytree(folder, tmp_path / "wall"))
        kept, fresh = (StoredFrame(shots(mine)[2], 2, keep) for keep in (True, False))
        before = kept.image.clone()
        cv2.imwrite(str(mine / "images" / "0002_color.png"), np.full((48, 64, 3), 7, np.uint8))
        assert torch.equal(kept.image, before)
        assert (fresh.image == 7).all()

    def test_both_give_the_same_scene(self, folder):
        kept, fresh = (load(folder, keep_pixels=keep) for keep in (True, False))
        assert torch.equal(kept.points.positions, fresh.points.positions)
        assert torch.equal(kept.points.colors, fresh.points.colors)
        for one, other in zip(kept.train, fresh.train, strict=True):
            assert torch.equal(one.image, other.image)
            torch.testing.assert_close(one.depth, other.depth, equal_nan=True)


class TestTypes:
    def test_what_is_kept_is_as_small_as_on_disk(self, folder):
        frame = StoredFrame(shots(folder)[8], 8)
        assert frame.image.dtype == torch.uint8
        assert frame.depth.dtype == torch.float32
        assert frame.seen.dtype == torch.bool
        kept = frame._pixels
        assert kept.depth.dtype == np.uint16
        assert kept.mask is None
        assert sum(part.nbytes for part in (kept.image, kept.depth, kept.seen)) == 64 * 48 * (3 + 2 + 1)

    def test_frames_of_a_lens_share_its_mask(self, tmp_path):
        from wall_scenes import write_raw

        raw = write_raw(tmp_path / "raw", count=3)
        frames = [
            StoredFrame(shot, place)
            for place, shot in enumerate(
                C3VDDataManager(C3VDSettings(width=90, height=72, focal_scale=0.4)).open(raw).shots
            )
        ]
        assert frames[0].mask.data_ptr() == frames[1].mask.data_ptr()

    @pytest.mark.parametrize("keep", [True, False])
    def test_to(self, folder, reads, keep):
        frame = StoredFrame(shots(folder)[8], 8, keep)
        moved = frame.to("cpu")
        assert type(moved) is Frame
        assert reads == {"image": ["0008_color.png"], "depth": ["0008_depth.png"]}
        assert (moved.name, moved.index) == (frame.name, frame.index)
        assert torch.equal(moved.image, frame.image)
        torch.testing.assert_close(moved.depth, frame.depth, equal_nan=True)
        assert torch.equal(moved.seen, frame.seen)
        assert not moved.seen[:, :32].any()
        assert moved.seen[:, 32:].all()
        assert moved.mask is None
        assert moved.depth_at_least is None
        assert torch.equal(moved.camera.camera_to_world, frame.camera.camera_to_world)

    def test_to_another_device(self, folder):
        moved = StoredFrame(shots(folder)[8], 8).to("meta")
        assert {moved.image.device.type, moved.depth.device.type, moved.seen.device.type} == {"meta"}
        assert moved.camera.camera_to_world.device.type == "meta"

    def test_what_is_kept_goes_with_the_frame(self, folder):
        frame = StoredFrame(shots(folder)[0], 0)
        frame.image  # noqa: B018
        pixels = frame._pixels
        del frame
        gc.collect()
        assert [holder for holder in gc.get_referrers(pixels) if isinstance(holder, StoredFrame)] == []


class TestThreads:
    @pytest.mark.parametrize("keep", [True, False])
    def test_many_threads_at_one_frame_see_the_same(self, folder, keep):
        frame = StoredFrame(shots(folder)[4], 4, keep)
        alone = StoredFrame(shots(folder)[4], 4)
        with ThreadPoolExecutor(16) as pool:
            images = list(pool.map(lambda _: frame.image, range(64)))
            depths = list(pool.map(lambda _: frame.to("cpu").depth, range(64)))
        assert all(torch.equal(image, alone.image) for image in images)
        assert all(torch.equal(depth, alone.depth) for depth in depths)

    def test_results_come_in_order_and_progress_is_told(self):
        told = []
        squares = parallel_map(lambda number: number**2, list(range(50)), "square", lambda *said: told.append(said))
        assert squares == [number**2 for number in range(50)]
        assert told == [("square", done, 50) for done in range(1, 51)]
        assert parallel_map(lambda number: number, [], "nothing") == []

    def test_the_first_failure_is_raised_and_the_rest_left_undone(self):
        begun = []

        def work(number):
            begun.append(number)
            if number == 1:
                raise InputError("one", "two")

        with pytest.raises(InputError, match="one"):
            parallel_map(work, list(range(5000)), "work")
        assert len(begun) < 5000

    @pytest.mark.parametrize("keep_pixels", [True, False])
    def test_loading_tells_how_far_it_is(self, folder, keep_pixels):
        told = []
        C3VDDataManager(C3VDSettings(width=64, height=48, keep_pixels=keep_pixels)).load(
            folder, lambda *said: told.append(said)
        )
        assert ("read images", 9, 9) in told or not keep_pixels
        assert ("fuse depth", 7, 7) in told
        assert all(0 < done <= total for _, done, total in told)
