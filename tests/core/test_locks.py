"""Locks between processes: one holder at a time, named by the others, and freed however it ends."""

from __future__ import annotations

import logging
import os
import subprocess
import sys

import pytest

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.locks import LockedError, locked

HOLDER = """if True:
    import sys, time
    from pathlib import Path
    from coliags_plugin.core.locks import locked
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
    """Which Windows does not have; torch and filelock do without it."""
    code = """if True:
        import sys
        import torch, filelock
        sys.modules["fcntl"] = None
        import coliags_plugin.comparison.compare, coliags_plugin.pipeline.reconstruct
    """
    subprocess.run([sys.executable, "-c", code], check=True)
