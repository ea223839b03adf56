"""Pages as Markdown, as GitHub and most other programs show it."""

from __future__ import annotations

import re
from collections.abc import Sequence

from coliags_plugin.reporting import model
from coliags_plugin.reporting.numbers import DASH, sentence, unit_text

_SPECIAL = re.compile(r"([\\`*_{}\[\]<>|#~])")


def markdown_text(page: model.Page) -> str:
    """A page without its figures."""
    parts = [f"# {escaped(page.title)}"]
    if page.note:
        parts.append(f"> {escaped(page.note)}")
    parts.append(_facts(model.FactList([fact for fact in page.facts if not fact.wide])))
    parts += [f"{fact.name}: {escaped(fact.text)}" for fact in page.facts if fact.wide and fact.text]
    if page.cautions:
        parts.append("\n".join(f"- **{escaped(caution)}**" for caution in page.cautions))
    parts += _blocks(page.text_sections, 2)
    return "\n\n".join(filter(None, parts)) + "\n"


def _facts(block: model.FactList) -> str:
    return "\n".join(f"- {escaped(fact.name)}: {escaped(fact.text)}" for fact in block.facts if fact.text)


def _blocks(blocks: Sequence[model.Block], level: int) -> list[str]:
    parts = []
    for block in blocks:
        if isinstance(block, model.Paragraph):
            parts.append(escaped(block.text))
        elif isinstance(block, model.Bullets):
            items = (
                (f"[{escaped(item.lead)}]({item.href})" if item.href else escaped(item.lead), item.text)
                for item in block.items
            )
            parts.append("\n".join(f"- {': '.join(filter(None, (lead, escaped(text))))}" for lead, text in items))
        elif isinstance(block, model.FactList):
            parts.append(_facts(block))
        elif isinstance(block, (model.Section, model.Folded)):
            parts += [f"{'#' * level} {escaped(block.title)}", *_blocks(block.blocks, level + 1)]
        elif isinstance(block, model.Table):
            parts.append(markdown_table(block))
    return parts


def markdown_table(table: model.Table) -> str:
    """A table with its title, footnotes and notes: the columns that are shown."""
    table = table.only_shown()
    marks = {text: note.mark for text, note in table.footnotes.items()}
    title = f"**{escaped(table.title)}**" + (f" ({escaped(table.count)})" if table.count else "") if table.title else ""
    lines = [
        _line([*map(_heading, table.columns)]),
        _line(["---" if column.words or not index else "---:" for index, column in enumerate(table.columns)]),
    ]
    lines += [_line([_cell(cell, marks) for cell in row]) for row in table.cells]
    below = [f"<sup>{mark}</sup> {escaped(text)}  " for text, mark in marks.items()]
    below += [f"{sentence(escaped(note))}  " for note in table.notes]
    return "\n\n".join(filter(None, [title, "\n".join(lines), "\n".join(below).rstrip()]))


def _heading(column: model.Column) -> str:
    unit = f"[{unit_text(column.unit)}]" if unit_text(column.unit) else ""
    return " ".join(filter(None, (escaped(column.name), column.arrow, escaped(unit))))


def _cell(cell: model.TableCell, marks: dict[str, str]) -> str:
    mark = f"<sup>{marks[cell.note]}</sup>" if cell.note else ""
    if not cell.text:
        return DASH + mark
    text = escaped(cell.text)
    text = {1: f"**{text}**", 2: f"<ins>{text}</ins>"}.get(cell.rank or 0, text)
    spread = f" ± {cell.spread}" if cell.spread else ""
    return f"{text}{spread}{escaped(cell.stars)}{mark}"


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def escaped(text: str) -> str:
    """Plain text as Markdown."""
    return _SPECIAL.sub(r"\\\1", " ".join(text.split()))
