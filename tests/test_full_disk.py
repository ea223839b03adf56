"""Writers of other libraries on a disk that is full: a limit on the size of files stands for it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_folder
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.engine.checkpoints import save_tensors
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.geometry.poses import colmap
from coliags_plugin.geometry.poses.trajectory import Trajectory
from coliags_plugin.outputs.video import write_video
from tests.faults import content, largest_file

pytestmark = pytest.mark.thorough

FRAMES = np.random.default_rng(0).integers(0, 255, (12, 48, 64, 3)).astype(np.uint8)


def a_trajectory(count):
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 2, 3] = np.arange(count)
    names = tuple(f"{index:04d}.png" for index in range(count))
    return Trajectory(poses, names=names, intrinsics=Intrinsics(50.0, 50.0, 32.0, 24.0, 64, 48))


def colmap_binary(target, count):
    colmap.write(target, a_trajectory(count))


def colmap_text(target, count):
    colmap.write_text(target, a_trajectory(count))


def video(target, count):
    write_video(FRAMES[:count], target.with_suffix(".mp4"), 10.0)


def checkpoint(target, count):
    with atomic_folder(target, overwrite=True) as scratch:
        save_tensors({"a": torch.arange(100.0 * count)}, scratch / "state.safetensors")


@pytest.mark.parametrize("write", [colmap_binary, colmap_text, video, checkpoint])
def test_what_was_there_stays_until_all_fits(tmp_path, write):
    target = tmp_path / "target"

    def found():
        return content(target) if target.exists() else content(target.with_suffix(".mp4"))

    write(target, 5)
    old = found()
    write(target, 9)
    new = found()
    assert old != new
    refused = 0
    for size in (0, 1, 40, 100, 300, 500, 700, 1000, 2000, 4000, 8000, 16000, 10**9):
        write(target, 5)
        with largest_file(size):
            try:
                write(target, 9)
            except InputError as error:
                refused += 1
                assert "space" in str(error)
                assert found() == old
                continue
        assert found() == new
    assert refused >= 3
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
def test_the_training_log_on_a_full_disk_is_a_message(tmp_path):
    run = RunFolder(tmp_path)
    run.log_file.symlink_to("/dev/full")
    with pytest.raises(InputError, match="No space left"):
        run.log({"step": 1})


def test_a_training_log_that_is_no_file_is_a_message(tmp_path):
    run = RunFolder(tmp_path)
    run.log_file.symlink_to("metrics.jsonl")
    with pytest.raises(InputError, match="cannot write"):
        run.log({"step": 1})
