"""Comparisons from Python: the command's, by settings instead of texts, as tables."""

from __future__ import annotations

import pytest
from rich.console import Console

import coliags_plugin as cp
from coliags_plugin.config.assignments import parse_assignments
from coliags_plugin.core.errors import InputError
from coliags_plugin.execution import queue
from tests.commands import run
from tests.comparison.small import TINY, InlineExecutor
from tests.engine.test_progress import Shown

SETTINGS = parse_assignments(TINY)
WITHOUT_DEPTH = ("without depth", "coliags", {"losses.depth": None})


@pytest.fixture
def inline(monkeypatch):
    """Runs in this process; the titles of those that were trained."""
    executor = InlineExecutor()
    monkeypatch.setattr("coliags_plugin.comparison.compare.make_executor", lambda options: executor)
    return executor


@pytest.fixture(scope="module")
def compared(wall, tmp_path_factory):
    folder = tmp_path_factory.mktemp("compared") / "comparison"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("coliags_plugin.comparison.compare.make_executor", lambda options: InlineExecutor())
        return cp.compare(["coliags", cp.variant(*WITHOUT_DEPTH)], wall, folder, steps=3, settings=SETTINGS)


def test_a_table_of_methods(compared):
    table = compared.table()
    assert [row["method"] for row in table.rows] == ["coliags", "without depth"]
    means = {result.method: result.mean("psnr") for result in compared.results}
    assert {row["method"]: row["psnr"] for row in table.rows} == means
    assert "psnr (dB)" in str(table) and "1 of 1" in str(table) and not table.notes
    assert repr(compared) == f"2 of 2 cells done: {compared.folder}"
    assert compared._repr_html_() == table._repr_html_()


def test_columns_are_chosen(compared):
    assert list(compared.table(["depth_mae"]).rows[0]) == ["method", "done", "depth_mae"]
    with pytest.raises(InputError, match=r"no metric 'psrn'.*Did you mean 'psnr'"):
        compared.table(["psrn"])


def test_variants_are_methods_with_settings(compared):
    losses = {result.method: set(result.config["losses"]) for result in compared.results}
    assert losses["coliags"] - losses["without depth"] == {"depth"}


def test_its_runs_can_be_loaded(compared):
    assert list(compared.runs) == [("wall", "coliags", 0), ("wall", "without depth", 0)]
    loaded = cp.load_run(compared.runs["wall", "without depth", 0])
    assert (loaded.method, loaded.step) == ("without depth", 3)
    assert loaded.results["paper"] == compared.results[1]
    assert loaded.render(loaded.frame_names()[0]).rgb.shape == (24, 32, 3)


def test_the_command_goes_on_with_what_a_notebook_began(wall, compared, inline, capsys):
    sets = [part for text in TINY for part in ("--set", text)]
    argv = ("compare", "coliags", "--scenes", wall, "--output", compared.folder, "--steps", 3, *sets)
    assert run(*argv) == 0
    assert inline.tasks == []
    assert "coliags  1 of 1" in capsys.readouterr().out


def test_what_fails_is_in_the_table(wall, tmp_path, inline):
    settings = {**SETTINGS, "datamanager.split": "all-train"}
    done = cp.compare("coliags", str(wall), tmp_path / "new", steps=3, settings=settings)
    assert done.table().rows == [{"method": "coliags", "done": "0 of 1", "psnr": None, "ssim": None, "depth_mse": None}]
    (note,) = done.table().notes
    assert note.startswith("failed: wall-all-train coliags seed 0: ") and "no test frames" in note
    assert "0 of 1 cells done, 1 failed" in repr(done)


def test_an_ablation_is_a_comparison_of_a_files_variants(wall, tmp_path, inline):
    text = "description: d\nbase: coliags\nvariants: {full: null, plain: [losses.depth=null]}\n"
    (tmp_path / "mine.yaml").write_text(text)
    done = cp.ablate(tmp_path / "mine.yaml", wall, tmp_path / "new", steps=3, settings=SETTINGS)
    assert [result.method for result in done.results] == ["full", "plain"]
    with pytest.raises(InputError, match="paper-rows"):
        cp.ablate("paper-row", wall, tmp_path / "new")


def test_a_report_of_a_comparison_is_the_commands(compared, tmp_path):
    ours, theirs = tmp_path / "ours.html", tmp_path / "theirs.html"
    files = cp.report(compared, ours, formats=["markdown", "csv"], title="Depth")
    names = ("--format", "markdown", "--format", "csv", "--title", "Depth")
    assert run("report", compared.folder, "--output", theirs, *names) == 0
    assert [file.suffix for file in files] == [".md", ".csv"]
    for file in files:
        assert file.read_text() == theirs.with_suffix(file.suffix).read_text()
        assert "without depth" in file.read_text()
    with pytest.raises(InputError, match=r"no format 'latx'.*Did you mean 'latex'"):
        cp.report(compared, formats="latx")


def test_a_notebook_shows_one_line(wall, tmp_path, inline, monkeypatch):
    shown = Shown()
    monkeypatch.setattr("IPython.display.display", shown)
    monkeypatch.setattr(queue, "log_console", lambda: Console(force_jupyter=True))
    cp.compare("coliags", wall, tmp_path / "new", steps=3, settings=SETTINGS)
    assert shown.text.startswith("compare 3/3, took") and shown.text.endswith("1 done")
