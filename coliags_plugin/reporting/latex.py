"""The tables of a page as LaTeX with booktabs, to be included into a document."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

from coliags_plugin.reporting import model
from coliags_plugin.reporting.numbers import sentence, unit_text

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


def latex_text(page: model.Page) -> str:
    """All tables in the order of the page, with the text between them as comments."""
    parts = [_HEAD, _comment(page.title)]
    parts += [_comment(page.note)] if page.note else []
    parts += [*_blocks([model.FactList([fact for fact in page.facts if not fact.wide])])]
    parts += [_comment(caution) for caution in page.cautions]
    for section in page.text_sections:
        parts += ["", _comment(f"==== {section.title}"), *_blocks(section.blocks)]
    return "\n".join(parts) + "\n"


def _blocks(blocks: Sequence[model.Block]) -> Iterator[str]:
    for block in blocks:
        if isinstance(block, model.Paragraph):
            yield _comment(block.text)
        elif isinstance(block, model.Bullets):
            yield from (_comment(": ".join(filter(None, (item.lead, item.text)))) for item in block.items)
        elif isinstance(block, model.FactList):
            yield from (_comment(f"{fact.name}: {fact.text}") for fact in block.facts if fact.text)
        elif isinstance(block, (model.Section, model.Folded)):
            yield _comment(f"-- {block.title}")
            yield from _blocks(block.blocks)
        elif isinstance(block, model.Table):
            yield latex_table(block)


def latex_table(table: model.Table) -> str:
    """A ``table`` environment with caption, label, footnotes and notes: the columns that are shown."""
    table = table.only_shown()
    marks = {text: note.mark for text, note in table.footnotes.items()}
    count = f" ({table.count})" if table.count else ""
    below = [f"$^{{{mark}}}$ {escaped(text)}." for text, mark in marks.items()]
    below += [sentence(escaped(note)) for note in table.notes]
    lines = [
        r"\begin{table}[t]",
        r"\centering",
        rf"\caption{{{escaped(table.title + count)}}}",
        rf"\label{{tab:{re.sub('[^A-Za-z0-9:-]', '-', table.name)}}}",
        rf"\begin{{tabular}}{{l{''.join('l' if column.words else 'r' for column in table.columns[1:])}}}",
        r"\toprule",
        _line([*map(_heading, table.columns)]),
        r"\midrule",
        *_rows(table.cells, marks),
        r"\bottomrule",
        r"\end{tabular}",
        *([r"\par\smallskip", rf"{{\footnotesize {' '.join(below)}}}"] if below else []),
        r"\end{table}",
    ]
    return "\n".join(lines)


def _rows(rows: Sequence[Sequence[model.TableCell]], marks: dict[str, str]) -> Iterator[str]:
    for index, row in enumerate(rows):
        if row[0].published and index and not rows[index - 1][0].published:
            yield r"\midrule"
        yield _line([escaped(row[0].text), *(_cell(cell, marks) for cell in row[1:])])


def _heading(column: model.Column) -> str:
    unit = f"[{unit_text(column.unit)}]" if unit_text(column.unit) else ""
    return escaped(" ".join(filter(None, (column.name, column.arrow, unit))))


def _cell(cell: model.TableCell, marks: dict[str, str]) -> str:
    mark = f"$^{{{marks[cell.note]}}}$" if cell.note else ""
    if not cell.text:
        return f"--{mark}"
    text = _MINUS.sub("$-$", escaped(cell.text))
    text = {1: rf"\textbf{{{text}}}", 2: rf"\underline{{{text}}}"}.get(cell.rank or 0, text)
    spread = rf" $\pm$ {cell.spread}" if cell.spread else ""
    stars = f"$^{{{cell.stars}}}$" if cell.stars else ""
    return f"{text}{spread}{stars}{mark}"


def _line(cells: Sequence[str]) -> str:
    return rf"{' & '.join(cells)} \\"


def _comment(text: str) -> str:
    return f"% {' '.join(text.split())}"


def escaped(text: str) -> str:
    """Plain text as LaTeX; what stands between backticks in typewriter type."""
    parts = _CODE.split(" ".join(text.split()))
    plain = [_SPECIAL.sub(lambda match: _ESCAPES[match.group()], part) for part in parts]
    return "".join(rf"\texttt{{{part}}}" if number % 2 else part for number, part in enumerate(plain))
