"""HTML, Markdown and LaTeX of one report: the same numbers, marks and footnotes, and valid in their own languages."""

from __future__ import annotations

import re
from html.parser import HTMLParser

import pytest

from coliags_plugin.comparison.report.page import Choices, text_page
from coliags_plugin.comparison.report.sources import read_study
from coliags_plugin.reporting.html_page import html_blocks
from coliags_plugin.reporting.latex import escaped, latex_table, latex_text
from coliags_plugin.reporting.markdown import markdown_table, markdown_text
from coliags_plugin.reporting.model import Column, Folded, Table, TableCell
from coliags_plugin.reporting.numbers import DASH
from tests.comparison.report.made import decided, made_scenes, write_comparison

NASTY = r"a_b & 50 % <of> {x} $y$ #1 ~ ^ \z | *c* `d`"


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    methods = {"coliags": 2.0, "scaffold-gs": 0.5, "ablations/none": 0.0}
    folder = write_comparison(tmp_path_factory.mktemp("comparison"), made_scenes(methods, seeds=2)[:-2])
    return text_page(decided(read_study([folder]), "psnr", "depth_mse"), Choices(note=NASTY))


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


def model_cells(table):
    """What every rendering must say: label, and value, spread, stars, rank and footnote of every entry."""
    shown = table.only_shown()
    marks = {text: note.mark for text, note in shown.footnotes.items()}
    return [
        [row[0].text, *((c.text or DASH, c.spread, c.stars, _place(c), marks.get(c.note, "")) for c in row[1:])]
        for row in shown.cells
    ]


def _place(entry):
    return {1: "best", 2: "second"}.get(entry.rank or 0, "") if entry.text else ""


def markdown_cells(text):
    rows = []
    for line in text.splitlines():
        if line.startswith("| ") and not line.startswith("| --- "):
            label, *cells = re.findall(r"((?:\\.|[^|\\])*)\|", line)[1:]
            rows.append([plain(label), *map(_markdown_cell, cells)])
    return rows[1:]


def plain(text):
    """Markdown or LaTeX without the backslashes before special characters."""
    return re.sub(r"\\(.)", r"\1", text).strip()


def _markdown_cell(cell):
    cell = cell.strip()
    mark = re.search(r"<sup>(\w+)</sup>$", cell)
    cell = re.sub(r"<sup>\w+</sup>$", "", cell)
    stars = re.search(r"((?:\\\*)*)$", cell).group(1)
    cell = cell.removesuffix(stars)
    value, _, spread = cell.partition(" ± ")
    place = "best" if value.startswith("**") else "second" if value.startswith("<ins>") else ""
    value = re.sub(r"^\*\*|\*\*$|</?ins>", "", value)
    return plain(value), spread, plain(stars), place, mark.group(1) if mark else ""


def latex_cells(text):
    body = text.split(r"\midrule", 1)[1].split(r"\bottomrule")[0].replace("\\midrule\n", "")
    rows = []
    for line in body.strip().splitlines():
        label, *cells = re.split(r"(?<!\\)&", line.removesuffix("\\\\"))
        rows.append([plain(label), *map(_latex_cell, cells)])
    return rows


def _latex_cell(cell):
    cell = cell.strip()
    mark = re.search(r"\$\^\{(\w+)\}\$$", cell)
    cell = re.sub(r"\$\^\{\w+\}\$$", "", cell)
    stars = re.search(r"\$\^\{(\*+)\}\$$", cell)
    cell = re.sub(r"\$\^\{\*+\}\$$", "", cell)
    value, _, spread = cell.partition(r" $\pm$ ")
    place = "best" if value.startswith(r"\textbf") else "second" if value.startswith(r"\underline") else ""
    value = re.sub(r"^\\(?:textbf|underline)\{(.*)\}$", r"\1", value)
    for code, character in (("$-$", "-"), ("$<$", "<"), ("--", DASH)):
        value = value.replace(code, character)
    return plain(value), spread, stars.group(1) if stars else "", place, mark.group(1) if mark else ""


class Cells(HTMLParser):
    """Rows of an HTML table without its hidden cells."""

    def __init__(self, html):
        super().__init__(convert_charrefs=True)
        self.rows, self.within, self.hidden = [], [], False
        self.feed(html)

    def handle_starttag(self, tag, attributes):
        attributes = dict(attributes)
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.hidden = "hidden" in attributes
            if not self.hidden:
                self.rows[-1].append({"tag": tag, "text": "", "spread": "", "stars": "", "place": "", "mark": ""})
        self.within.append((tag, attributes.get("class", "")))
        if tag == "span" and attributes.get("class") in ("best", "second") and not self.hidden:
            self.rows[-1][-1]["place"] = attributes["class"]

    def handle_endtag(self, tag):
        self.within.pop()

    def handle_data(self, data):
        tags = [tag for tag, _ in self.within]
        if self.hidden or not ({"td", "th"} & set(tags)):
            return
        kind = {"sup": "mark", "small": "spread", "b": "stars"}.get(tags[-1], "text")
        self.rows[-1][-1][kind] += data

    @property
    def cells(self):
        return [
            [
                row[0]["text"],
                *((c["text"], c["spread"].removeprefix(" ± "), c["stars"], c["place"], c["mark"]) for c in row[1:]),
            ]
            for row in self.rows[1:]
        ]


def test_the_report_has_every_kind_of_table(page):
    names = [table.name for table in tables_of(page)]
    for name in ("summary-test", "summary-rotation", "lead-test-psnr", "seeds-test", "costs", "scene-scene-3-test"):
        assert name in names
    assert len(names) == len(set(names))


def test_all_formats_have_the_same_numbers(page):
    tables = tables_of(page)
    assert sum(cell.stars != "" for table in tables for row in table.cells for cell in row) > 10
    for table in tables:
        expected = model_cells(table)
        assert markdown_cells(markdown_table(table)) == expected
        assert latex_cells(latex_table(table)) == expected
        assert Cells(html_blocks([table])).cells == expected


def test_whole_reports_hold_every_table(page):
    text, tex = markdown_text(page), latex_text(page)
    for table in tables_of(page):
        assert markdown_table(table) in text
        assert latex_table(table) in tex
    assert tex.count(r"\begin{table}") == tex.count(r"\end{tabular}") == len(tables_of(page))
    assert len(set(re.findall(r"\\label\{(.*?)\}", tex))) == len(tables_of(page))


def test_latex_lines_are_commands_tables_or_comments(page):
    """Nothing but comments stands between the tables, so that the file can be included anywhere."""
    outside = re.sub(r"\\begin\{table\}.*?\\end\{table\}", "", latex_text(page), flags=re.DOTALL)
    assert all(not line or line.startswith("%") for line in outside.splitlines())
    inside = re.findall(r"\\begin\{table\}.*?\\end\{table\}", latex_text(page), flags=re.DOTALL)
    for table in inside:
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
    assert Cells(html_blocks([table])).cells[0][0] == NASTY


def test_commands_in_latex_are_typewriter_type():
    assert escaped("run `coliags list_all`, or `a") == r"run \texttt{coliags list\_all}, or \textasciigrave{}a"
