"""Pages as plain text, for the terminal."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from rich.cells import cell_len

from coliags_plugin.reporting.model import Block, Bullets, Fact, FactList, Folded, Page, Paragraph, Section, Table
from coliags_plugin.reporting.numbers import unit_text

_MISSING = "-"


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
    head = "\n".join(filter(None, [fact_lines(page.facts), page.note, *page.cautions]))
    return "\n\n".join(filter(None, [head, terminal_text(page.text_sections)]))


def terminal_text(blocks: Sequence[Block]) -> str:
    """Blocks as text, with empty lines between them."""
    return "\n\n".join(filter(None, _texts(blocks)))


def fact_lines(facts: Sequence[Fact]) -> str:
    """Facts as lines: names, and values in a column."""
    return _aligned([[fact.name, fact.text] for fact in facts if fact.text], "ll")


def _texts(blocks: Sequence[Block]) -> Iterator[str]:
    for block in blocks:
        if isinstance(block, Paragraph):
            yield block.text
        elif isinstance(block, Bullets):
            yield "\n".join(": ".join(filter(None, (item.href or item.lead, item.text))) for item in block.items)
        elif isinstance(block, FactList):
            yield fact_lines(block.facts)
        elif isinstance(block, Table):
            yield _table(block.only_shown())
        elif isinstance(block, (Section, Folded)):
            body = terminal_text(block.blocks)
            yield f"{block.title}\n{body}" if body else ""


def _table(table: Table) -> str:
    marks = {text: f" [{note.mark}]" for text, note in table.footnotes.items()}
    head = [" ".join(filter(None, (column.name, _unit(column.unit)))) for column in table.columns]
    rows = [
        [
            (cell.text or _MISSING)
            + (f" ± {cell.spread}" if cell.spread else "")
            + cell.stars
            + marks.get(cell.note, "")
            for cell in row
        ]
        for row in table.cells
    ]
    alignment = "".join("l" if column.words or not index else "r" for index, column in enumerate(table.columns))
    title = [" ".join(filter(None, (table.title, f"({table.count})" if table.count else "")))] if table.title else []
    notes = [f"{mark.strip()} {text}" for text, mark in marks.items()]
    return "\n".join([*title, _aligned([head, *rows], alignment), *notes, *table.notes])


def _unit(unit: str) -> str:
    return f"({unit_text(unit)})" if unit_text(unit) else ""


def _aligned(rows: Sequence[Sequence[str]], alignment: str) -> str:
    """Rows of cells as lines; ``l`` or ``r`` for each column."""
    widths = [max(map(cell_len, column)) for column in zip(*rows, strict=True)]
    pads = [[" " * (width - cell_len(text)) for text, width in zip(row, widths, strict=True)] for row in rows]
    return "\n".join(
        "  ".join(
            pad + text if side == "r" else text + pad for text, pad, side in zip(row, own, alignment, strict=True)
        ).rstrip()
        for row, own in zip(rows, pads, strict=True)
    )
