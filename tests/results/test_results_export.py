"""Finding and exporting results: every value once, whole, in each form."""

from __future__ import annotations

import csv
import os

import pytest

from coliags_plugin.core.errors import InputError
from coliags_plugin.results.reading import VALUE_COLUMNS, find_results, value_rows, write_csv, write_result
from coliags_plugin.results.record import CostRecord, ProtocolRecord
from tests.commands import refused, run
from tests.results.made import made_result, made_set

ROTATION = made_set(("r",), (0.1 + 0.2,), (1e-300,))


def other_run(**changes):
    """Result of another method, under another protocol, with two test sets."""
    facts = {"key": "f" * 16, "method": "ablations/none", "protocol": ProtocolRecord(name="mine", version=3)}
    return made_result({"test": made_set(), "rotation": ROTATION}, **{**facts, **changes})


@pytest.fixture
def runs(tmp_path):
    """A folder of a run folder, of a plain results file, and of much else."""
    folder = tmp_path / "runs"
    write_result(folder / "one/eval/paper/result.json", made_result())
    write_result(folder / "others/any name.json", other_run())
    (folder / "one/eval/paper/metrics.json").write_text('{"psnr": 30}')
    (folder / "one/state.json").write_text("{")
    (folder / "one/binary.json").write_bytes(bytes(range(256)))
    (folder / "one/folder.json").mkdir()
    scratch = folder / "one/eval/.paper.x7f3/result.json"
    scratch.parent.mkdir()
    scratch.write_text('{"format": "coliags-result", "vers')
    return folder


# Finding


def test_results_are_found_in_files_and_folders(runs):
    expected = {"coliags", "ablations/none"}
    assert {result.method for result in find_results([runs])} == expected
    files = [runs / "one/eval/paper/result.json", runs / "others"]
    assert [result.method for result in find_results(files)] == ["coliags", "ablations/none"]


def test_what_is_named_twice_counts_once(runs, monkeypatch):
    write_result(runs / "copy.json", made_result(cost=CostRecord(device="the same", render_fps=3.0)))
    monkeypatch.chdir(runs)
    assert len(find_results([runs, runs / "one", runs.parent / "runs" / ".." / "runs" / "copy.json"])) == 2


def test_two_different_results_of_one_run_are_refused(runs):
    write_result(runs / "copy.json", made_result({"test": made_set(psnr=(1.0, 2.0))}))
    with pytest.raises(InputError, match=r"copy\.json.*results of the same run, and their values differ"):
        find_results([runs])


def test_what_is_missing_or_damaged_is_named(runs, tmp_path):
    (tmp_path / "empty").mkdir()
    for path, match in ((tmp_path / "empty", "holds no results"), (tmp_path / "gone", "cannot read .*gone")):
        with pytest.raises(InputError, match=match):
            find_results([runs, path])
    (runs / "cut.json").write_text((runs / "others/any name.json").read_text()[:900])
    with pytest.raises(InputError, match=r"cut\.json is not JSON"):
        find_results([runs])


@pytest.mark.skipif(os.getuid() == 0, reason="root may read anything")
def test_an_unreadable_file_is_named(runs):
    (runs / "others/any name.json").chmod(0)
    with pytest.raises(InputError, match="cannot be read"):
        find_results([runs])


# Tables


def test_there_is_one_row_per_value():
    rows = list(value_rows(other_run()))
    assert len(rows) == 3 * 2 + 3 * 1 == len({row[7:10] for row in rows})
    run = ("f" * 16, "ablations/none", "wall", "every-8th", 0, "mine", 3)
    assert rows[0] == (*run, "test", "0000", "psnr", 30.0, "dB")
    assert rows[-1] == (*run, "rotation", "r", "depth_mse", 1e-300, "mm^2")


def test_csv_keeps_every_digit_and_leaves_missing_values_empty(tmp_path):
    write_csv(tmp_path / "table.csv", [made_result(), other_run()])
    with (tmp_path / "table.csv").open(newline="") as file:
        head, *read = csv.reader(file)
    expected = [row for result in (made_result(), other_run()) for row in value_rows(result)]
    assert tuple(head) == VALUE_COLUMNS
    assert [float(row[10]) if row[10] else None for row in read] == [row[10] for row in expected]
    assert read == [["" if value is None else str(value) for value in row] for row in expected]


# Commands


def test_show_prints_means_and_costs(runs, capsys):
    assert run("results", "show", runs / "one/eval/paper/result.json") == 0
    printed = capsys.readouterr().out
    for part in ("coliags on wall, seed 0, 60 steps", "30.75", "0123456789abcdef", "1 min 12 s", "1,234"):
        assert part in printed
    assert "processor time" not in printed, "it was not measured"
    assert run("results", "show", runs) == 0


def test_export_writes_csv_and_refuses_what_cannot_be_written(runs, tmp_path, capsys):
    assert run("results", "export", runs, "--output", tmp_path / "new/table.csv") == 0
    assert len((tmp_path / "new/table.csv").read_text().splitlines()) == 1 + 6 + 9
    (tmp_path / "folder.csv").mkdir()
    assert "is a folder" in refused(capsys, "results", "export", runs, "--output", tmp_path / "folder.csv")
    under_a_file = runs / "one/state.json/table.csv"
    assert "cannot write" in refused(capsys, "results", "export", runs, "--output", under_a_file)
    assert "no results to export" in refused(capsys, "results", "export", "--output", tmp_path / "t.csv")
    assert "holds no results" in refused(capsys, "results", "show", tmp_path / "folder.csv")
