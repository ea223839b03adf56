"""Reading of training logs: all their numbers, and damage by name."""

from __future__ import annotations

import numpy as np
import pytest

from coliags_plugin.core.errors import InputError
from coliags_plugin.engine.history import read_history


def read(tmp_path, text):
    (tmp_path / "metrics.jsonl").write_text(text)
    return read_history(tmp_path / "metrics.jsonl")


def test_columns_of_all_rows(tmp_path):
    rows = (
        '{"step": 1, "terms": {"l1": 0.5}, "ok": true, "name": "x"}\n{"step": 2, "terms": {"l1": 0.25}, "grown": 3}\n'
    )
    found = read(tmp_path, rows)
    assert found.keys() == {"step", "terms.l1", "grown"}
    np.testing.assert_array_equal(found["step"], [1.0, 2.0])
    np.testing.assert_array_equal(found["terms.l1"], [0.5, 0.25])
    np.testing.assert_array_equal(found["grown"], [np.nan, 3.0])


def test_a_line_that_a_kill_cut_short_does_not_count(tmp_path):
    np.testing.assert_array_equal(read(tmp_path, '{"step": 1}\n{"step": 2')["step"], [1.0])
    assert read(tmp_path, '{"st') == {}


def test_without_a_log_there_are_no_columns(tmp_path):
    assert read_history(tmp_path / "gone.jsonl") == {}


@pytest.mark.parametrize(
    ("text", "message"), [('{"step": 1}\n{\n{}\n', "line 2 is not JSON"), ("3\n", "line 1 holds a int")]
)
def test_damage_is_said(tmp_path, text, message):
    with pytest.raises(InputError, match=message):
        read(tmp_path, text)
