"""Tables of a report: columns, entries with rank and footnote, and rows; written as HTML, Markdown and LaTeX."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from coliags_plugin.results.record import Direction

DASH = "\N{EN DASH}"
_SIGNIFICANT = 3
_MOST_DECIMALS = 4


@dataclass(frozen=True)
class Column:
    """A column.

    Attributes:
        key: Name by which a reader chooses it.
        title: Heading.
        unit: As recorded; empty for a plain number.
        direction: Whether higher or lower is better; None where neither is.
        shown: Whether it is part of the table unless the reader chooses otherwise.
        words: Whether it holds words, which stand to the left.
    """

    key: str
    title: str
    unit: str = ""
    direction: Direction | None = None
    shown: bool = True
    words: bool = False

    @property
    def arrow(self) -> str:
        """Arrow in the direction of better values."""
        return {"higher": "↑", "lower": "↓", None: ""}[self.direction]


@dataclass(frozen=True)
class Entry:
    """What stands where a row meets a column.

    Attributes:
        text: The value as printed; empty where there is none.
        value: The number, for sorting; None where there is none.
        spread: What stands behind a plus-minus sign.
        rank: 1 for the best; None where nothing is ranked.
        stars: Marks of significance.
        note: Footnote: why there is no value, or what it leaves out.
    """

    text: str = ""
    value: float | None = None
    spread: str = ""
    rank: int | None = None
    stars: str = ""
    note: str = ""


@dataclass(frozen=True)
class Row:
    """A row.

    Attributes:
        label: Its header.
        entries: One per column.
        style: Colour index of its method in the charts; None for a row of no method.
        published: Whether its numbers are from a publication.
    """

    label: str
    entries: tuple[Entry, ...]
    style: int | None = None
    published: bool = False


@dataclass(frozen=True)
class Footnote:
    """A footnote's mark, and the keys of the columns that refer to it."""

    mark: str
    columns: tuple[str, ...]


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        title: Above it.
        count: What it is about, behind the title: for instance ``8 scenes``.
        head: Heading of the row headers.
        columns: Its columns.
        rows: Its rows.
        notes: Sentences below it.
        name: Identifier, unique in a report: part of labels and file names.
    """

    title: str
    head: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    count: str = ""
    notes: tuple[str, ...] = ()
    name: str = ""

    def only_shown(self) -> Table:
        """The table without the columns that are not shown."""
        kept = [index for index, column in enumerate(self.columns) if column.shown]
        rows = tuple(replace(row, entries=tuple(row.entries[index] for index in kept)) for row in self.rows)
        return replace(self, columns=tuple(self.columns[index] for index in kept), rows=rows)

    def footnotes(self) -> dict[str, Footnote]:
        """Footnotes by their texts; equal texts share one. Those of columns that are not shown come last."""
        keys: dict[str, dict[str, None]] = {}
        for shown in (True, False):
            for row in self.rows:
                for column, entry in zip(self.columns, row.entries, strict=True):
                    if entry.note and column.shown is shown:
                        keys.setdefault(entry.note, {})[column.key] = None
        return {text: Footnote(_mark(index), tuple(own)) for index, (text, own) in enumerate(keys.items())}


def numeric_entries(
    values: Sequence[float | None], unit: str, direction: Direction | None, spreads: Sequence[float | None] = ()
) -> list[Entry]:
    """Entries of one column: equal decimals, and ranks by the printed digits.

    Args:
        values: One per row; None where there is none.
        unit: Decides the decimals.
        direction: None: not ranked.
        spreads: One per row, or empty.
    """
    decimals = column_decimals(unit, values)
    texts = [None if value is None else number_text(value, decimals) for value in values]
    ranks = printed_ranks(texts, direction)
    found = []
    for index, (value, text) in enumerate(zip(values, texts, strict=True)):
        spread = spreads[index] if spreads else None
        shown = number_text(spread, decimals) if text is not None and spread is not None else ""
        found.append(Entry(text or "", value, shown, ranks[index]))
    return found


def number_text(value: float, decimals: int) -> str:
    """A number with fixed decimals, never a negative zero."""
    text = f"{value:.{decimals}f}"
    return text.removeprefix("-") if not text.strip("-0.") else text


def column_decimals(unit: str, values: Iterable[float | None]) -> int:
    """Decimals of every value of a column: 2 for dB, 4 for plain numbers, else 3 digits of the smallest, at most 4."""
    if unit == "dB":
        return 2
    if unit in ("", "1"):
        return 4
    sizes = [abs(value) for value in values if value]
    if not sizes:
        return 2
    return min(max(_SIGNIFICANT - 1 - math.floor(math.log10(min(sizes))), 0), _MOST_DECIMALS)


def printed_ranks(texts: Sequence[str | None], direction: Direction | None) -> list[int | None]:
    """Rank of each row from 1 on, by the printed value; equal values share a rank and the next one is skipped.

    None where a value is unavailable, and everywhere with fewer than two values or without a direction.
    """
    sign = -1.0 if direction == "higher" else 1.0
    keys = [None if text is None else sign * float(text) for text in texts]
    known = [key for key in keys if key is not None]
    if direction is None or len(known) < 2:
        return [None] * len(keys)
    return [None if key is None else 1 + sum(other < key for other in known) for key in keys]


def unit_text(unit: str) -> str:
    """Unit with typographic exponents: ``mm^2`` as mm²."""
    return "" if unit == "1" else unit.replace("^2", "²").replace("^3", "³")


def counted(number: int, noun: str) -> str:
    """A number with its noun: ``1 frame``, ``8 frames``."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def _mark(index: int) -> str:
    letters = "abcdefghijklmnopqrstuvwxyz"
    return (letters[index // 26 - 1] if index >= 26 else "") + letters[index % 26]
