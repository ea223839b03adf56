"""A comparison whose processes are killed ends with the results of one that nobody disturbed, and repeats nothing."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time

import pytest
import torch

import coliags_plugin as cp
from coliags_plugin.config.assignments import parse_assignments
from coliags_plugin.engine.run_folder import RunFolder
from tests.comparison.small import TINY, compare_inline, hashes, trainings
from tests.scenes import write_wall

pytestmark = pytest.mark.thorough

STEPS = 120
METHODS = ("coliags", "scaffold-gs-depth")
OFTEN = (*TINY, "schedule.checkpoint_every=10")
DEADLINE = 120.0


@pytest.fixture
def wall(tmp_path):
    return write_wall(tmp_path / "wall")


@pytest.fixture
def undisturbed(wall, tmp_path):
    torch.set_num_threads(1)
    done = compare_inline(METHODS, [wall], tmp_path / "undisturbed", steps=STEPS, overrides=OFTEN)
    assert not done.failures
    return hashes(tmp_path / "undisturbed")


def driver(wall, folder):
    """``coliags compare`` as a process, alone in its group."""
    words = ["compare", *METHODS, "--scenes", wall, "--output", folder, "--steps", STEPS, "--jobs", 2, "--threads", 1]
    sets = [word for each in OFTEN for word in ("--set", each)]
    code = "from coliags_plugin.cli import main; main()"
    command = [sys.executable, "-c", code, *map(str, words), "--device", "cpu", *sets]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)


def until(what, value):
    """Wait until a function of no argument returns something true, and return that."""
    end = time.monotonic() + DEADLINE
    while not (found := value()):
        assert time.monotonic() < end, f"no {what}"
        time.sleep(0.005)
    return found


def step_of(run):
    """Steps that a run has logged."""
    log = run / "metrics.jsonl"
    return len(log.read_text(encoding="utf-8").splitlines()) if log.is_file() else 0


def process_of(folder, method):
    """The worker that has the run of a method."""
    (lock,) = folder.glob(f"runs/wall/{method}/.*.lock")
    return int(until("name in the lock", lambda: lock.read_text(encoding="utf-8")).split()[1])


def run_of(folder, method):
    """The run folder of a method, once there is one with so many steps."""
    found = [path for path in folder.glob(f"runs/wall/{method}/s0-*") if step_of(path) > 20]
    return found[0] if found else None


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
    _, told = first.communicate()
    assert first.returncode == 130
    assert "stopped with 0 of 2 cells done; the same command goes on where it stopped" in told
    runs = sorted(folder.glob("runs/wall/*/s0-*"))
    saved = {run.relative_to(folder / "runs").as_posix(): RunFolder(run).step for run in runs}
    assert list(saved.values()) == list(map(step_of, runs)), "the last step that was taken is saved"
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
    until("retry", lambda: process_of(folder, "coliags") != struck)
    workers = [process_of(folder, method) for method in METHODS]
    first.kill()
    _, told = first.communicate()
    assert "SIGKILL" in told and "trying again" in told
    until("end of the workers", lambda: not any(map(alive, workers)))

    options = {"steps": STEPS, "settings": parse_assignments(OFTEN), "jobs": 2, "threads": 1, "device": "cpu"}
    assert not cp.compare(METHODS, wall, folder, **options).failures
    assert hashes(folder) == undisturbed
    for run, begun in trainings(folder).items():
        log = [json.loads(line)["step"] for line in (folder / "runs" / run / "metrics.jsonl").read_text().splitlines()]
        assert log == list(range(1, STEPS + 1))
        assert begun == sorted(set(begun)) and begun[0] == 0, "a run goes on from further and further steps"
    assert any(len(begun) > 1 for begun in trainings(folder).values())

    before = trainings(folder)
    cp.compare(METHODS, wall, folder, **options)
    assert trainings(folder) == before, "what is done is not run again"
