"""Dry runs, and the lines in which a comparison tells of its cells."""

from __future__ import annotations

import json
import logging

import pytest

from coliags_plugin.comparison.compare import dry_run, make_request
from coliags_plugin.comparison.folder import ComparisonFolder
from coliags_plugin.comparison.plan import make_cells
from coliags_plugin.comparison.plan_file import ComparisonPlan
from coliags_plugin.core.files import write_json
from tests.comparison.small import compare_inline
from tests.scenes import write_wall


@pytest.fixture(scope="module")
def cells(wall):
    return make_cells(make_request(["coliags", "3dgs", "scaffold-gs"], [wall], steps=100))


@pytest.fixture
def folder(tmp_path):
    return ComparisonFolder(tmp_path / "comparison")


def test_a_run_with_a_checkpoint_goes_on(cells, folder):
    checkpoint = folder.run(cells[1]).checkpoints / "step-000040"
    checkpoint.mkdir(parents=True)
    (checkpoint / "state.json").write_text("{}")
    write_json(folder.path / "plan.json", ComparisonPlan(steps=100).model_dump(mode="json"))
    table = dry_run(make_request(["coliags", "3dgs", "scaffold-gs"], [cells[0].scene.path], steps=100), folder)
    assert [(row["state"], row["steps"]) for row in table.rows] == [
        ("new", "100"),
        ("resume", "40 of 100"),
        ("new", "100"),
    ]
    assert table.title == "3 cells: 2 new, 1 resume"


def test_the_step_of_a_run_is_read_from_the_end_of_its_log(cells, folder):
    run = folder.run(cells[0])
    assert run.logged_step == 0
    run.path.mkdir(parents=True)
    rows = [{"step": step, "psnr": 20.0, "seconds": 1.0 * step} for step in range(1, 1000)]
    run.log_file.write_text("".join(json.dumps(row) + "\n" for row in rows) + '{"step": 1000, "ps')
    assert run.logged_step == 999


def test_every_cell_that_begins_and_ends_is_told(wall, tmp_path, caplog):
    with caplog.at_level(logging.INFO):
        compare_inline(["coliags", "scaffold-gs"], [write_wall(tmp_path / "bare", depth=False)], tmp_path / "new")
    told = [record.message for record in caplog.records if record.message.startswith("[")]
    assert told[:1] + told[2:] == [
        "[0/2] bare coliags seed 0: running",
        "[1/2] bare scaffold-gs seed 0: running",
        "[2/2] bare scaffold-gs seed 0: done",
    ]
    assert told[1].startswith("[1/2] bare coliags seed 0: failed: ")


def test_progress_ends_with_the_last_cell_not_with_its_last_step(wall, tmp_path, capsys):
    compare_inline(["coliags", "scaffold-gs"], [wall], tmp_path / "new")
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("compare")]
    assert len(lines) == 1 and lines[0].startswith("compare 6/6, took") and lines[0].endswith("2 done")
