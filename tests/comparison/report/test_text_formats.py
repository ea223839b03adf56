"""HTML, Markdown and LaTeX of one report: the same numbers, marks and footnotes, and valid in their own languages."""

from __future__ import annotations

import html
import re

import pytest

from coliags_plugin.comparison.report.report import Choices, report_page
from coliags_plugin.comparison.report.sources import read_study
from coliags_plugin.reporting.html_page import html_blocks
from coliags_plugin.reporting.model import Column, Folded, Page, Section, Table, TableCell
from coliags_plugin.reporting.numbers import DASH
from coliags_plugin.reporting.text_formats import latex_table, latex_text, markdown_table, markdown_text
from tests.comparison.report.made import decided, made_scenes, write_comparison

NASTY = r"a_b & 50 % <of> {x} $y$ #1 ~ ^ \z | *c* `d`"


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    methods = {"coliags": 2.0, "scaffold-gs": 0.5, "ablations/none": 0.0}
    folder = write_comparison(tmp_path_factory.mktemp("comparison"), made_scenes(methods, seeds=2)[:-2])
    return report_page(decided(read_study([folder]), "psnr", "depth_mse"), Choices(note=NASTY))


def tables_of(page):
    found = []

    def collect(blocks):
        for block in blocks:
            if isinstance(block, Table):
                found.append(block)
            elif isinstance(block, Folded):
                collect(block.blocks)

    for section in page.sections:
        collect(section.blocks)
    return found


def said(table):
    """What every rendering must say of the shown cells: rank, text, spread, stars, and mark of the footnote."""
    table = table.only_shown()
    marks = {text: f"[{note.mark}]" for text, note in table.footnotes.items()}
    return [
        [
            (f"<{c.rank}>" if c.rank in (1, 2) and c.text else "")
            + f"{c.text or DASH}{f' ± {c.spread}' if c.spread else ''}{c.stars}{marks.get(c.note, '')}"
            for c in row
        ]
        for row in table.cells
    ]


#: What stands for the marks of each language, in this order.
MARKDOWN = {r"^\*\*(.+?)\*\*": r"<1>\1", "<ins>(.+?)</ins>": r"<2>\1", r"<sup>(\w+)</sup>": r"[\1]", r"\\(.)": r"\1"}
LATEX = {
    r"\\textbf\{(.+?)\}": r"<1>\1",
    r"\\underline\{(.+?)\}": r"<2>\1",
    r"\$\^\{(\*+)\}\$": r"\1",
    r"\$\^\{(\w+)\}\$": r"[\1]",
    r"\$\\pm\$": "±",
    r"\$([-<>|])\$": r"\1",
    "^--": DASH,
    r"\\textasciitilde\{\}": "~",
    r"\\textasciicircum\{\}": "^",
    r"\\textbackslash\{\}": r"\\\\",
    r"\\texttt\{(.*?)\}": r"`\1`",
    r"\\(.)": r"\1",
}
HTML = {
    '<span class="best">': "<1>", '<span class="second">': "<2>", r"<sup>(\w+)</sup>": r"[\1]",
    "<(?![12]>).*?>": "",
}  # fmt: skip


def unmarked(cell, rules):
    cell = cell.strip()
    for pattern, text in rules.items():
        cell = re.sub(pattern, text, cell)
    return cell


def markdown_cells(text):
    rows = [line for line in text.splitlines() if line.startswith("| ")]
    return [[unmarked(cell, MARKDOWN) for cell in re.findall(r"((?:\\.|[^|\\])*)\|", row)[1:]] for row in rows[2:]]


def latex_cells(text):
    body = text.split(r"\midrule", 1)[1].split(r"\bottomrule")[0].replace("\\midrule\n", "")
    rows = [re.split(r"(?<!\\)&", line.removesuffix("\\\\")) for line in body.strip().splitlines()]
    return [[unmarked(cell, LATEX) for cell in row] for row in rows]


def html_cells(text):
    rows = re.findall("<tr.*?>(.*?)</tr>", text, re.DOTALL)[1:]
    cells = [re.findall(r"<t[hd]((?:(?! hidden)[^>])*)>(.*?)</t[hd]>", row, re.DOTALL) for row in rows]
    return [[html.unescape(unmarked(cell, HTML)) for _, cell in row] for row in cells]


def test_all_formats_have_the_same_numbers(page):
    tables, text, tex = tables_of(page), markdown_text(page), latex_text(page)
    names = [table.name for table in tables]
    assert {"summary-test", "summary-rotation", "lead-test-psnr", "costs", "scene-scene-3-test"} < {*names}
    assert len(names) == len({*names}) == len({*re.findall(r"\\label\{(.*?)\}", tex)})
    assert sum(cell.stars != "" for table in tables for row in table.cells for cell in row) > 10
    for table in tables:
        assert markdown_table(table) in text and markdown_cells(markdown_table(table)) == said(table)
        assert latex_table(table) in tex and latex_cells(latex_table(table)) == said(table)
        assert html_cells(html_blocks([table])) == said(table)


def test_latex_is_tables_and_comments(page):
    """Nothing but comments stands between the tables, so that the file can be included anywhere."""
    text = latex_text(page)
    outside = re.sub(r"\\begin\{table\}.*?\\end\{table\}", "", text, flags=re.DOTALL)
    assert all(not line or line.startswith("%") for line in outside.splitlines())
    assert all(caution in outside for caution in page.cautions) and page.cautions
    for table in re.findall(r"\\begin\{table\}.*?\\end\{table\}", text, flags=re.DOTALL):
        assert table.count("{") - table.count(r"\{") == table.count("}") - table.count(r"\}")
        assert (table.count("$") - table.count(r"\$")) % 2 == 0
        columns = len(re.search(r"\\begin\{tabular\}\{(.*)\}", table).group(1))
        rows = [line for line in table.splitlines() if line.endswith(r"\\")]
        assert {len(re.split(r"(?<!\\)&", row)) for row in rows} == {columns}
        assert table.isascii()


def test_nasty_names_survive():
    columns = [Column("method", "Method"), Column("x", NASTY, "mm^2", "lower")]
    table = Table(NASTY, columns, [{"method": NASTY, "x": TableCell("1", 1.0, note=NASTY)}])
    assert markdown_cells(markdown_table(table))[0][0] == NASTY
    tex = latex_table(table)
    assert r"a\_b \& 50 \% $<$of$>$ \{x\} \$y\$ \#1 \textasciitilde{} \textasciicircum{} \textbackslash{}z $|$" in tex
    assert html_cells(html_blocks([table]))[0][0] == NASTY


def test_commands_in_latex_are_typewriter_type():
    text = latex_text(Page("", [Section("", [Table("run `coliags list_all`, or `a", [], [])])]))
    assert r"\caption{run \texttt{coliags list\_all}, or \textasciigrave{}a}" in text
