"""Pages as JSON values, for scripts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from coliags_plugin.reporting.model import Block, Bullets, Fact, FactList, Folded, Page, Section, Table


def page_values(page: Page) -> dict[str, Any]:
    """Facts, cautions and tables of a page; no figures and no explaining sentences."""
    return {
        "title": page.title,
        "facts": _facts(page.facts),
        "cautions": list(page.cautions),
        "sections": [_section(section) for section in page.text_sections],
    }


def _facts(facts: Sequence[Fact]) -> dict[str, Any]:
    return {fact.name: {"value": fact.value, "unit": fact.unit} if fact.unit else fact.value for fact in facts}


def _section(section: Section | Folded) -> dict[str, Any]:
    values: dict[str, Any] = {"title": section.title}
    for block in section.blocks:
        name, value = _block(block)
        if name:
            values.setdefault(name, []).append(value)
    return values


def _block(block: Block) -> tuple[str, Any]:
    match block:
        case Table():
            return "tables", _table(block)
        case FactList():
            return "facts", _facts(block.facts)
        case Bullets():
            return "items", [{"name": item.lead, "text": item.text, "href": item.href} for item in block.items]
        case Section() | Folded():
            return "sections", _section(block)
        case _:
            return "", None


def _table(table: Table) -> dict[str, Any]:
    """Columns with their units, and rows of plain values by their keys."""
    columns = [
        {"key": column.key, "title": column.name, "unit": column.unit, "better": column.direction}
        for column in table.columns
    ]
    cells = [[cell.text or None if cell.value is None else cell.value for cell in row] for row in table.cells]
    rows = [dict(zip((column.key for column in table.columns), row, strict=True)) for row in cells]
    return {"title": table.title, "columns": columns, "rows": rows, "notes": list(table.notes)}
