"""A report's text and tables as HTML."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

from coliags_plugin.comparison.report.blocks import Block, Content, Folded, Paragraph, Section
from coliags_plugin.comparison.report.tables import DASH, Column, Entry, Footnote, Row, Table, unit_text
from coliags_plugin.outputs.charts import style_classes


def html_header(content: Content, extra_facts: str = "") -> str:
    """Heading, note, facts and cautions."""
    parts = [f"<h1>{escape(content.title)}</h1>"]
    if content.note:
        parts.append(f'<p class="note" role="note">{escape(content.note)}</p>')
    parts.append('<dl class="facts">')
    parts += [f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>" for name, value in content.facts]
    if content.description:
        description = escape(content.description)
        parts.append(f'<div class="wide"><dt>How the metrics are computed</dt><dd>{description}</dd></div>')
    parts.append(f"{extra_facts}</dl>")
    if content.cautions:
        items = "".join(f"<li>{escape(caution)}</li>" for caution in content.cautions)
        parts.append(f'<ul class="cautions">{items}</ul>')
    return "\n".join(parts)


def html_section(section: Section) -> str:
    """A section with its heading."""
    return "\n".join([f"<section><h2>{escape(section.title)}</h2>", *map(html_block, section.blocks), "</section>"])


def html_block(block: Block) -> str:
    """A block; a folded one as ``details``, which works without scripts."""
    if isinstance(block, Paragraph):
        return f'<p class="hint">{escape(block.text)}</p>'
    if isinstance(block, Folded):
        return folded(block.title, map(html_block, block.blocks))
    return html_table(block)


def folded(title: str, parts: Iterable[str], is_open: bool = False) -> str:
    """HTML behind a title that unfolds."""
    state = " open" if is_open else ""
    return f'<details{state}><summary>{escape(title)}</summary><div class="inside">{"".join(parts)}</div></details>'


def html_table(table: Table) -> str:
    """A table with title, footnotes and notes; columns not shown are hidden, for the script to show.

    ``data-key`` names a column, and ``data-value`` is the number of a cell; the script sorts by it.
    """
    footnotes = table.footnotes()
    marks = {text: note.mark for text, note in footnotes.items()}
    count = f' <span class="count">{escape(table.count)}</span>' if table.count else ""
    heads = "".join(_heading(table, column) for column in table.columns)
    rows = "".join(_row(table, row, marks) for row in table.rows)
    parts = [
        f'<div class="scroll"><table class="results" data-name="{escape(table.name, quote=True)}">',
        f"<caption>{escape(table.title)}{count}</caption>",
        f'<thead><tr><th scope="col" class="text">{escape(table.head)}</th>{heads}</tr></thead>',
        f"<tbody>{rows}</tbody></table></div>",
    ]
    below = [_footnote(table, text, note) for text, note in footnotes.items()]
    below += [f"<li>{escape(note)}.</li>" for note in table.notes]
    if below:
        parts.append(f'<ul class="footnotes">{"".join(below)}</ul>')
    return "\n".join(parts)


def _footnote(table: Table, text: str, note: Footnote) -> str:
    """A footnote, hidden with the columns that it is for."""
    shown = {column.key for column in table.columns if column.shown}
    hidden = "" if shown & set(note.columns) else " hidden"
    keys = escape(" ".join(note.columns), quote=True)
    return f'<li data-columns="{keys}"{hidden}><sup>{note.mark}</sup> {escape(text)}</li>'


def _heading(table: Table, column: Column) -> str:
    title = f' title="{column.direction} is better"' if column.direction else ""
    # Arrow and unit share the second line, so that all headings have two lines; or one, where no column has any.
    under = f"{column.arrow} {escape(unit_text(column.unit))}".strip()
    if any(each.arrow or unit_text(each.unit) for each in table.columns):
        under = f'<span class="unit"{title}>{under or "&nbsp;"}</span>'
    direction = f' data-better="{column.direction}"' if column.direction else ""
    return (
        f'<th scope="col"{_class(column)}{_hidden(column)} data-key="{escape(column.key, quote=True)}"{direction}>'
        f"{escape(column.title)}{under}</th>"
    )


def _row(table: Table, row: Row, marks: dict[str, str]) -> str:
    label = f"{swatch(row.style)}{escape(row.label)}"
    cells = "".join(_cell(column, entry, marks) for column, entry in zip(table.columns, row.entries, strict=True))
    published = ' class="published"' if row.published else ""
    return f'<tr{published}><th scope="row" class="text">{label}</th>{cells}</tr>'


def _cell(column: Column, entry: Entry, marks: dict[str, str]) -> str:
    mark = f"<sup>{marks[entry.note]}</sup>" if entry.note else ""
    if not entry.text:
        return f'<td class="null"{_hidden(column)}>{DASH}{mark}</td>'
    place = {1: ' class="best"', 2: ' class="second"'}.get(entry.rank or 0, "")
    value = "" if entry.value is None else f' data-value="{entry.value!r}"'
    spread = f'<small class="spread"> ± {entry.spread}</small>' if entry.spread else ""
    stars = f'<b class="stars">{entry.stars}</b>' if entry.stars else ""
    # A span, so that the underline is as wide as the number and not as the cell.
    text = f"<span{place}>{escape(entry.text)}</span>"
    return f"<td{_class(column)}{_hidden(column)}{value}>{text}{spread}{stars}{mark}</td>"


def _class(column: Column) -> str:
    return ' class="text"' if column.words else ""


def _hidden(column: Column) -> str:
    return "" if column.shown else " hidden"


def swatch(style: int | None) -> str:
    """Coloured dot of a method; nothing for no style."""
    return "" if style is None else f'<i class="swatch {style_classes(style)}"></i>'


def legend(methods: Sequence[str]) -> str:
    """Names and colours of the methods, for charts."""
    items = "".join(f"<li>{swatch(index)}{escape(method)}</li>" for index, method in enumerate(methods))
    return f'<ul class="legend">{items}</ul>'
