"""Reports of progress: said where something takes long, and not where it does not."""

from __future__ import annotations

import pytest
from rich.console import Console

from coliags_plugin.config.method_config import load_method
from coliags_plugin.engine import progress as module
from coliags_plugin.engine.data_formats import load_scene
from coliags_plugin.engine.progress import open_display, progress_callback
from tests.scenes import write_wall


@pytest.fixture
def clock(monkeypatch):
    """A clock that goes on by hand."""
    now = [100.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    return now


def count(clock, titles, seconds, **options):
    with progress_callback(**options) as report:
        for title in titles:
            for done in range(1, 11):
                clock[0] += seconds
                report(title, done, 10)


def test_each_title_ends_with_a_line(clock, capsys):
    count(clock, ["read", "fuse"], 0.01)
    said = capsys.readouterr().err.splitlines()
    assert [line.split(",")[0] for line in said] == ["read 10/10", "fuse 10/10"]


def test_what_is_quick_is_not_mentioned(clock, capsys):
    count(clock, ["read", "fuse"], 0.01, after=2.0)
    assert capsys.readouterr().err == ""


def test_what_takes_long_is(clock, capsys):
    count(clock, ["read", "fuse"], 6.0, after=2.0)
    said = capsys.readouterr().err.splitlines()
    # A line every ten seconds, at most, from two seconds on.
    assert [line.split(",")[0] for line in said[:2]] == ["read 4/10", "read 6/10"]
    assert said[-1].startswith("fuse 10/10")
    assert len(said) == 2 * 4
    # Six seconds a step: what was done before the first word does not count as done in no time.
    assert "36.0 s to go" in said[0]


def test_reading_a_small_scene_says_nothing(tmp_path, capsys):
    config = load_method("coliags", ["datamanager.name=c3vd"]).config
    assert load_scene(config, write_wall(tmp_path / "wall")).train
    assert capsys.readouterr().err == ""


class Shown:
    """In place of a notebook: what it shows at last, and how often it changed."""

    def __init__(self):
        self.text, self.changes = "", 0

    def __call__(self, data, raw, display_id):
        assert raw and display_id
        return self.update(data, raw)

    def update(self, data, raw):
        assert raw and data.keys() == {"text/plain"}
        self.text, self.changes = data["text/plain"], self.changes + 1
        return self


def test_a_notebook_shows_one_line_that_changes(clock, monkeypatch, capsys):
    shown = Shown()
    monkeypatch.setattr("IPython.display.display", shown)
    console = Console(force_jupyter=True)
    display = open_display(console, "train", 1000, 0)
    for done in range(1, 1001):
        clock[0] += 0.01
        display.update(done, f"loss {done}")
    display.close()
    assert shown.text == "train 1000/1000, took 10.0 s  loss 1000"
    assert 15 <= shown.changes <= 22  # two a second
    assert capsys.readouterr() == ("", "")
