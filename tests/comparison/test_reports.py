"""What a comparison shows: estimates, the preview's sums, the live table, events, durations and sizes."""

from __future__ import annotations

import json
import logging

import pytest
from rich.console import Console

from coliags_plugin.comparison.compare import make_request
from coliags_plugin.comparison.estimates import Estimates
from coliags_plugin.comparison.folder import ComparisonFolder, Finished
from coliags_plugin.comparison.live import live_report, states_table
from coliags_plugin.comparison.plan import make_cells
from coliags_plugin.comparison.preview import preview
from coliags_plugin.comparison.states import Watch
from coliags_plugin.comparison.text import duration, megabytes
from coliags_plugin.core.errors import InputError
from coliags_plugin.results.display import aligned
from tests.results.made import made_result
from tests.scenes import write_wall


@pytest.fixture(scope="module")
def cells(tmp_path_factory):
    wall = write_wall(tmp_path_factory.mktemp("data") / "wall")
    return make_cells(make_request(["coliags", "3dgs", "reim-nerf"], [wall], None, 1, "paper", (), 100, ()))


@pytest.fixture
def folder(tmp_path):
    return ComparisonFolder(tmp_path / "comparison")


def test_estimates_are_those_of_the_methods_results_where_there_are_any(cells, folder):
    results = {}
    for number, seconds in enumerate((100.0, 200.0, 900.0)):
        cost = {"device": "x", "train_seconds": seconds, "render_fps": 0.5, "checkpoint_bytes": 5_000_000}
        results[folder.path / f"{number}"] = made_result(method="coliags", steps=50, cost=cost)
    estimates = Estimates(folder, results)
    views = sum(len(part.frames) for part in results[folder.path / "0"].sets.values())
    known, rough, slow = (estimates.of(cell) for cell in cells)
    assert known.measured and not rough.measured
    assert known.seconds == pytest.approx(4.0 * 100 + views / 0.5 + 20.0)
    assert estimates.of(cells[0], steps_done=60).seconds == pytest.approx(known.seconds - 4.0 * 60)
    assert known.at_times - known.kept == pytest.approx(10e6)
    assert slow.seconds > 10 * rough.seconds


def test_disk_is_that_of_finished_runs_where_there_are_any(cells, folder):
    for number, size in enumerate((1000, 3000, 8000)):
        (folder.path / "runs/other/coliags" / f"s0-{number}" / "eval").mkdir(parents=True)
        (folder.path / "runs/other/coliags" / f"s0-{number}" / "eval" / "file").write_bytes(bytes(size))
    assert Estimates(folder, {}).of(cells[0]).kept == 3000
    assert Estimates(folder, {}).of(cells[1]).kept > 1e6


def test_the_sums_of_a_preview(cells, folder):
    (folder.run(cells[1]) / "checkpoints" / "step-000040").mkdir(parents=True)
    (folder.run(cells[1]) / "checkpoints" / "step-000040" / "state.json").write_text("{}")
    estimates = Estimates(folder, {})
    ahead = preview(cells, folder, Finished(folder, {}), estimates, slots=2)
    assert [(row.state, row.step) for row in ahead.rows] == [("new", 0), ("resume", 40), ("new", 0)]
    left = [estimates.of(cells[0]), estimates.of(cells[1], 40), estimates.of(cells[2])]
    assert ahead.seconds == pytest.approx(sum(each.seconds for each in left) / 2)
    assert ahead.size == pytest.approx(sum(each.kept for each in left) + 2 * (left[0].at_times - left[0].kept))
    assert "3 cells: 2 new, 1 resume; about" in ahead.line()
    small = type(ahead)(ahead.rows, 0, ahead.seconds, ahead.size, ahead.size - 1, 2)
    with pytest.raises(InputError, match=r"the runs need about .* MB, and the disk has"):
        small.check_disk()


def test_the_table_shows_step_psnr_and_time_left(cells, folder):
    watch = Watch(folder, cells)
    run = folder.run(cells[0])
    run.mkdir(parents=True)
    rows = [{"step": step, "psnr": 20.0 + step, "seconds": 0.5 * step, "loss": 1.0} for step in range(1, 11)]
    (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows) + '{"step": 11, "ps')
    watch.started(cells[0])
    watch.failed(cells[1], "no space left")
    watch.look()
    state = watch.states[0]
    assert (state.step, state.psnr, state.seconds_left) == (10, 30.0, pytest.approx(45.0))
    console = Console(width=120, record=True, file=open("/dev/null", "w", encoding="utf-8"))
    console.print(states_table(watch.states))
    text = console.export_text()
    for part in ("1 running, 1 failed, 1 waiting", "wall coliags seed 0", "10/100", "30.00", "45 s", "no space left"):
        assert part in text


def test_a_long_log_is_read_from_its_end(cells, folder):
    watch = Watch(folder, cells)
    run = folder.run(cells[0])
    run.mkdir(parents=True)
    rows = [{"step": step, "psnr": 20.0, "seconds": (1.0 if step < 700 else 2.0) * step} for step in range(1, 1000)]
    (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    watch.started(cells[0])
    watch.look()
    assert watch.states[0].step == 999 and watch.states[0].seconds_per_step == pytest.approx(2.0)


def test_changes_are_logged_once_where_there_is_no_terminal(cells, folder, caplog):
    watch = Watch(folder, cells)
    watch.done(cells[0])
    with caplog.at_level(logging.INFO), live_report() as show:
        show(watch.states)
        watch.started(cells[1])
        show(watch.states)
        show(watch.states)
        watch.failed(cells[1], "NaN")
        show(watch.states)
    told = [record.message for record in caplog.records]
    assert told == ["[1/3] wall 3dgs seed 0: running", "[2/3] wall 3dgs seed 0: failed: NaN"]


def test_texts():
    assert [duration(seconds) for seconds in (7.4, 99, 700, 5999, 12_000)] == [
        "7 s",
        "99 s",
        "12 min",
        "1 h 40 min",
        "3 h 20 min",
    ]
    assert [megabytes(size) for size in (4e5, 9.9e8, 3.44e9)] == ["0 MB", "990 MB", "3.4 GB"]
    assert aligned([["a", "b"], ["long", "123"]]) == "a       b\nlong  123"
