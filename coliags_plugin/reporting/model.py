"""The model of presentation: pages of facts, tables and figures, made once and written in several formats."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar

from coliags_plugin.reporting.numbers import (
    Direction,
    column_decimals,
    letters,
    number_text,
    plain,
    ranks_of,
    unit_text,
)

if TYPE_CHECKING:
    from coliags_plugin.reporting.colormaps import ColorMap
    from coliags_plugin.reporting.image_files import EncodedImage

#: What a table may hold besides cells; None is shown as a dash.
Value = str | int | float | None

_LARGEST_MAPPING = 12
_ABSOLUTE_PATH = re.compile(r"^(/|~|[A-Za-z]:[\\/]|\\\\|file:)")


class Block:
    """A piece of a page; writers have a method, and ``blocks.html`` a macro, named as its ``kind``."""

    kind: ClassVar[str]


@dataclass(frozen=True)
class Fact:
    """A named value."""

    name: str
    value: Value  # text or number; facts whose value is empty or None are not shown
    unit: str = ""
    note: str = ""

    @property
    def text(self) -> str:
        """The value with unit and note."""
        text = f"{value_text(self.value)} {unit_text(self.unit)}".rstrip() if self.value not in ("", None) else ""
        return f"{text} ({self.note})" if text and self.note else text


@dataclass(frozen=True)
class Column:
    """A column of a table."""

    key: str  # key of its values in the rows
    title: str = ""  # heading; empty: the key
    unit: str = ""  # as recorded; empty for a plain number
    direction: Direction | None = None  # whether higher or lower is better; None where neither is
    shown: bool = True  # whether it is part of the table unless the reader chooses otherwise
    words: bool = False  # whether it holds words, which are aligned to the left

    @property
    def name(self) -> str:
        """The heading without arrow and unit."""
        return self.title or self.key

    @property
    def arrow(self) -> str:
        """Arrow in the direction of better values."""
        return {"higher": "↑", "lower": "↓", None: ""}[self.direction]

    @property
    def has_second_line(self) -> bool:
        """Tell whether arrow or unit stand below the title."""
        return bool(self.arrow or unit_text(self.unit))


@dataclass(frozen=True)
class TableCell:
    """A cell of a table."""

    text: str = ""  # the value as printed; empty where there is none
    value: float | None = None  # the number, for sorting; None where there is none
    spread: str = ""  # number behind a plus-minus sign
    rank: int | None = None  # 1 for the best; None where nothing is ranked
    stars: str = ""  # marks of significance
    note: str = ""  # footnote: why there is no value, or what it leaves out
    style: int | None = None  # colour index of the method that it names; None where it names none
    published: bool = False  # whether it labels a row of numbers from a publication


@dataclass(frozen=True)
class Footnote:
    """A footnote of a table: mark, text, and the columns whose cells refer to it."""

    mark: str
    text: str
    columns: tuple[str, ...]


@dataclass(frozen=True)
class Table(Block):
    """A table: columns, and rows of values or cells by the keys of the columns."""

    kind: ClassVar[str] = "table"
    title: str
    columns: Sequence[Column]  # the first one labels the rows
    rows: Sequence[Mapping[str, Value | TableCell]]  # values by key; a missing one is shown as a dash
    notes: Sequence[str] = ()  # sentences below it
    count: str = ""  # what it is about, behind the title: for instance ``8 scenes``
    name: str = ""  # identifier, unique on a page: part of labels and file names

    @property
    def cells(self) -> list[list[TableCell]]:
        """One cell per row and column."""
        return [[as_cell(row.get(column.key)) for column in self.columns] for row in self.rows]

    def only_shown(self) -> Table:
        """The table without the columns that are not shown."""
        return replace(self, columns=[column for column in self.columns if column.shown])

    @property
    def footnotes(self) -> dict[str, Footnote]:
        """Footnotes by their texts; equal texts share one. Those of columns that are not shown come last."""
        keys: dict[str, dict[str, None]] = {}
        for shown in (True, False):
            for row in self.cells:
                for column, cell in zip(self.columns, row, strict=True):
                    if cell.note and column.shown is shown:
                        keys.setdefault(cell.note, {})[column.key] = None
        return {
            text: Footnote(letters(index), text, tuple(columns)) for index, (text, columns) in enumerate(keys.items())
        }


@dataclass(frozen=True)
class Paragraph(Block):
    """Sentences, in the small print of a hint unless said otherwise."""

    kind: ClassVar[str] = "paragraph"
    text: str
    hint: bool = True


@dataclass(frozen=True)
class Bullet:
    """An item of a list: a leading name, which may be a link, and text."""

    text: str
    lead: str = ""
    href: str = ""


@dataclass(frozen=True)
class Bullets(Block):
    """A list; of warnings, in a frame."""

    kind: ClassVar[str] = "bullets"
    items: Sequence[Bullet]
    warning: bool = False


@dataclass(frozen=True)
class FactList(Block):
    """Facts in a column, names to the left of values; says so where there are none."""

    kind: ClassVar[str] = "facts"
    facts: Sequence[Fact]


@dataclass(frozen=True)
class Image:
    """A picture."""

    kind: ClassVar[str] = "image"
    image: EncodedImage  # the file
    caption: str
    wide: bool = False  # whether it takes the page's width, on white


@dataclass(frozen=True)
class Series:
    """One line of a chart."""

    name: str  # label
    style: int  # colour index, the same for one method in every chart of a page
    x: Sequence[float]  # increasing
    #: same length; values that are not finite (or not positive on a logarithmic axis) interrupt the line
    y: Sequence[float]

    def points(self, log_y: bool) -> Iterator[tuple[float, float] | None]:
        """Points of the line; None where one cannot be drawn."""
        for x, y in zip(self.x, self.y, strict=True):
            yield (x, y) if math.isfinite(x) and math.isfinite(y) and (y > 0.0 or not log_y) else None


@dataclass(frozen=True)
class Chart:
    """A line chart."""

    kind: ClassVar[str] = "chart"
    series: Sequence[Series]  # lines over one x axis
    x_label: str  # quantity and unit of the x axis
    y_label: str  # quantity and unit of the y axis
    title: str = ""
    log_y: bool = False  # whether the y axis is logarithmic
    equal_scales: bool = False  # whether a unit is as long on both axes
    x_names: Sequence[str] | None = None  # for a categorical x axis: the names of x = 0, 1, ...
    markers: bool = False  # whether to draw a dot at every point
    legend: bool = False  # whether the names of the series stand below it
    group: str = ""  # name of the charts that a switch of the page shows together; empty: always shown

    @property
    def has_points(self) -> bool:
        """Tell whether any point of it can be drawn."""
        return any(point for line in self.series for point in line.points(self.log_y))

    @property
    def names(self) -> list[tuple[int, str]]:
        """Style and name of each line."""
        return [(line.style, line.name) for line in self.series]


@dataclass(frozen=True)
class ColorBar:
    """The scale of a colour map."""

    kind: ClassVar[str] = "color_bar"
    limits: tuple[float, float]  # values of the first and the last colour
    unit: str  # of the values
    color_map: ColorMap  # the colour map
    label: str  # the quantity
    name: str  # identifier, unique on a page


Figure = Image | Chart | ColorBar


@dataclass(frozen=True)
class Figures(Block):
    """Figures of one kind beside each other; charts without a line are left out."""

    kind: ClassVar[str] = "figures"
    figures: Sequence[Figure]  # of one kind
    title: str = ""  # above them
    legend: Sequence[str] = ()  # names of the styles 0, 1, ... of charts, above them.


@dataclass(frozen=True)
class Template(Block):
    """Block that only the HTML page shows: a template of this package, filled with values."""

    kind: ClassVar[str] = "template"
    file: str  # name of the file in ``reporting/assets``
    values: Mapping[str, Any] = field(default_factory=dict)  # by the names that the template uses


@dataclass(frozen=True)
class Folded(Block):
    """Details behind a title, which the reader of an HTML page unfolds; JSON has their tables, texts leave them out."""

    kind: ClassVar[str] = "folded"
    title: str
    blocks: Sequence[Block]
    is_open: bool = False


@dataclass(frozen=True)
class Section(Block):
    """Blocks under a heading."""

    kind: ClassVar[str] = "section"
    title: str
    blocks: Sequence[Block]  # sections among them have smaller headings
    screen_only: bool = False  # whether only the HTML page has it
    name: str = ""  # identifier, unique on a page; empty: none


@dataclass(frozen=True)
class Page:
    """Page of a command's facts, tables and figures."""

    title: str
    sections: Sequence[Section]  # in order; those without blocks are left out
    facts: Sequence[Fact] = ()  # below the heading
    note: str = ""  # remark below the heading
    cautions: Sequence[str] = ()  # what limits what is said
    heading: str = ""  # longer heading of the HTML page; empty: the title

    @property
    def text_sections(self) -> list[Section]:
        """The sections of formats without pictures."""
        return [section for section in self.sections if section.blocks and not section.screen_only]


