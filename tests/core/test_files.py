"""Atomic writes under faults, kills and umasks, and locks between processes."""

from __future__ import annotations

import logging
import os
import stat
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_folder, atomic_path, atomic_write, write_json
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.core.jobs import LockedError, locked
from coliags_plugin.engine.checkpoints import save_tensors
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.geometry.poses import colmap
from coliags_plugin.geometry.poses.trajectory import Trajectory
from coliags_plugin.reporting.video import write_video
from tests.faults import broken_disk, content, fault, killed, largest_file, no_space

OLD, NEW = b"old" * 5000, b"new!" * 7000


def write_folder(target):
    with atomic_folder(target, overwrite=True) as folder:
        atomic_write(folder / "one", NEW)
        (folder / "part").mkdir()
        (folder / "part" / "two").write_bytes(NEW)


def by_a_library(target):
    with atomic_path(target) as path:
        path.write_bytes(NEW)


def old_file(target):
    target.write_bytes(OLD)


def old_folder(target):
    target.mkdir()
    (target / "before").write_bytes(OLD)


def nothing(target):
    del target


WRITERS = {
    "write": (lambda target: atomic_write(target, NEW), old_file),
    "library": (by_a_library, old_file),
    "folder": (write_folder, old_folder),
}
cases = pytest.mark.parametrize(
    "write, before", [(write, old) for write, there in WRITERS.values() for old in (there, nothing)]
)


def hidden(folder):
    return sorted(path.name for path in folder.iterdir() if path.name.startswith("."))


@cases
@pytest.mark.parametrize("kind", [no_space, broken_disk])
def test_every_operation_may_fail(tmp_path, write, before, kind):
    contents = []
    for number in range(100):
        target = tmp_path / str(number) / "target"
        target.parent.mkdir()
        before(target)
        old, failed = content(target), False
        with fault(number, kind) as faulty:
            try:
                write(target)
            except InputError as error:
                assert str(error).startswith((f"cannot write to {target.parent}: ", f"cannot write to {target}: "))
                failed = True
        assert failed == faulty.has_struck
        assert not hidden(target.parent)
        contents.append(content(target))
        if not failed:
            break
    new = contents[-1]
    assert len(contents) > 3
    assert new != old
    assert all(each in (old, new) for each in contents)


@cases
@pytest.mark.thorough
def test_a_kill_at_every_operation_leaves_old_or_new_and_is_swept(tmp_path, write, before):
    reference = tmp_path / "reference"
    before(reference)
    old = content(reference)
    write(reference)
    new = content(reference)
    for number in range(100):
        place = tmp_path / str(number)
        place.mkdir()
        target = place / "target"
        before(target)
        child = os.fork()
        if child == 0:
            with fault(number, killed):
                write(target)
            os._exit(0)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        if target.exists():
            assert content(target) in (old, new)
        elif old is not None:  # between the two renames of a folder: the next write finds it
            with pytest.raises(InputError, match="already exists"), atomic_folder(target):
                pass
            assert content(target) == old
        write(target)
        assert content(target) == new
        assert not hidden(place)
        if status == 0:
            break
    assert 3 <= number < 100


def test_scratch_of_a_living_process_is_kept(tmp_path):
    target = tmp_path / "target"
    with atomic_folder(target) as mine:
        (mine / "file").write_bytes(OLD)
        # Another writer of the same target; here in the same process, which holds the first lock as well.
        with atomic_folder(target, overwrite=True) as other:
            (other / "file").write_bytes(NEW)
        assert (mine / "file").read_bytes() == OLD
        assert content(target) == {"file": NEW}
        target.rename(tmp_path / "elsewhere")
    assert content(target) == {"file": OLD}
    with pytest.raises(InputError, match="already exists"), atomic_folder(target):
        pass
    assert content(target) == {"file": OLD}


def test_other_hidden_files_are_left_alone(tmp_path):
    living = f".target.{os.getppid()}-abcd0123.partial"
    names = (".target.partial", ".target.backup.partial", ".other.1234567890-abcd0123.partial", living)
    for name in (*names, ".target.1234567890-abcd0123.partial"):
        (tmp_path / name).mkdir()
    atomic_write(tmp_path / "target", NEW)
    assert hidden(tmp_path) == sorted(names)


