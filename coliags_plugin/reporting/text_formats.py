"""Pages as plain text for the terminal, as Markdown and as JSON values, and their tables as LaTeX: without figures."""

from __future__ import annotations

import re
from collections.abc import Sequence
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
    """Plain text, from which the other text formats derive: a method for each kind of block, named as its ``kind``."""

    dash: ClassVar[str] = "-"  # stands for a missing value
    plus_minus: ClassVar[str] = "±"

    def blocks(self, blocks: Sequence[Block], level: int = 2) -> str:
        """Blocks one after the other, without those that have no text; titles are headings of a level and deeper."""
        return "\n\n".join(filter(None, (getattr(self, block.kind)(block, level) for block in blocks)))

    def paragraph(self, block: Paragraph, level: int = 2) -> str:
        return self.escaped(block.text)

    def bullets(self, block: Bullets, level: int = 2) -> str:
        return "\n".join(map(self._item, block.items))

    def facts(self, block: FactList, level: int = 2) -> str:
        return self._facts([fact for fact in block.facts if fact.text])

    def table(self, block: Table, level: int = 2) -> str:
        """The columns of a table that are shown, with its title, footnotes and notes."""
        table = block.only_shown()
        marks = {text: self._raised(note.mark) for text, note in table.footnotes.items()}
        rows = [[self._cell(cell, marks.get(cell.note, "")) for cell in row] for row in table.cells]
        notes = [*(f"{mark} {self.escaped(text)}" for text, mark in marks.items()), *map(self.escaped, table.notes)]
        return self._table(table, [[*map(self._heading, table.columns)], *rows], [*map(sentence, notes)])

    def figures(self, block: Block, level: int = 2) -> str:
        return ""  # pictures and details are only on HTML pages

    folded = template = figures

    def section(self, block: Section, level: int = 2) -> str:
        body = self.blocks(block.blocks, level + 1)
        return self._titled(block.title, body, level) if body else ""

    def escaped(self, text: str) -> str:
        """Words of a text, none of whose characters has a meaning of its own."""
        return text

    def page(self, page: Page) -> str:
        head = "\n".join(filter(None, [self.facts(FactList(page.facts)), page.note, *page.cautions]))
        return "\n\n".join(filter(None, [head, self.blocks(page.text_sections)]))

    def _item(self, item: Bullet) -> str:
        return ": ".join(filter(None, (item.href or item.lead, item.text)))

    def _facts(self, facts: Sequence[Fact]) -> str:
        return _aligned([[fact.name, fact.text] for fact in facts], "ll")

    def _titled(self, title: str, body: str, level: int) -> str:
        return f"{title}\n{body}"

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

    def page(self, page: Page) -> str:
        parts = [f"# {self.escaped(page.title)}", f"> {self.escaped(page.note)}" if page.note else ""]
        parts.append(self.facts(FactList(page.facts)))
        parts.append("\n".join(f"- **{self.escaped(caution)}**" for caution in page.cautions))
        return "\n\n".join(filter(None, [*parts, self.blocks(page.text_sections)])) + "\n"

    def _item(self, item: Bullet) -> str:
        lead = f"[{self.escaped(item.lead)}]({item.href})" if item.href else self.escaped(item.lead)
        return f"- {': '.join(filter(None, (lead, self.escaped(item.text))))}"

    def _facts(self, facts: Sequence[Fact]) -> str:
        return "\n".join(f"- {self.escaped(fact.name)}: {self.escaped(fact.text)}" for fact in facts)

    def _titled(self, title: str, body: str, level: int) -> str:
        return f"{'#' * level} {self.escaped(title)}\n\n{body}"

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
    """Tables alone, below the title and the cautions of the page as comments."""

    dash, plus_minus = "--", r"$\pm$"

    def escaped(self, text: str) -> str:
        """Plain text as LaTeX; what stands between backticks in typewriter type."""
        parts = _CODE.split(" ".join(text.split()))
        plain = [_SPECIAL.sub(lambda match: _ESCAPES[match.group()], part) for part in parts]
        return "".join(rf"\texttt{{{part}}}" if number % 2 else part for number, part in enumerate(plain))

    def page(self, page: Page) -> str:
        head = "\n".join([_HEAD, *(f"% {' '.join(text.split())}" for text in (page.title, *page.cautions))])
        return "\n\n".join([head, self.blocks(page.text_sections)]) + "\n"

    def paragraph(self, block: Block, level: int = 2) -> str:
        return ""

    bullets = facts = paragraph

    def _titled(self, title: str, body: str, level: int) -> str:
        return body

    def _table(self, table: Table, rows: Sequence[Sequence[str]], notes: Sequence[str]) -> str:
        count = f" ({table.count})" if table.count else ""
        head, *body = (rf"{' & '.join(cells)} \\" for cells in rows)
        published = [row[0].published for row in table.cells]
        if True in published[1:] and not published[0]:
            body.insert(published.index(True), r"\midrule")
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


_PLAIN, _MARKDOWN, _LATEX = _Text(), _Markdown(), _Latex()

#: Blocks as text, with empty lines between them; a page without its figures.
terminal_text, page_text = _PLAIN.blocks, _PLAIN.page
#: A table with its title, footnotes and notes as Markdown, or as an environment ``table``: the columns that are shown.
markdown_table, latex_table = _MARKDOWN.table, _LATEX.table
#: A page without its figures; all of its tables, below its title and cautions as comments.
markdown_text, latex_text = _MARKDOWN.page, _LATEX.page


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


def _aligned(rows: Sequence[Sequence[str]], alignment: str) -> str:
    """Rows of cells as lines; ``l`` or ``r`` for each column."""
    widths = [max(map(cell_len, column)) for column in zip(*rows, strict=True)]

    def padded(cell: str, width: int, side: str) -> str:
        space = " " * (width - cell_len(cell))
        return space + cell if side == "r" else cell + space

    return "\n".join("  ".join(map(padded, row, widths, alignment)).rstrip() for row in rows)


def page_values(page: Page) -> dict[str, Any]:
    """Facts, cautions and tables of a page as JSON values; no figures and no explaining sentences."""
    sections = [_section_values(section) for section in page.text_sections]
    return {
        "title": page.title,
        "facts": _fact_values(page.facts),
        "cautions": list(page.cautions),
        "sections": sections,
    }


def _section_values(section: Section | Folded) -> dict[str, Any]:
    values: dict[str, Any] = {"title": section.title}
    for block in section.blocks:
        if isinstance(block, Section | Folded):
            if len(nested := _section_values(block)) > 1:  # more than its title
                values.setdefault("sections", []).append(nested)
        elif isinstance(block, Table):
            values.setdefault("tables", []).append(_table_values(block))
        elif isinstance(block, FactList):
            values.setdefault("facts", []).append(_fact_values(block.facts))
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


def _fact_values(facts: Sequence[Fact]) -> dict[str, Any]:
    return {fact.name: {"value": fact.value, "unit": fact.unit} if fact.unit else fact.value for fact in facts}
