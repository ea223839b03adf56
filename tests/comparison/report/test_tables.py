"""The table model: decimals, ranks, footnotes."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coliags_plugin.comparison.report.tables import (
    Column,
    Entry,
    Footnote,
    Row,
    Table,
    counted,
    number_text,
    numeric_entries,
)


@pytest.mark.parametrize(
    ("direction", "values", "ranks"),
    [
        ("higher", [1.0, 3.0, 2.0], [3, 1, 2]),
        ("lower", [1.0, 3.0, 2.0], [1, 3, 2]),
        ("higher", [3.0, 3.0, 2.0], [1, 1, 3]),  # two first places leave no second
        ("higher", [3.0, 2.0, 2.0, 1.0], [1, 2, 2, 4]),
        ("lower", [None, 3.0, 2.0], [None, 2, 1]),
        ("lower", [None, 3.0], [None, None]),  # nothing to be better than
        ("lower", [3.0], [None]),
        (None, [1.0, 2.0], [None, None]),
        ("higher", [30.001, 30.004, 29.0], [1, 1, 3]),  # equal as printed
    ],
)
def test_ranks(direction, values, ranks):
    assert [entry.rank for entry in numeric_entries(values, "dB", direction)] == ranks


@given(st.lists(st.none() | st.floats(-100, 100), max_size=8), st.sampled_from(["higher", "lower"]))
def test_ranks_follow_the_printed_values(values, direction):
    entries = numeric_entries(values, "dB", direction)
    ranked = [entry for entry in entries if entry.rank is not None]
    assert [entry.value is None for entry in entries] == [value is None for value in values]
    sign = -1 if direction == "higher" else 1
    for one in ranked:
        for other in ranked:
            assert (one.rank < other.rank) == (sign * float(one.text) < sign * float(other.text))
    assert len(ranked) != 1
    assert not ranked or min(entry.rank for entry in ranked) == 1


@pytest.mark.parametrize(
    ("unit", "values", "printed"),
    [
        ("dB", [30.126, 9.0], ["30.13", "9.00"]),
        ("", [0.91234], ["0.9123"]),
        ("mm^2", [0.5, 20.0], ["0.500", "20.000"]),
        ("mm^2", [0.0123, 1.0], ["0.0123", "1.0000"]),
        ("mm", [0.000004], ["0.0000"]),
        ("mm", [1234.5, 200.0], ["1234", "200"]),
        ("mm", [0.0, None], ["0.00", ""]),
    ],
)
def test_decimals(unit, values, printed):
    assert [entry.text for entry in numeric_entries(values, unit, "lower")] == printed


def test_spreads_have_the_decimals_of_their_values():
    entries = numeric_entries([30.0, None], "dB", "higher", [0.126, 3.0])
    assert [entry.spread for entry in entries] == ["0.13", ""]


def test_no_negative_zero():
    assert number_text(-0.001, 2) == "0.00"
    assert number_text(-0.006, 2) == "-0.01"


def test_equal_footnotes_share_a_mark_and_hidden_columns_have_none():
    columns = (Column("a", "A"), Column("b", "B", shown=False), Column("c", "C"))
    rows = (
        Row("one", (Entry(note="x"), Entry(note="hidden"), Entry(note="y"))),
        Row("two", (Entry(note="y"), Entry("1", 1.0), Entry(note="x"))),
    )
    table = Table("T", "Method", columns, rows)
    assert table.footnotes() == {
        "x": Footnote("a", ("a", "c")),
        "y": Footnote("b", ("c", "a")),
        "hidden": Footnote("c", ("b",)),
    }
    shown = table.only_shown()
    assert [column.key for column in shown.columns] == ["a", "c"]
    assert [note.mark for note in shown.footnotes().values()] == ["a", "b"]


def test_counted():
    assert [counted(1, "frame"), counted(0, "frame"), counted(1200, "scene")] == ["1 frame", "0 frames", "1,200 scenes"]
