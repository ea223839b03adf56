"""Reports of progress: said where something takes long, and not where it does not."""

from __future__ import annotations

import io
from unittest import mock

import pytest
from rich.console import Console

from coliags_plugin.engine import progress as module
from coliags_plugin.engine.progress import ProgressReport, progress_callback


@pytest.fixture
def clock(monkeypatch):
    """A clock that goes on by hand."""
    now = [100.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    return now


def count(clock, titles, seconds, **options):
    with progress_callback(**options) as report:
        for title in titles:
            for count_done in range(1, 11):
                clock[0] += seconds
                report(title, count_done, 10)


def test_what_takes_long_is_mentioned_and_each_title_ends_with_a_line(clock, capsys):
    count(clock, ["read", "fuse"], 0.01, after=2.0)
    assert capsys.readouterr().err == ""
    count(clock, ["read", "fuse"], 0.01)
    assert [line.split(",")[0] for line in capsys.readouterr().err.splitlines()] == ["read 10/10", "fuse 10/10"]
    count(clock, ["read", "fuse"], 6.0, after=2.0)
    lines = capsys.readouterr().err.splitlines()
    # A line every ten seconds, at most, from two seconds on.
    assert [line.split(",")[0] for line in lines[:2]] == ["read 4/10", "read 6/10"]
    assert lines[-1].startswith("fuse 10/10")
    assert len(lines) == 2 * 4
    # Six seconds a step: what was done before the first word does not count as done in no time.
    assert "36.0 s to go" in lines[0]


def test_the_first_step_and_a_slow_one_do_not_count_for_much(clock, capsys):
    """Kernels are compiled in the first: 25 s then would promise hours."""
    with ProgressReport("train", 1001, plain_every=0.0) as report:
        for count_done in range(1, 502):
            clock[0] += 25.4 if count_done == 1 else 5.0 if count_done == 400 else 0.1
            report.update(count_done)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "train 1/1001"
    assert lines[1] == "train 2/1001, 1 min 40 s to go" and lines[-1] == "train 501/1001, 55.0 s to go"


def test_a_terminal_shows_the_facts_and_the_end(clock):
    console = Console(force_terminal=True, width=120, file=io.StringIO())
    with ProgressReport("train", 4, 2, console=console) as report:
        report.update(4, "loss 0.1")
    assert all(text in console.file.getvalue() for text in ("train", "4/4", "loss 0.1"))


def test_a_notebook_shows_one_line_that_changes(clock, monkeypatch, capsys):
    display = mock.Mock()
    monkeypatch.setattr("IPython.display.display", display)
    with ProgressReport("train", 1000, console=Console(force_jupyter=True)) as report:
        for count_done in range(1, 1001):
            clock[0] += 0.01
            report.update(count_done, f"loss {count_done}")
    assert display.call_count == 1 and display.call_args.kwargs == {"raw": True, "display_id": True}
    changes = display.return_value.update.call_args_list
    assert changes[-1] == mock.call({"text/plain": "train 1000/1000, took 10.0 s  loss 1000"}, raw=True)
    assert 15 <= len(changes) <= 22  # two a second
    assert capsys.readouterr() == ("", "")
