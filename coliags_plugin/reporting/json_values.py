"""Pages as JSON values, for scripts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from coliags_plugin.reporting.model import Block, Bullets, Fact, FactList, Folded, Page, Section, Table, TableCell


def page_values(page: Page) -> dict[str, Any]:
    """Facts, cautions and tables of a page; no figures and no explaining sentences."""
    return {
        "title": page.title,
        "facts": _facts(page.facts),
        "cautions": list(page.cautions),
        "sections": [_section(section) for section in page.text_sections],
    }


def table_values(table: Table) -> dict[str, Any]:
    """Columns with their units, and rows of plain values by their keys."""
    columns = [
        {"key": column.key, "title": column.name, "unit": column.unit, "better": column.direction}
        for column in table.columns
    ]
    rows = [{column.key: _value(row.get(column.key)) for column in table.columns} for row in table.rows]
    return {"title": table.title, "columns": columns, "rows": rows, "notes": list(table.notes)}


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
    if isinstance(block, Table):
        return "tables", table_values(block)
    if isinstance(block, FactList):
        return "facts", _facts(block.facts)
    if isinstance(block, Bullets):
        return "items", [{"name": item.lead, "text": item.text, "href": item.href} for item in block.items]
    if isinstance(block, (Section, Folded)):
        return "sections", _section(block)
    return "", None


def _value(value: Any) -> Any:
    if not isinstance(value, TableCell):
        return value
    return value.value if value.value is not None else value.text or None
