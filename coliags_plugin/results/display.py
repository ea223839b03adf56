"""Tables for people: text when printed, HTML in a notebook."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape

#: What a table may hold; None prints as a dash.
Value = str | int | float | None

_NONE = "-"


@dataclass(frozen=True)
class Table:
    """Rows of values under columns.

    ``print`` shows it as text and a notebook as HTML; ``pandas.DataFrame(table.rows)`` is a data frame.

    Attributes:
        title: Above it.
        columns: Keys of the rows' values, in order.
        rows: A value per column each.
        headings: Of columns whose heading is not their key.
        notes: Lines below it.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Mapping[str, Value]]
    headings: Mapping[str, str] = field(default_factory=dict)
    notes: Sequence[str] = ()

    def __str__(self) -> str:
        """The table as text."""
        return "\n".join([self.title, aligned([self._head, *self._cells]), *self.notes])

    __repr__ = __str__

    def _repr_html_(self) -> str:
        """The table as HTML; notebooks ask for it."""
        head = "".join(f"<th>{escape(text)}</th>" for text in self._head)
        rows = "".join(f"<tr>{''.join(_html_cell(text) for text in row)}</tr>" for row in self._cells)
        notes = "".join(f"<p>{escape(note)}</p>" for note in self.notes)
        return f"<table><caption>{escape(self.title)}</caption><tr>{head}</tr>{rows}</table>{notes}"

    @property
    def _head(self) -> list[str]:
        return [self.headings.get(key, key) for key in self.columns]

    @property
    def _cells(self) -> list[list[str]]:
        return [[value_text(row.get(key)) for key in self.columns] for row in self.rows]


def aligned(rows: Sequence[Sequence[str]]) -> str:
    """Rows of cells as text: the first column to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for first, *others in rows:
        right = (text.rjust(width) for text, width in zip(others, widths[1:], strict=True))
        lines.append("  ".join([first.ljust(widths[0]), *right]).rstrip())
    return "\n".join(lines)


def value_text(value: Value) -> str:
    """A value as printed: numbers with a fraction to four significant digits, a dash for None."""
    if value is None:
        return _NONE
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _html_cell(text: str) -> str:
    return f"<td>{escape(text)}</td>"