def simple_table(head: Sequence[str | Column], rows: Iterable[Sequence[Value | TableCell]], name: str = "") -> Table:
    """A table of headings or columns, the first of which is that of the rows' labels, and rows of as many values."""
    columns = [column if isinstance(column, Column) else Column(column) for column in head]
    keys = [column.key for column in columns]
    return Table("", columns, [dict(zip(keys, row, strict=True)) for row in rows], name=name)


def ranked_cells(
    values: Sequence[float | None],
    unit: str,
    direction: Direction | None,
    spreads: Sequence[float | None] = (),
    text: Callable[[float], str] | None = None,
) -> list[TableCell]:
    """Cells of one column, ranked as printed: values of the same text share a rank.

    Without ``text``, decimals are those of the unit, the same for values and spreads.
    """
    decimals = column_decimals(unit, values)
    printed = text or (lambda value: number_text(value, decimals))
    texts = ["" if value is None else printed(value) for value in values]
    shown = ["" if spread is None else number_text(spread, decimals) for spread in spreads or [None] * len(texts)]
    first = dict(zip(reversed(texts), reversed(values), strict=True))
    ranks = ranks_of([first[each] for each in texts], direction)
    return [
        TableCell(text, value, spread if text else "", rank)
        for text, value, spread, rank in zip(texts, values, shown, ranks, strict=True)
    ]


def record(title: str, values: Mapping[str, Any]) -> Folded:
    """Nested values by dotted keys behind a title; paths of this machine are left out."""
    return Folded(title, [FactList([Fact(key, plain(value)) for key, value in leaves(values)])])


def leaves(values: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    """Leaf values by dotted keys; large mappings are kept whole, and paths of this machine are left out."""
    items: list[tuple[str, Any]] = []
    for key, value in values.items():
        if isinstance(value, Mapping) and len(value) <= _LARGEST_MAPPING:
            items += leaves(value, f"{prefix}{key}.")
        elif not (isinstance(value, str) and _ABSOLUTE_PATH.match(value)):
            items.append((f"{prefix}{key}", value))
    return items


def as_cell(value: Value | TableCell) -> TableCell:
    """A value as the cell of a table."""
    if isinstance(value, TableCell):
        return value
    return TableCell() if value is None else TableCell(value_text(value), None if isinstance(value, str) else value)


def value_text(value: Value) -> str:
    """A value as printed: numbers with a fraction to four significant digits, nothing for None."""
    if value is None:
        return ""
    return f"{value:.4g}" if isinstance(value, float) else str(value)
