"""Tables and numbers: decimals, ranks, footnotes, durations."""

from __future__ import annotations

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from coliags_plugin.reporting.model import Column, Footnote, Table, TableCell, ranked_cells
from coliags_plugin.reporting.numbers import counted, duration, file_size, number_text, plain


@given(st.lists(st.none() | st.floats(-100, 100), max_size=8), st.sampled_from(["higher", "lower", None]))
@example([30.001, 30.004, 29.0, 29.0, None, 28.0], "higher")  # places are shared by printed values, and then skipped
def test_a_rank_counts_the_better_printed_values(values, direction):
    cells = ranked_cells(values, "dB", direction)
    sign = {"higher": -1.0, "lower": 1.0, None: 0.0}[direction]
    keys = [sign * float(cell.text) for cell in cells if cell.text]
    assert [cell.value is None for cell in cells] == [value is None for value in values]
    if direction is None or len(keys) < 2:
        assert {cell.rank for cell in cells} <= {None}
    else:
        ranks = [1 + sum(other < key for other in keys) for key in keys]
        assert [cell.rank for cell in cells if cell.text] == ranks


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
    assert [cell.text for cell in ranked_cells(values, unit, "lower")] == printed


def test_spreads_have_the_decimals_of_their_values_and_nothing_is_minus_zero():
    cells = ranked_cells([30.0, None], "dB", "higher", [0.126, 3.0])
    assert [cell.spread for cell in cells] == ["0.13", ""]
    assert [number_text(value, 2) for value in (-0.001, -0.006)] == ["0.00", "-0.01"]


def test_equal_footnotes_share_a_mark_and_hidden_columns_have_none():
    columns = [Column("a", "A"), Column("b", "B", shown=False), Column("c", "C")]
    rows = [
        {"a": TableCell(note="x"), "b": TableCell(note="hidden"), "c": TableCell(note="y")},
        {"a": TableCell(note="y"), "b": 1.0, "c": TableCell(note="x")},
    ]
    table = Table("T", columns, rows)
    assert list(table.footnotes.values()) == [
        Footnote("a", "x", ("a", "c")),
        Footnote("b", "y", ("c", "a")),
        Footnote("c", "hidden", ("b",)),
    ]
    shown = table.only_shown()
    assert [column.key for column in shown.columns] == ["a", "c"]
    assert [note.mark for note in shown.footnotes.values()] == ["a", "b"]


@pytest.mark.parametrize(
    ("text", "values", "printed"),
    [
        (lambda number: counted(number, "frame"), [1, 0, 1200], ["1 frame", "0 frames", "1,200 frames"]),
        (
            duration,
            [0.26, 59.0, 59.97, 61.0, 7322.0],
            ["0.3 s", "59.0 s", "1 min 00 s", "1 min 01 s", "2 h 02 min"],
        ),
        (file_size, [4e5, 9.9e8, 3.44e9], ["0 MB", "990 MB", "3.4 GB"]),
        (
            plain,
            [None, True, 0.25, -0.0, 3, "x", [1, 2.5], list(range(9)), {"a": 1}],
            ["", "yes", "0.25", "0", "3", "x", "1, 2.5", "0, 1, …, 8 (9)", "1 entries"],
        ),
    ],
)
def test_numbers_as_people_read_them(text, values, printed):
    assert [text(value) for value in values] == printed
