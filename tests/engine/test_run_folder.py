"""Run folders: names, and runs of other versions."""

from __future__ import annotations

import json
from datetime import datetime
from unittest import mock

import pytest

from coliags_plugin.core.errors import InputError
from coliags_plugin.engine import run_folder
from coliags_plugin.engine.run_folder import RunFolder


def test_runs_begun_in_one_second_get_folders_of_their_own(tmp_path, monkeypatch):
    clock = mock.Mock(wraps=datetime, **{"now.return_value": datetime(2026, 1, 2, 3, 4, 5)})
    monkeypatch.setattr(run_folder, "datetime", clock)
    monkeypatch.chdir(tmp_path)
    names = []
    for _ in range(12):
        folder = RunFolder.default("wall", "coliags")
        folder.create("name: coliags\n", {}, overwrite=False)
        names.append(folder.path.name)
    assert names[:2] == ["20260102-030405", "20260102-030405-02"]
    assert names == sorted(set(names))
    assert RunFolder.newest("wall", "coliags") == folder


@pytest.mark.parametrize("written", [{}, {"format": 1}])
def test_a_run_of_another_version_is_refused_by_name(tmp_path, written):
    folder = RunFolder(tmp_path / "run")
    folder.create("name: coliags\n", {"method": "coliags"}, overwrite=False)
    assert folder.provenance()["method"] == "coliags"
    folder.provenance_file.write_text(json.dumps({**written, "package_version": "0.1.0"}))
    for read in (folder.provenance, folder.identity):
        with pytest.raises(InputError, match=r"provenance\.json is of coliags_plugin 0\.1\.0.*Train again, or use"):
            read()


def test_the_log_is_read_to_a_step_without_its_damaged_lines(tmp_path):
    run = RunFolder(tmp_path)
    assert run.logged_step == 0 and run.log_rows(3) == []
    rows = [{"step": step, "psnr": 20.0, "seconds": 1.0 * step} for step in range(1, 1000)]
    run.log_file.write_text("".join(json.dumps(row) + "\n" for row in rows) + '{"step": 5}\n[]\n3\n{"step": 1000, "ps')
    assert run.log_rows(3) == rows[:3] and run.log_rows(2000) == rows
    run.log_file.write_text("".join(json.dumps(row) + "\n" for row in rows) + '{"step": 1000, "ps')
    assert run.logged_step == 999
