from __future__ import annotations

from datetime import datetime

import pytest

from coliags_plugin.engine import run_folder
from coliags_plugin.engine.run_folder import RunFolder


@pytest.fixture
def stopped_clock(monkeypatch):
    """The same second for ever."""

    class Clock(datetime):
        @classmethod
        def now(cls, tz=None):
            return cls(2026, 1, 2, 3, 4, 5)

    monkeypatch.setattr(run_folder, "datetime", Clock)


def test_runs_begun_in_one_second_get_folders_of_their_own(tmp_path, monkeypatch, stopped_clock):
    monkeypatch.chdir(tmp_path)
    names = []
    for _ in range(12):
        folder = RunFolder.default("wall", "coliags")
        folder.create("name: coliags\n", {}, overwrite=False)
        names.append(folder.path.name)
    assert names[:2] == ["20260102-030405", "20260102-030405-02"]
    assert names == sorted(set(names))
    assert RunFolder.newest("wall", "coliags") == folder
