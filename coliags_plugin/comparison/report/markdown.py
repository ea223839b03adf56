"""A report as Markdown, as GitHub and most other programs show it."""

from __future__ import annotations

import re
from collections.abc import Sequence

from coliags_plugin.comparison.report.blocks import Block, Content, Folded, Paragraph
from coliags_plugin.comparison.report.tables import DASH, Column, Entry, Table, unit_text

_SPECIAL = re.compile(r"([\\`*_{}\[\]<>|#~])")


def markdown_report(content: Content) -> str:
    """The whole report."""
    parts = [f"# {escaped(content.title)}"]
    if content.note:
        parts.append(f"> {escaped(content.note)}")
    parts.append("\n".join(f"- {name}: {escaped(value)}" for name, value in content.facts))
    if content.description:
        parts.append(f"How the metrics are computed: {escaped(content.description)}")
    if content.cautions:
        parts.append("\n".join(f"- **{escaped(caution)}**" for caution in content.cautions))
    for section in content.sections:
        parts += [f"## {escaped(section.title)}", *_blocks(section.blocks, 3)]
    return "\n\n".join(parts) + "\n"


def _blocks(blocks: Sequence[Block], level: int) -> list[str]:
    parts = []
    for block in blocks:
        if isinstance(block, Paragraph):
            parts.append(escaped(block.text))
        elif isinstance(block, Folded):
            parts += [f"{'#' * level} {escaped(block.title)}", *_blocks(block.blocks, level + 1)]
        else:
            parts.append(markdown_table(block))
    return parts


def markdown_table(table: Table) -> str:
    """A table with its title, footnotes and notes: the columns that are shown."""
    table = table.only_shown()
    marks = {text: note.mark for text, note in table.footnotes().items()}
    title = f"**{escaped(table.title)}**" + (f" ({escaped(table.count)})" if table.count else "")
    lines = [
        _line([table.head, *map(_heading, table.columns)]),
        _line(["---", *("---" if column.words else "---:" for column in table.columns)]),
    ]
    lines += [_line([escaped(row.label), *(_entry(entry, marks) for entry in row.entries)]) for row in table.rows]
    below = [f"<sup>{mark}</sup> {escaped(text)}  " for text, mark in marks.items()]
    below += [f"{escaped(note)}.  " for note in table.notes]
    return "\n\n".join([title, "\n".join(lines), *(["\n".join(below).rstrip()] if below else [])])


def _heading(column: Column) -> str:
    unit = f"[{unit_text(column.unit)}]" if unit_text(column.unit) else ""
    return " ".join(filter(None, (escaped(column.title), column.arrow, escaped(unit))))


def _entry(entry: Entry, marks: dict[str, str]) -> str:
    mark = f"<sup>{marks[entry.note]}</sup>" if entry.note else ""
    if not entry.text:
        return DASH + mark
    text = escaped(entry.text)
    text = {1: f"**{text}**", 2: f"<ins>{text}</ins>"}.get(entry.rank or 0, text)
    spread = f" ± {entry.spread}" if entry.spread else ""
    return f"{text}{spread}{escaped(entry.stars)}{mark}"


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def escaped(text: str) -> str:
    """Plain text as Markdown."""
    return _SPECIAL.sub(r"\\\1", " ".join(text.split()))