@pytest.mark.parametrize(
    "umask, file_mode, folder_mode", [(0o022, 0o644, 0o755), (0o077, 0o600, 0o700), (0o002, 0o664, 0o775)]
)
def test_the_umask_decides_who_may_read(tmp_path, umask, file_mode, folder_mode):
    before = os.umask(umask)
    try:
        atomic_write(tmp_path / "file", NEW)
        write_folder(tmp_path / "folder")
        write_json(tmp_path / "made" / "file.json", {"a": 1})
    finally:
        os.umask(before)
    for path in tmp_path.rglob("*"):
        expected = folder_mode if path.is_dir() else file_mode
        assert stat.S_IMODE(path.stat().st_mode) == expected, path


def test_errors_of_the_block_that_are_not_the_disks_pass(tmp_path):
    with pytest.raises(FileNotFoundError), atomic_folder(tmp_path / "target"):
        (tmp_path / "missing").read_bytes()
    assert not list(tmp_path.iterdir())


# Locks between processes: one holder at a time, named by the others, and freed however it ends


HOLDER = """if True:
    import sys, time
    from pathlib import Path
    from coliags_plugin.core.jobs import locked
    with locked(Path(sys.argv[1]), "it"):
        print("held", flush=True)
        time.sleep(60)
"""


def test_a_killed_process_frees_its_lock(tmp_path, caplog):
    file = tmp_path / "deep" / "lock"
    with subprocess.Popen([sys.executable, "-c", HOLDER, str(file)], stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout.readline() == "held\n"
        name = rf"process {holder.pid} on {os.uname().nodename} since 20"
        for wait in (0.0, 0.3):
            with (
                caplog.at_level(logging.INFO),
                pytest.raises(LockedError, match=f"the run is in use by {name}"),
                locked(file, "the run", wait),
            ):
                pass
        (waiting,) = (record.message for record in caplog.records)
        assert waiting.startswith(f"waiting for process {holder.pid} on") and waiting.endswith("which has the run")
        holder.kill()
    with locked(file, "the run", wait=5.0):
        assert str(os.getpid()) in file.read_text()
    assert not file.exists()
    with locked(file, "the run"):
        pass


def test_a_lock_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot write to"), locked(tmp_path / "file" / "lock", "it"):
        pass
    (tmp_path / "folder").mkdir()
    with pytest.raises(InputError, match="cannot write to"), locked(tmp_path / "folder", "it"):
        pass


@pytest.mark.thorough
def test_no_module_needs_fcntl():
    """Windows does not have fcntl; torch and filelock do without it."""
    code = """if True:
        import sys
        import torch, filelock
        sys.modules["fcntl"] = None
        import coliags_plugin.comparison.compare, coliags_plugin.pipeline.reconstruct
    """
    subprocess.run([sys.executable, "-c", code], check=True)


# Writers of other libraries on a disk that is full: a limit on the size of files stands for it


FRAMES = np.random.default_rng(0).integers(0, 255, (12, 48, 64, 3)).astype(np.uint8)


def a_trajectory(count):
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 2, 3] = np.arange(count)
    names = tuple(f"{index:04d}.png" for index in range(count))
    return Trajectory(poses, names=names, intrinsics=Intrinsics(50.0, 50.0, 32.0, 24.0, 64, 48))


def colmap_binary(target, count):
    colmap.write(target, a_trajectory(count))


def colmap_text(target, count):
    colmap.write(target, a_trajectory(count), text=True)


def video(target, count):
    write_video(FRAMES[:count], target.with_suffix(".mp4"), 10.0)


def checkpoint(target, count):
    with atomic_folder(target, overwrite=True) as scratch:
        save_tensors({"a": torch.arange(100.0 * count)}, scratch / "state.safetensors")


@pytest.mark.thorough
@pytest.mark.parametrize("write", [colmap_binary, colmap_text, video, checkpoint])
def test_what_was_there_stays_until_all_fits(tmp_path, write):
    target = tmp_path / "target"

    def contents():
        return content(target) if target.exists() else content(target.with_suffix(".mp4"))

    write(target, 5)
    old = contents()
    write(target, 9)
    new = contents()
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
                assert contents() == old
                continue
        assert contents() == new
    assert refused >= 3
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


@pytest.mark.thorough
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
def test_the_training_log_on_a_full_disk_is_a_message(tmp_path):
    run = RunFolder(tmp_path)
    run.log_file.symlink_to("/dev/full")
    with pytest.raises(InputError, match="No space left"):
        run.log({"step": 1})
