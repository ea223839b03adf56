"""The tables of a report as LaTeX with booktabs, to be included into a document."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

from coliags_plugin.comparison.report.blocks import Block, Content, Folded, Paragraph
from coliags_plugin.comparison.report.tables import Column, Entry, Row, Table, unit_text

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
    "\N{EN DASH}": "--",
}
_MINUS = re.compile(r"(?<![\w-])-(?=[\d.])")
_SPECIAL = re.compile("|".join(map(re.escape, _ESCAPES)))


def latex_report(content: Content) -> str:
    """All tables in the order of the report, with the text between them as comments."""
    parts = [_HEAD, _comment(content.title)]
    parts += [_comment(content.note)] if content.note else []
    parts += [_comment(f"{name}: {value}") for name, value in content.facts]
    parts += [_comment(caution) for caution in content.cautions]
    for section in content.sections:
        parts += ["", _comment(f"==== {section.title}"), *_blocks(section.blocks)]
    return "\n".join(parts) + "\n"


def _blocks(blocks: Sequence[Block]) -> Iterator[str]:
    for block in blocks:
        if isinstance(block, Paragraph):
            yield _comment(block.text)
        elif isinstance(block, Folded):
            yield _comment(f"-- {block.title}")
            yield from _blocks(block.blocks)
        else:
            yield latex_table(block)


def latex_table(table: Table) -> str:
    """A ``table`` environment with caption, label, footnotes and notes: the columns that are shown."""
    table = table.only_shown()
    marks = {text: note.mark for text, note in table.footnotes().items()}
    count = f" ({table.count})" if table.count else ""
    below = [f"$^{{{mark}}}$ {escaped(text)}." for text, mark in marks.items()]
    below += [f"{escaped(note)}." for note in table.notes]
    lines = [
        r"\begin{table}[t]",
        r"\centering",
        rf"\caption{{{escaped(table.title + count)}}}",
        rf"\label{{tab:{re.sub('[^A-Za-z0-9:-]', '-', table.name)}}}",
        rf"\begin{{tabular}}{{l{''.join('l' if column.words else 'r' for column in table.columns)}}}",
        r"\toprule",
        _line([escaped(table.head), *map(_heading, table.columns)]),
        r"\midrule",
        *_rows(table.rows, marks),
        r"\bottomrule",
        r"\end{tabular}",
        *([r"\par\smallskip", rf"{{\footnotesize {' '.join(below)}}}"] if below else []),
        r"\end{table}",
    ]
    return "\n".join(lines)


def _rows(rows: Sequence[Row], marks: dict[str, str]) -> Iterator[str]:
    for index, row in enumerate(rows):
        if row.published and index and not rows[index - 1].published:
            yield r"\midrule"
        yield _line([escaped(row.label), *(_entry(entry, marks) for entry in row.entries)])


def _heading(column: Column) -> str:
    unit = f"[{unit_text(column.unit)}]" if unit_text(column.unit) else ""
    return escaped(" ".join(filter(None, (column.title, column.arrow, unit))))


def _entry(entry: Entry, marks: dict[str, str]) -> str:
    mark = f"$^{{{marks[entry.note]}}}$" if entry.note else ""
    if not entry.text:
        return f"--{mark}"
    text = _MINUS.sub("$-$", escaped(entry.text))
    text = {1: rf"\textbf{{{text}}}", 2: rf"\underline{{{text}}}"}.get(entry.rank or 0, text)
    spread = rf" $\pm$ {entry.spread}" if entry.spread else ""
    stars = f"$^{{{entry.stars}}}$" if entry.stars else ""
    return f"{text}{spread}{stars}{mark}"


def _line(cells: Sequence[str]) -> str:
    return rf"{' & '.join(cells)} \\"


def _comment(text: str) -> str:
    return f"% {' '.join(text.split())}"


def escaped(text: str) -> str:
    """Plain text as LaTeX."""
    return _SPECIAL.sub(lambda match: _ESCAPES[match.group()], " ".join(text.split()))
