"""Atomic writes under faults, kills and umasks: a target is as it was, or whole."""

from __future__ import annotations

import os
import stat

import pytest

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_folder, atomic_path, atomic_write, write_json
from tests.faults import broken_disk, content, fault, killed, no_space

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
    found = []
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
        found.append(content(target))
        if not failed:
            break
    new = found[-1]
    assert len(found) > 3
    assert new != old
    assert all(each in (old, new) for each in found)


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
