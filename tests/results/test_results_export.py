"""Finding and exporting results: every value once, whole, in each form."""

from __future__ import annotations

import base64
import csv
import hashlib
import json
import os
import struct
import sys

import pytest

from coliags_plugin.core.errors import InputError
from coliags_plugin.results.nerfbaselines import nerfbaselines_result
from coliags_plugin.results.reading import find_results, write_result
from coliags_plugin.results.record import CostRecord, MetricRecord, ProtocolRecord
from coliags_plugin.results.tables import FrameValue, rows, write_csv, write_parquet
from tests.commands import refused, run
from tests.results.made import METRICS, made_result, made_set

ROTATION = made_set(("r",), (0.1 + 0.2,), (1e-300,))


def other_run(**changes):
    """Of another method, under another protocol, with two test sets."""
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


def test_folders_without_results_and_missing_files_are_refused(runs, tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="holds no results"):
        find_results([runs, tmp_path / "empty"])
    with pytest.raises(InputError, match="there is no file"):
        find_results([tmp_path / "gone"])


def test_a_damaged_file_in_a_folder_is_named(runs):
    (runs / "cut.json").write_text((runs / "others/any name.json").read_text()[:900])
    with pytest.raises(InputError, match=r"cut\.json is cut off"):
        find_results([runs])


@pytest.mark.skipif(os.getuid() == 0, reason="root may read anything")
def test_an_unreadable_file_is_named(runs):
    (runs / "others/any name.json").chmod(0)
    with pytest.raises(InputError, match="cannot be read"):
        find_results([runs])


# Tables


def test_there_is_one_row_per_value():
    found = list(rows(other_run()))
    assert len(found) == 3 * 2 + 3 * 1
    assert len({(row.set, row.frame, row.metric) for row in found}) == len(found)
    run = ("f" * 16, "ablations/none", "wall", "every-8th", 0, "mine", 3)
    assert found[0] == FrameValue(*run, "test", "0000", "psnr", 30.0, "dB")
    assert found[-1] == FrameValue(*run, "rotation", "r", "depth_mse", 1e-300, "mm^2")


def test_csv_keeps_every_digit_and_leaves_missing_values_empty(tmp_path):
    write_csv(tmp_path / "table.csv", [made_result(), other_run()])
    with (tmp_path / "table.csv").open(newline="") as file:
        read = list(csv.DictReader(file))
    expected = [row for result in (made_result(), other_run()) for row in rows(result)]
    assert [float(row["value"]) if row["value"] else None for row in read] == [row.value for row in expected]
    texts = [{name: str(value) for name, value in row._asdict().items() if name != "value"} for row in expected]
    assert [{name: text for name, text in row.items() if name != "value"} for row in read] == texts


