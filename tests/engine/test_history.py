"""Training logs as columns."""

from __future__ import annotations

import numpy as np

from coliags_plugin.engine.history import columns


def test_columns_of_all_rows():
    found = columns(
        [{"step": 1, "terms": {"l1": 0.5}, "ok": True, "name": "x"}, {"step": 2, "terms": {"l1": 0.25}, "grown": 3}]
    )
    assert found.keys() == {"step", "terms.l1", "grown"}
    np.testing.assert_array_equal(found["step"], [1.0, 2.0])
    np.testing.assert_array_equal(found["terms.l1"], [0.5, 0.25])
    np.testing.assert_array_equal(found["grown"], [np.nan, 3.0])


def test_without_rows_there_are_no_columns():
    assert columns([]) == {}
