"""Pages as plain text for the terminal, as Markdown and as JSON values, and their tables as LaTeX: without figures."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from rich.cells import cell_len

from coliags_plugin.reporting.model import (
    Block,
    Bullet,
    Bullets,
    Column,
    Fact,
    FactList,
    Folded,
    Page,
    Paragraph,
    Section,
    Table,
    TableCell,
)
from coliags_plugin.reporting.numbers import DASH, sentence, unit_text

_MARKDOWN_SPECIAL = re.compile(r"([\\`*_{}\[\]<>|#~])")
_HEAD = "% Needs \\usepackage{booktabs}, and \\usepackage[T1]{fontenc} for names with underscores."
_ESCAPES = {
    "\\": r"\textbackslash{}",
    "{": r"\{",
    "}": r"\}",
    "$": r"\$",
    "&": r"\&",
    "#": r"\#",
    "%": r"\%",
    "_": r"\_",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": "$<$",
    ">": "$>$",
    "|": "$|$",
    "±": r"$\pm$",
    "²": "$^2$",
    "³": "$^3$",
    "·": r"$\cdot$",
    "\N{MULTIPLICATION SIGN}": r"$\times$",
    "°": r"$^\circ$",
    "↑": r"$\uparrow$",
    "↓": r"$\downarrow$",
    "…": r"\ldots{}",
    "`": r"\textasciigrave{}",
    "\N{EN DASH}": "--",
}
_MINUS = re.compile(r"(?<![\w-])-(?=[\d.])")
_CODE = re.compile("`([^`]+)`")
_SPECIAL = re.compile("|".join(map(re.escape, _ESCAPES)))


class _Text:
    """Plain text, and what the formats without figures that derive from it share."""

    dash: ClassVar[str] = "-"  # stands for a missing value
    plus_minus: ClassVar[str] = "±"

    def blocks(self, blocks: Sequence[Block], level: int = 2) -> str:
        """Blocks one after the other, without those that have no text; titles are headings of a level and deeper."""
        return "\n\n".join(filter(None, (self._block(block, level) for block in blocks)))

    def _block(self, block: Block, level: int) -> str:
        match block:
            case Paragraph():
                return self.escaped(block.text)
            case Bullets():
                return "\n".join(map(self._item, block.items))
            case FactList():
                return self._facts([fact for fact in block.facts if fact.text])
            case Table():
                return self.table(block)
            case Section() | Folded():
                return self._titled(block.title, self.blocks(block.blocks, level + 1), level)
            case _:
                return ""

    def escaped(self, text: str) -> str:
        """Words of a text, none of whose characters has a meaning of its own."""
        return text

    def _item(self, item: Bullet) -> str:
        return ": ".join(filter(None, (item.href or item.lead, item.text)))

    def _facts(self, facts: Sequence[Fact]) -> str:
        return _aligned([[fact.name, fact.text] for fact in facts], "ll")

    def _titled(self, title: str, body: str, level: int) -> str:
        return f"{title}\n{body}" if body else ""

    def table(self, table: Table) -> str:
        """The columns of a table that are shown, with its title, footnotes and notes."""
        shown = table.only_shown()
        marks = {text: self._raised(note.mark) for text, note in shown.footnotes.items()}
        rows = [[self._cell(cell, marks.get(cell.note, "")) for cell in row] for row in shown.cells]
        notes = [*(f"{mark} {self.escaped(text)}" for text, mark in marks.items()), *map(self.escaped, table.notes)]
        return self._table(shown, [[*map(self._heading, shown.columns)], *rows], [*map(sentence, notes)])

    def _table(self, table: Table, rows: Sequence[Sequence[str]], notes: Sequence[str]) -> str:
        """A table of headings and cells as texts, with its notes."""
        alignment = "".join("l" if column.words or not index else "r" for index, column in enumerate(table.columns))
        title = " ".join(filter(None, (table.title, f"({table.count})" if table.count else "")))
        return "\n".join([*filter(None, [title]), _aligned(rows, alignment), *map(str.strip, notes)])

    def _heading(self, column: Column) -> str:
        unit = unit_text(column.unit)
        return f"{column.name} ({unit})" if unit else column.name

    def _raised(self, mark: str) -> str:
        return f" [{mark}]"

    def _number(self, cell: TableCell) -> str:
        """Text of a cell that has one, marked by its rank."""
        return self.escaped(cell.text)

    def _stars(self, stars: str) -> str:
        return stars

    def _cell(self, cell: TableCell, mark: str) -> str:
        if not cell.text:
            return f"{self.dash}{mark}"
        spread = f" {self.plus_minus} {cell.spread}" if cell.spread else ""
        return f"{self._number(cell)}{spread}{self._stars(cell.stars) if cell.stars else ''}{mark}"


class _Markdown(_Text):
    dash = DASH

    def escaped(self, text: str) -> str:
        return _MARKDOWN_SPECIAL.sub(r"\\\1", " ".join(text.split()))

    def _item(self, item: Bullet) -> str:
        lead = f"[{self.escaped(item.lead)}]({item.href})" if item.href else self.escaped(item.lead)
        return f"- {': '.join(filter(None, (lead, self.escaped(item.text))))}"

    def _facts(self, facts: Sequence[Fact]) -> str:
        return "\n".join(f"- {self.escaped(fact.name)}: {self.escaped(fact.text)}" for fact in facts)

    def _titled(self, title: str, body: str, level: int) -> str:
        return "\n\n".join(filter(None, (f"{'#' * level} {self.escaped(title)}", body)))

    def _table(self, table: Table, rows: Sequence[Sequence[str]], notes: Sequence[str]) -> str:
        count = f" ({self.escaped(table.count)})" if table.count else ""
        title = f"**{self.escaped(table.title)}**{count}" if table.title else ""
        rule = ["---" if column.words or not index else "---:" for index, column in enumerate(table.columns)]
        lines = [f"| {' | '.join(cells)} |" for cells in (rows[0], rule, *rows[1:])]
        return "\n\n".join(filter(None, [title, "\n".join(lines), "  \n".join(notes)]))

    def _heading(self, column: Column) -> str:
        unit = unit_text(column.unit)
        return self.escaped(" ".join(filter(None, (column.name, column.arrow, f"[{unit}]" if unit else ""))))

    def _raised(self, mark: str) -> str:
        return f"<sup>{mark}</sup>"

    def _number(self, cell: TableCell) -> str:
        text = self.escaped(cell.text)
        return {1: f"**{text}**", 2: f"<ins>{text}</ins>"}.get(cell.rank or 0, text)

    def _stars(self, stars: str) -> str:
        return self.escaped(stars)


class _Latex(_Markdown):
    """Tables alone."""

    dash, plus_minus = "--", r"$\pm$"

    def escaped(self, text: str) -> str:
        """Plain text as LaTeX; what stands between backticks in typewriter type."""
        parts = _CODE.split(" ".join(text.split()))
        plain = [_SPECIAL.sub(lambda match: _ESCAPES[match.group()], part) for part in parts]
        return "".join(rf"\texttt{{{part}}}" if number % 2 else part for number, part in enumerate(plain))

    def _table(self, table: Table, rows: Sequence[Sequence[str]], notes: Sequence[str]) -> str:
        count = f" ({table.count})" if table.count else ""
        head, *body = (rf"{' & '.join(cells)} \\" for cells in rows)
        printed = [row[0].published for row in table.cells]
        if True in printed[1:] and not printed[0]:
            body.insert(printed.index(True), r"\midrule")
        lines = [
            r"\begin{table}[t]",
            r"\centering",
            rf"\caption{{{self.escaped(table.title + count)}}}",
            rf"\label{{tab:{re.sub('[^A-Za-z0-9:-]', '-', table.name)}}}",
            rf"\begin{{tabular}}{{l{''.join('l' if column.words else 'r' for column in table.columns[1:])}}}",
            r"\toprule",
            head,
            r"\midrule",
            *body,
            r"\bottomrule",
            r"\end{tabular}",
            *([r"\par\smallskip", rf"{{\footnotesize {' '.join(notes)}}}"] if notes else []),
            r"\end{table}",
        ]
        return "\n".join(lines)

    def _raised(self, mark: str) -> str:
        return f"$^{{{mark}}}$"

    def _stars(self, stars: str) -> str:
        return self._raised(stars)

    def _number(self, cell: TableCell) -> str:
        text = _MINUS.sub("$-$", self.escaped(cell.text))
        return {1: rf"\textbf{{{text}}}", 2: rf"\underline{{{text}}}"}.get(cell.rank or 0, text)


_MARKDOWN, _LATEX = _Markdown(), _Latex()

#: Blocks as text, with empty lines between them.
terminal_text = _Text().blocks
#: A table with its title, footnotes and notes as Markdown, or as an environment ``table``: the columns that are shown.
markdown_table, latex_table = _MARKDOWN.table, _LATEX.table


@dataclass(frozen=True, repr=False)
class DisplayTable(Table):
    """A table that ``print`` shows as text and a notebook as HTML; ``pandas.DataFrame(table.rows)`` is a data frame."""

    def __str__(self) -> str:
        """The table as text."""
        return terminal_text([self])

    __repr__ = __str__

    def _repr_html_(self) -> str:
        """The table as HTML; notebooks ask for it."""
        from coliags_plugin.reporting.html_page import html_blocks

        return html_blocks([self])


def page_text(page: Page) -> str:
    """Facts, tables and sentences of a page as text; no figures."""
    head = "\n".join(filter(None, [terminal_text([FactList(page.facts)]), page.note, *page.cautions]))
    return "\n\n".join(filter(None, [head, terminal_text(page.text_sections)]))


def markdown_text(page: Page) -> str:
    """A page without its figures."""
    escaped = _MARKDOWN.escaped
    parts = [f"# {escaped(page.title)}", f"> {escaped(page.note)}" if page.note else ""]
    parts.append(_MARKDOWN.blocks([FactList([fact for fact in page.facts if not fact.wide])]))
    parts += [f"{fact.name}: {escaped(fact.text)}" for fact in page.facts if fact.wide and fact.text]
    parts.append("\n".join(f"- **{escaped(caution)}**" for caution in page.cautions))
    return "\n\n".join(filter(None, [*parts, _MARKDOWN.blocks(page.text_sections)])) + "\n"


def latex_text(page: Page) -> str:
    """All tables in the order of the page, below its title and cautions as comments."""
    head = "\n".join([_HEAD, *(f"% {' '.join(text.split())}" for text in (page.title, *page.cautions))])
    return "\n\n".join([head, *map(latex_table, _tables_of(page.text_sections))]) + "\n"


def _tables_of(blocks: Sequence[Block]) -> Iterator[Table]:
    for block in blocks:
        if isinstance(block, Table):
            yield block
        elif isinstance(block, (Section, Folded)):
            yield from _tables_of(block.blocks)


def _aligned(rows: Sequence[Sequence[str]], alignment: str) -> str:
    """Rows of cells as lines; ``l`` or ``r`` for each column."""
    widths = [max(map(cell_len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for row in rows:
        pads = [" " * (width - cell_len(text)) for text, width in zip(row, widths, strict=True)]
        cells = [
            pad + text if side == "r" else text + pad for text, pad, side in zip(row, pads, alignment, strict=True)
        ]
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)


def page_values(page: Page) -> dict[str, Any]:
    """Facts, cautions and tables of a page; no figures and no explaining sentences."""
    return {
        "title": page.title,
        "facts": _fact_values(page.facts),
        "cautions": list(page.cautions),
        "sections": [_section_values(section) for section in page.text_sections],
    }


def _fact_values(facts: Sequence[Fact]) -> dict[str, Any]:
    return {fact.name: {"value": fact.value, "unit": fact.unit} if fact.unit else fact.value for fact in facts}


def _section_values(section: Section | Folded) -> dict[str, Any]:
    values: dict[str, Any] = {"title": section.title}
    for block in section.blocks:
        match block:
            case Table():
                values.setdefault("tables", []).append(_table_values(block))
            case FactList():
                values.setdefault("facts", []).append(_fact_values(block.facts))
            case Section() | Folded():
                values.setdefault("sections", []).append(_section_values(block))
    return values


def _table_values(table: Table) -> dict[str, Any]:
    """Columns with their units, and rows of plain values by their keys."""
    columns = [
        {"key": column.key, "title": column.name, "unit": column.unit, "better": column.direction}
        for column in table.columns
    ]
    keys = [column.key for column in table.columns]
    cells = ([cell.text or None if cell.value is None else cell.value for cell in row] for row in table.cells)
    rows = [dict(zip(keys, row, strict=True)) for row in cells]
    return {"title": table.title, "columns": columns, "rows": rows, "notes": list(table.notes)}
