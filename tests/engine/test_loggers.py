"""Loggers: the numbers of the training log, step by step, where other programs look for them."""

from __future__ import annotations

import json
import sys
from unittest import mock

import pytest

from coliags_plugin.contracts import Follower, scalars
from coliags_plugin.core.errors import InputError
from coliags_plugin.engine.loggers import TensorBoardLogger, WandbLogger, find_loggers
from tests.commands import refused, run
from tests.engine.test_trainer import log_rows, make_trainer, without_clock
from tests.scenes import SMALL, write_wall

SETS = [part for override in SMALL for part in ("--set", override)]


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
    assert run(*argv, "--steps", 4, "--logger", "tensorboard", "--set", "schedule.log_every=1") == 0
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
    assert "training goes on without Mock: no space" in caplog.text


def test_a_missing_library_is_told_before_anything_is_written(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)
    argv = ("train", "coliags", "--data", write_wall(tmp_path / "wall"), "--output", tmp_path / "run")
    assert "pip install 'coliags_plugin[loggers]'" in refused(capsys, *argv, "--logger", "wandb")
    assert not (tmp_path / "run").exists()
    with pytest.raises(InputError, match=r"no logger 'tensorbord'.*Did you mean 'tensorboard'"):
        find_loggers(["tensorbord"])
