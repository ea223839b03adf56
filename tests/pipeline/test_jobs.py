"""Sub-maps of a reconstruction done by worker processes: what comes out is what one process makes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from dataclasses import replace

import pytest
import torch

import coliags_plugin as cp
from coliags_plugin.core.errors import InputError
from coliags_plugin.engine.tasks import TaskOutcome
from coliags_plugin.pipeline import steps
from coliags_plugin.pipeline.jobs import StageJob, StageJobs
from coliags_plugin.pipeline.settings import ReconstructionSettings
from coliags_plugin.pipeline.stages import PAGE_FILE, Record, StageRecord
from coliags_plugin.pipeline.steps import StageContext, Submap
from tests.comparison.small import lock_holder, until
from tests.pipeline.conftest import TRAINING, write_atlas

SUBMAP = ("check_data", "estimate_depth", *TRAINING)


def told(folder):
    """All that the record says but times."""
    return {name: replace(stage, seconds=0.0) for name, stage in Record.of(folder).stages.items()}


def parts(executor):
    return [task.submap for task in executor.tasks]


@pytest.fixture
def posed(calls, monkeypatch):
    """Poses in three models, two of which are reconstructed."""

    def poses(context):
        calls.append("make_poses")
        write_atlas(context.posed)
        return StageRecord("posed")

    monkeypatch.setattr(steps, "make_poses", poses)


@pytest.mark.thorough
def test_a_video_by_workers_is_what_one_process_makes(posed, video, tmp_path, workers, calls):
    cp.reconstruct(video, tmp_path / "alone")
    alone = list(calls)
    calls.clear()
    executor = workers()
    record = cp.reconstruct(video, tmp_path / "out", jobs=2)
    assert parts(executor) == [None, 0, 1] and calls == alone
    assert told(tmp_path / "out") == told(tmp_path / "alone") and list(record.stages) == list(told(tmp_path / "alone"))
    assert (tmp_path / "out" / PAGE_FILE).is_file()
    executor = workers()
    cp.reconstruct(video, tmp_path / "out", jobs=2)
    assert parts(executor) == [], "what is done is not done again"
    cp.reconstruct(video, tmp_path / "out")
    assert calls == alone


def test_a_sub_map_whose_worker_dies_three_times_has_failed_and_the_others_go_on(calls, atlas, tmp_path, workers):
    died = TaskOutcome("died", "the process was ended by SIGKILL")
    executor = workers(None, died, died, died)
    record = cp.reconstruct(atlas, tmp_path / "out", jobs=1)
    assert parts(executor) == [0, 1, 1, 1]
    assert {stage.state for name, stage in record.stages.items() if "/" not in name} == {"done"}
    workers(died, died, died)
    with pytest.raises(InputError, match="SIGKILL, 3 times"):
        cp.reconstruct(atlas, tmp_path / "again", jobs=1)


def test_the_stage_that_a_worker_is_at_is_told(tmp_path):
    submap, device = Submap(3), torch.device("cpu")
    context = StageContext(tmp_path, tmp_path, ReconstructionSettings(), None, None, device, submap=submap)
    job = StageJob(StageJobs(Record(tmp_path), [], False, None), context, 27)
    assert (job.doing, job.progress()) == (f"{tmp_path.name}, sub-map 3", 0)
    worker = Record.of(tmp_path)
    for name in ("check", "depth"):
        worker.put(f"submap-3/{name}", StageRecord())
    worker.put("submap-3/train", StageRecord(state="begun"))
    assert (job.doing, job.progress()) == (f"{tmp_path.name}, sub-map 3 train", 6)


@pytest.mark.thorough
def test_workers_are_processes_and_one_that_is_killed_is_replaced(atlas, tmp_path):
    """Real stages: the check of the data is done, and depth cannot be, as its one point says nothing."""
    code = "from coliags_plugin.cli import main; main()"
    argv = ["reconstruct", str(atlas), "--output", str(tmp_path / "out"), "--jobs", "2"]
    with (tmp_path / "told.txt").open("w") as messages:
        driver = subprocess.Popen([sys.executable, "-c", code, *argv], stderr=messages, stdout=messages)
    os.kill(until("worker", lambda: lock_holder(tmp_path / "out", ".lock-*")), signal.SIGKILL)
    driver.wait()
    text = (tmp_path / "told.txt").read_text()
    assert "SIGKILL" in text and "trying again" in text
    stages = Record.of(tmp_path / "out").stages
    assert {stages[name].state for name in ("check", "submap-1/check")} == {"done"}
    assert (tmp_path / "out" / "logs" / "0.log").is_file() and (tmp_path / "out" / "logs" / "1.log").is_file()
