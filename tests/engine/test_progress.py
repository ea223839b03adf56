"""Reports of progress, said where something takes long; loggers, which have the numbers of the training log."""

from __future__ import annotations

import io
import json
import logging
import sys
from unittest import mock

import pytest
from rich.console import Console

from coliags_plugin.contracts import Follower, StopTraining
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.json_files import scalars
from coliags_plugin.engine import progress as module
from coliags_plugin.engine.loggers import TensorBoardLogger, WandbLogger, find_loggers
from coliags_plugin.engine.progress import ProgressReport, progress_callback
from tests.commands import refused, run
from tests.engine.test_trainer import log_rows, make_trainer, without_clock
from tests.scenes import SETS, write_wall


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


# Loggers


def logged(path) -> dict[str, dict[int, float]]:
    """Scalars of event files by name and step, as TensorBoard reads them."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(path / "tensorboard"))
    events.Reload()
    return {name: {event.step: event.value for event in events.Scalars(name)} for name in events.Tags()["scalars"]}


def test_tensorboard_reads_what_the_log_has(tmp_path):
    pytest.importorskip("tensorboard")
    row = {"step": 3, "loss": 1, "terms": {"l1": 0.5}, "grown": "none", "psnr": 20.0}
    assert scalars(row) == {"loss": 1.0, "psnr": 20.0, "terms/l1": 0.5}
    argv = ("train", "coliags", "--data", write_wall(tmp_path / "wall"), "--output", tmp_path / "run", *SETS)
    assert run(*argv, "--steps", 4, "--loggers", "tensorboard", "--set", "schedule.log_every=1") == 0
    rows = [json.loads(line) for line in (tmp_path / "run/metrics.jsonl").read_text().splitlines()]
    scalars_by_step = logged(tmp_path / "run")
    assert scalars_by_step.keys() == scalars(rows[0]).keys()
    for row in rows:
        for name, value in scalars(row).items():
            assert scalars_by_step[name][row["step"]] == pytest.approx(value, rel=1e-6)


def test_what_is_repeated_after_a_resumption_is_there_once(tmp_path):
    pytest.importorskip("tensorboard")
    for start, last in ((0, 6), (3, 4)):  # killed after step 6, resumed at 3
        logger = TensorBoardLogger(tmp_path, "title", {}, start)
        for step in range(start + 1, last + 1):
            logger.logged({"step": step, "loss": float(start)})
        logger.close()
    assert logged(tmp_path)["loss"] == {1: 0.0, 2: 0.0, 3: 0.0, 4: 3.0}


def test_wandb_stays_on_this_machine(tmp_path, monkeypatch):
    pytest.importorskip("wandb")
    monkeypatch.delenv("WANDB_MODE", raising=False)
    ids = set()
    for start in (0, 1):
        logger = WandbLogger(tmp_path, "coliags on wall, seed 0", {"protocol": "paper"}, start)
        logger.logged({"step": start + 1, "loss": 0.5})
        assert logger._run.settings.mode == "offline" and logger._run.config["protocol"] == "paper"
        ids.add(logger._run.id)
        logger.close()
    assert len(ids) == 1
    files = list((tmp_path / "wandb").glob("offline-run-*/run-*.wandb"))
    assert files and all(b"loss" in file.read_bytes() for file in files)


def test_followers_change_nothing_and_end_nothing(tmp_path, caplog):
    alone, followed, follower = make_trainer(tmp_path / "a"), make_trainer(tmp_path / "b"), mock.Mock(spec=Follower)
    follower.stepped.side_effect = [None, RuntimeError("no space")]
    alone.start()
    alone.train()
    followed.start()
    followed.train(followers=[follower])
    assert without_clock(log_rows(followed)) == without_clock(log_rows(alone))
    assert [call.args for call in follower.stepped.call_args_list] == [(1,), (2,)] and not follower.close.called
    assert "training goes on without Mock: RuntimeError('no space')" in caplog.text


def test_a_follower_ends_training_after_a_step_that_is_saved(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    trainer, stopping, other = make_trainer(tmp_path / "run"), mock.Mock(spec=Follower), mock.Mock(spec=Follower)
    stopping.stepped.side_effect = [None, StopTraining("enough")]
    trainer.start()
    trainer.train(followers=[stopping, other])
    assert trainer.step == trainer.run.step == 2 < trainer.steps
    assert other.stepped.call_args_list == [mock.call(1), mock.call(2)]
    assert stopping.close.called and other.close.called
    assert "Mock ends training: enough" in caplog.text


def test_a_missing_library_is_told_before_anything_is_written(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)
    argv = ("train", "coliags", "--data", write_wall(tmp_path / "wall"), "--output", tmp_path / "run")
    assert "pip install 'coliags_plugin[loggers]'" in refused(capsys, *argv, "--loggers", "wandb")
    assert not (tmp_path / "run").exists()
    with pytest.raises(InputError, match=r"no logger 'tensorbord'.*Did you mean 'tensorboard'"):
        find_loggers(["tensorbord"])