def test_parquet_holds_the_same_rows(tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    write_parquet(tmp_path / "table.parquet", [made_result(), other_run()])
    table = parquet.read_table(tmp_path / "table.parquet")
    expected = [row._asdict() for result in (made_result(), other_run()) for row in rows(result)]
    assert table.to_pylist() == expected
    types = {field.name: str(field.type) for field in table.schema}
    numbers = {"seed": "int64", "protocol_version": "int64", "value": "double"}
    assert types == {**dict.fromkeys(FrameValue._fields, "string"), **numbers}


def test_parquet_of_no_value_at_all_has_the_columns(tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    write_parquet(tmp_path / "t.parquet", [made_result({"test": made_set((), (), ())})])
    table = parquet.read_table(tmp_path / "t.parquet")
    assert table.num_rows == 0 and str(table.schema.field("value").type) == "double"


def test_parquet_without_pyarrow_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(InputError, match=r"pip install 'coliags_plugin\[tables\]'"):
        write_parquet(tmp_path / "table.parquet", [made_result()])


# nerfbaselines


def test_the_form_is_that_of_nerfbaselines():
    values = (30.123456789, 31.5)
    cost = CostRecord(device="a processor", train_seconds=12.3456789, peak_memory_mib=512.3)
    result = made_result({"rotation": ROTATION, "test": made_set(psnr=values, depth_mse=(0.5, 0.25))}, cost=cost)
    found = json.loads(json.dumps(nerfbaselines_result(result)))
    packed = struct.pack("<2f", *values)
    assert base64.b64decode(found["metrics_raw"]["psnr"]) == packed
    assert found["metrics"] == {"psnr": round(sum(values) / 2, 5), "depth_mse": 0.375}
    assert (found["predictions_sha256"], found["ground_truth_sha256"]) == ("a" * 64, "b" * 64)
    assert found["evaluation_protocol"] == found["nb_info"]["evaluation_protocol"] == "coliags-paper-1"
    assert found["nb_info"]["total_train_time"] == 12.34568
    assert found["nb_info"]["resources_utilization"] == {"memory": 513}
    assert found["nb_info"]["dataset_metadata"] == {"id": "wall", "scene": "wall"}
    assert found["nb_info"]["num_iterations"] == 60
    assert {"evaluate_version", "metrics_sha256"} <= found.keys()


def test_the_hash_is_nerfbaselines_own():
    """Of ``name``, base64 of the sorted values and a line feed, by name."""
    result = made_result({"test": made_set(psnr=(31.5, 30.0), depth_mse=(0.5, 0.25))})
    sha = hashlib.sha256()
    for name, values in (("depth_mse", (0.25, 0.5)), ("psnr", (30.0, 31.5))):
        sha.update(name.encode() + base64.b64encode(struct.pack("<2f", *values)) + b"\n")
    assert nerfbaselines_result(result)["metrics_sha256"] == sha.hexdigest()


def test_metrics_that_a_frame_lacks_are_left_out():
    assert nerfbaselines_result(made_result())["metrics"].keys() == {"psnr"}
    assert nerfbaselines_result(made_result({"test": made_set((), (), ())}))["metrics"] == {}


def test_lpips_is_not_taken_for_alexnets():
    values = {"lpips": (0.5, 0.25), "lpips_squeeze": (0.25, 0.25)}
    metrics = {**METRICS, "lpips_squeeze": MetricRecord(unit="", direction="lower")}
    part = made_set().model_copy(update={"values": values})
    found = nerfbaselines_result(made_result({"test": part}, metrics=metrics))
    assert found["metrics"] == {"lpips_vgg": 0.375, "lpips_squeeze": 0.25}


def test_memory_of_a_gpu_is_named_as_such():
    cost = CostRecord(device="H100", peak_memory_mib=2048.0)
    result = made_result(cost=cost, provenance={"training": {"device": "cuda"}, "scene": {"dataset": "c3vd"}})
    info = nerfbaselines_result(result)["nb_info"]
    assert info["resources_utilization"] == {"gpu_memory": 2048, "gpu_name": "H100"}
    assert "total_train_time" not in info and info["dataset_metadata"]["id"] == "c3vd"


# Commands


def test_show_prints_means_and_costs(runs, capsys):
    assert run("results", "show", runs / "one/eval/paper/result.json") == 0
    printed = capsys.readouterr().out
    for part in ("coliags on wall, seed 0, 60 steps", "30.75", "0123456789abcdef", "1 min 12 s", "1234 in a view"):
        assert part in printed
    assert "processor time" not in printed, "it was not measured"
    assert run("results", "show", runs) == 0


def test_export_of_every_form(runs, tmp_path, capsys):
    assert run("results", "export", runs, "--output", tmp_path / "new/table.csv") == 0
    assert len((tmp_path / "new/table.csv").read_text().splitlines()) == 1 + 6 + 9
    assert run("results", "export", runs, "--output", tmp_path / "nb", "--format", "nerfbaselines") == 0
    names = sorted(path.name for path in (tmp_path / "nb").iterdir())
    assert names == [
        "ablations-none_wall_seed0_mine_ffffffffffffffff.json",
        "coliags_wall_seed0_paper_0123456789abcdef.json",
    ]
    one = ("results", "export", runs / "one", "--format", "nerfbaselines", "--output", tmp_path / "one.json")
    assert run(*one) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[-1] == f"written: {tmp_path / 'one.json'}"
    assert json.loads((tmp_path / "one.json").read_text())["nb_info"]["method"] == "coliags"


def test_export_refuses_what_cannot_be_written(runs, tmp_path, capsys):
    (tmp_path / "folder.csv").mkdir()
    assert "is a folder" in refused(capsys, "results", "export", runs, "--output", tmp_path / "folder.csv")
    several = ("results", "export", runs, "--format", "nerfbaselines", "--output", tmp_path / "a.json")
    assert "one file" in refused(capsys, *several)
    under_a_file = runs / "one/state.json/table.csv"
    assert "cannot write" in refused(capsys, "results", "export", runs, "--output", under_a_file)
    assert "no results to export" in refused(capsys, "results", "export", "--output", tmp_path / "t.csv")
    assert "holds no results" in refused(capsys, "results", "show", tmp_path / "folder.csv")
