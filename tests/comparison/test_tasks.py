"""Tasks of worker processes: JSON, environment, outcomes, and the executor of this machine."""

from __future__ import annotations

import os
import signal
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from coliags_plugin.comparison.worker import CellTask
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.engine.tasks import LocalExecutor, TaskOutcome


@pytest.fixture
def task(tmp_path):
    places = {name: tmp_path / name for name in ("data", "folder", "result", "log")}
    return CellTask(
        title="wall coliags seed 0",
        name="coliags",
        method="coliags",
        overrides=("field.features=8",),
        scene="wall",
        data_format=None,
        seed=0,
        device="cpu",
        protocol="paper",
        key="0" * 16,
        threads=3,
        variables={"COLIAGS_LPIPS_WEIGHTS": "here"},
        **places,
    )


def test_a_task_travels_as_json(task):
    assert CellTask.from_json(task.to_json()) == task


def test_the_environment_names_threads_package_and_variables(task):
    environment = task.environment({"HOME": "/home", "PYTHONPATH": "mine", "OMP_NUM_THREADS": "64"})
    assert environment["OMP_NUM_THREADS"] == environment["OPENBLAS_NUM_THREADS"] == "3"
    assert environment["COLIAGS_LPIPS_WEIGHTS"] == "here" and environment["HOME"] == "/home"
    first, second = environment["PYTHONPATH"].split(os.pathsep)
    assert second == "mine" and os.path.isdir(os.path.join(first, "coliags_plugin"))


def test_an_outcome_is_read_from_the_last_line_and_a_process_that_says_nothing_has_died():
    for outcome in (TaskOutcome("done"), TaskOutcome("failed", 'no "depth"\nat all')):
        assert TaskOutcome.read(1, f"noise\n{outcome.line()}\n") == outcome
    for returncode, printed, reason in (
        (-signal.SIGKILL, "", "was ended by SIGKILL; the system does so when memory runs out"),
        (-signal.SIGSEGV, "half a li", "was ended by SIGSEGV"),
        (0, "[1]", "ended with status 0 without a message"),
    ):
        assert TaskOutcome.read(returncode, printed) == TaskOutcome("died", f"the process {reason}")


def test_a_crash_a_scene_that_is_gone_and_a_run_that_another_process_has_are_the_reason(task, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(CellTask, "complete", lambda self: 1 / 0)
        assert task.attempt() == TaskOutcome("failed", "ZeroDivisionError: division by zero")
    outcome = task.attempt()
    assert outcome.ending == "failed" and f"no folder {task.data}" in outcome.reason
    with RunFolder(task.folder).owned():
        outcome = replace(task, lock_seconds=0.3).attempt()
    owner = f"{task.folder} is in use by process {os.getpid()} on {os.uname().nodename} since 20"
    assert outcome.ending == "failed" and outcome.reason.startswith(owner)


class Sleeper(CellTask):
    """Whose process sleeps until its input is closed, then needs a moment."""

    def command(self):
        code = f"# on {self.device}\nimport sys, time\nprint('up', file=sys.stderr, flush=True)\n"
        code += "sys.stdin.read()\ntime.sleep(0.2)\n"
        code += 'print(\'{"ending": "stopped", "reason": "asked"}\')'
        return [sys.executable, "-c", code]


def test_the_local_executor_runs_as_many_as_it_has_slots_for_and_stops_them(task):
    executor = LocalExecutor(2, threads=1, gpus=("4", "7"))
    sleeper = Sleeper.from_json(task.to_json())
    executor.start(sleeper)
    executor.start(sleeper)
    assert executor.wait(0.2) == []
    environments = [
        Path(f"/proc/{worker._process.pid}/environ").read_bytes().split(b"\0") for worker in executor._workers.values()
    ]
    assert [b"CUDA_VISIBLE_DEVICES=%d" % gpu in each for gpu, each in zip((4, 7), environments, strict=True)] == [
        True
    ] * 2
    # Each sees one GPU, which is cuda whatever its number is, and may not go without.
    assert task.device == "cpu" and all("# on cuda\n" in each._process.args[-1] for each in executor._workers.values())
    while task.log.read_text().count("up") < 2:
        time.sleep(0.01)
    processes = [worker._process for worker in executor._workers.values()]
    executor.stop()
    assert [process.returncode for process in processes] == [0, 0]
    executor.start(sleeper)
    executor._workers[0]._process.kill()
    ((_, outcome),) = executor.wait(30.0)
    assert outcome.ending == "died" and "SIGKILL" in outcome.reason
