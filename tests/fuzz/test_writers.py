"""A few kills, failed writes and umasks of quick commands: ``python -m tests.fuzz.kills`` has all of them."""

from __future__ import annotations

import re
import subprocess
import sys

import pytest

from tests.fuzz.campaign import ROOT
from tests.fuzz.writers import WRITERS, is_whole, judge

pytestmark = pytest.mark.thorough

QUICK = ("poses convert (TUM)", "poses convert (COLMAP)", "results export", "train", "eval")


def test_quick_commands_lose_nothing(tmp_path):
    # In a process of its own, which forks: this one may have threads.
    command = [sys.executable, "-m", "tests.fuzz.kills", "--kills", str(len(QUICK)), "--faults", "2", "--permissions"]
    ended = subprocess.run(
        [*command, "--commands", *QUICK], cwd=ROOT, env=None, capture_output=True, text=True, check=False
    )
    assert ended.returncode == 0, f"{ended.stdout}\n{ended.stderr[-3000:]}"
    # Training, which goes on, may be killed more than once.
    kills = int(re.search(r"\| \*\*all\*\* \| (\d+) \|", ended.stdout)[1])
    assert kills >= len(QUICK)
    assert f"| **all** | {2 * len(QUICK)} | {2 * len(QUICK)} | 0 |" in ended.stdout


def test_what_is_lost_or_mixed_is_seen():
    old = {"run/a.json": b"{}\n# old\n", "run/b.png": b"1"}
    new = {"run/a.json": b"{}\n", "run/b.png": b"2"}
    assert judge(old, old, new) == "old"
    assert judge(new, old, new) == "new"
    assert "missing" in judge({"run/a.json": b"{}\n"}, old, new)
    assert "broken ['run/b.png']" in judge({**new, "run/b.png": b""}, old, new)
    assert "broken ['run/b.png']" in judge({**new, "run/b.png": b"1"}, old, new)
    assert "broken ['run/a.json']" in judge({**new, "run/a.json": b"{"}, old, new)
    assert (
        judge(
            {"x.csv": b"new\n", "y.csv": b"old\n"},
            {"x.csv": b"o\n", "y.csv": b"old\n"},
            {"x.csv": b"new\n", "y.csv": b"n\n"},
        )
        == "old and new"
    )
    assert not is_whole("page.html", b"<html>", None)


def test_every_command_that_writes_is_there():
    written = {name.split()[0] for name in WRITERS}
    # The others write nothing, or fetch weights, or are made of train and eval like compare.
    silent = {"list", "config", "doctor", "weights", "check", "ablate"}
    import typing

    import tyro

    from coliags_plugin.cli import Command

    names = {typing.get_args(part)[1].name for part in typing.get_args(Command)}
    assert tyro
    assert written | silent == names
