"""A comparison whose processes are killed ends with the results of one that nobody disturbed, and repeats nothing."""

from __future__ import annotations

import os
import signal

import pytest

import coliags_plugin as cp
from coliags_plugin.config.assignments import parse_assignments
from coliags_plugin.engine.run_folder import RunFolder
from tests.comparison.small import (
    OFTEN,
    check_logs,
    hashes,
    lock_holder,
    start_compare,
    trainings,
    undisturbed_hashes,
    until,
)

pytestmark = pytest.mark.thorough

STEPS = 120
METHODS = ("coliags", "scaffold-gs-depth")


@pytest.fixture
def undisturbed(wall, tmp_path):
    return undisturbed_hashes(METHODS, wall, tmp_path / "undisturbed", STEPS)


def driver(wall, folder):
    return start_compare(METHODS, wall, folder, STEPS, "--jobs", 2)


def process_of(folder, method):
    """The worker that has the run of a method; None if none has, be it that the run is done."""
    return lock_holder(folder, f"runs/wall/{method}/.*.lock")


def run_of(folder, method):
    """The run folder of a method, once there is one with so many steps."""
    folders = [path for path in folder.glob(f"runs/wall/{method}/s0-*") if RunFolder(path).logged_step > 20]
    return folders[0] if folders else None


def alive(process):
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_comparison_that_is_asked_to_stop_saves_its_runs(wall, undisturbed, tmp_path, number):
    folder = tmp_path / "stopped"
    first = driver(wall, folder)
    until("step", lambda: run_of(folder, "coliags") and run_of(folder, "scaffold-gs-depth"))
    os.kill(first.pid, number)
    _, messages = first.communicate()
    assert first.returncode == 130
    assert "stopped with 0 of 2 cells done; the same command goes on where it stopped" in messages
    runs = sorted(folder.glob("runs/wall/*/s0-*"))
    saved = {run.relative_to(folder / "runs").as_posix(): RunFolder(run).step for run in runs}
    assert list(saved.values()) == [RunFolder(run).logged_step for run in runs], "the last step that was taken is saved"
    last = driver(wall, folder)
    last.communicate()
    assert last.returncode == 0 and hashes(folder) == undisturbed
    assert trainings(folder) == {run: [0, step] for run, step in saved.items()}


def test_killed_worker_and_killed_driver(wall, undisturbed, tmp_path):
    folder = tmp_path / "killed"
    first = driver(wall, folder)
    until("step", lambda: run_of(folder, "coliags"))
    struck = process_of(folder, "coliags")
    os.kill(struck, signal.SIGKILL)
    until("retry", lambda: process_of(folder, "coliags") not in (None, struck))
    workers = [worker for method in METHODS if (worker := process_of(folder, method))]
    first.kill()
    _, messages = first.communicate()
    assert "SIGKILL" in messages and "trying again" in messages
    until("end of the workers", lambda: not any(map(alive, workers)))

    options = {"steps": STEPS, "settings": parse_assignments(OFTEN), "jobs": 2, "threads": 1, "device": "cpu"}
    assert not cp.compare(METHODS, wall, folder, **options).failures
    assert hashes(folder) == undisturbed
    check_logs(folder, STEPS)
    assert any(len(begun) > 1 for begun in trainings(folder).values())

    before = trainings(folder)
    cp.compare(METHODS, wall, folder, **options)
    assert trainings(folder) == before, "what is done is not run again"
