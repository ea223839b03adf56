"""Dry runs: the disk that cells take; and the lines in which a comparison tells of its cells."""

from __future__ import annotations

import json
import logging
from dataclasses import replace

import pytest

from coliags_plugin.comparison.compare import make_request
from coliags_plugin.comparison.dry_run import RunSizes, forecast
from coliags_plugin.comparison.folder import ComparisonFolder
from coliags_plugin.comparison.plan import make_cells
from coliags_plugin.core.errors import InputError
from tests.comparison.small import compare_inline
from tests.scenes import write_wall


@pytest.fixture(scope="module")
def cells(wall):
    return make_cells(make_request(["coliags", "3dgs", "scaffold-gs"], [wall], steps=100))


@pytest.fixture
def folder(tmp_path):
    return ComparisonFolder(tmp_path / "comparison")


def test_disk_is_that_of_finished_runs_where_there_are_any(cells, folder):
    for number, size in enumerate((1000, 3000, 8000)):
        (folder.path / "runs/other/coliags" / f"s0-{number}" / "eval").mkdir(parents=True)
        (folder.path / "runs/other/coliags" / f"s0-{number}" / "eval" / "file").write_bytes(bytes(size))
    assert RunSizes(folder).of(cells[0]) == 3000
    assert RunSizes(folder).of(cells[1]) > 1e6


def test_the_sums_of_a_dry_run(cells, folder):
    checkpoint = folder.run(cells[1]).checkpoints / "step-000040"
    checkpoint.mkdir(parents=True)
    (checkpoint / "state.json").write_text("{}")
    ahead = forecast(cells, folder, folder.finished(), RunSizes(folder), slots=2)
    assert [(each.state, each.step) for each in ahead.cells] == [("new", 0), ("resume", 40), ("new", 0)]
    assert ahead.size == (3 + 2) * RunSizes(folder).of(cells[0])  # two that run take twice their room
    assert "3 cells: 2 new, 1 resume; about 350 MB of" in str(ahead)
    with pytest.raises(InputError, match=r"the runs need about 350 MB, and the disk has"):
        replace(ahead, free=ahead.size - 1).check_disk()


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
