"""One page written for the terminal, as HTML, Markdown, LaTeX and JSON: the same facts, numbers, marks and notes."""

from __future__ import annotations

import html
import json
import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from coliags_plugin.comparison.report.report import report_page
from coliags_plugin.comparison.report.study import read_study
from coliags_plugin.config.options import ReportOptions
from coliags_plugin.core.errors import InputError
from coliags_plugin.reporting.html_page import columns_of, html_blocks, html_text, write_html
from coliags_plugin.reporting.image_files import EncodedImage
from coliags_plugin.reporting.model import (
    Bullet,
    Bullets,
    Chart,
    ColorBar,
    Column,
    Fact,
    Figures,
    Folded,
    Footnote,
    Image,
    Page,
    Paragraph,
    Section,
    Series,
    Table,
    TableCell,
    leaves,
    ranked_cells,
    record,
    simple_table,
)
from coliags_plugin.reporting.numbers import DASH, counted, duration, file_size, number_text, plain
from coliags_plugin.reporting.text_formats import (
    DisplayTable,
    latex_table,
    latex_text,
    markdown_table,
    markdown_text,
    page_text,
    page_values,
    terminal_text,
)
from tests.comparison.report.made import decided, made_scenes, write_comparison

PLAIN = DisplayTable(
    "A <title>",
    [Column("method"), Column("n"), Column("psnr", unit="dB")],
    [{"method": "a&b", "n": 12, "psnr": 31.456}, {"method": "c"}],
    ["a note"],
)
MARKED = Table(
    "Means",
    [Column("method", "Method", words=True), Column("psnr", "PSNR", "dB", "higher"), Column("more", shown=False)],
    [
        {"method": TableCell("coliags", style=0), "psnr": TableCell("31.20", 31.2, "0.30", 1, "*")},
        {"method": TableCell("other", style=9), "psnr": TableCell(note="no weights"), "more": TableCell(note="hidden")},
        {"method": TableCell("printed", published=True), "psnr": TableCell("30.1", 30.1, rank=2)},
    ],
    ["± over scenes"],
    "8 scenes",
    "summary",
)
NASTY = r"a_b & 50 % <of> {x} $y$ #1 ~ ^ \z | *c* `d`"
COLUMNS = [Column("method", "Method"), Column("x", NASTY, "mm^2", "lower")]
OF_NASTY_NAMES = Table(NASTY, COLUMNS, [{"method": NASTY, "x": TableCell("1", 1.0, note=NASTY)}], name="nasty")
CHART = Chart([Series("line", 0, [0, 1], [2, 3])], "x", "y", "A chart", legend=True)
PICTURES = [EncodedImage.png(np.full((2, 3, 3), grey, np.uint8)) for grey in (0, 200)]


def made_page():
    return Page(
        "A & b",
        [
            Section("Tables", [Paragraph("why <so>"), MARKED, Section("Nested", [Folded("More", [PLAIN])])]),
            Section("Found", [Bullets([Bullet("it is. Mend it", "what")], warning=True)]),
            Section("Files", [Bullets([Bullet("the mesh", "mesh.ply", "a/mesh.ply")])]),
            Section("Recorded", [record("Data", {"a": {"b": True, "c": 0.25}, "path": "/home/me", "file": "/etc"})]),
            Section("Seen", [Figures([CHART]), Figures([ColorBar((0, 5), "mm", "error", "|dz|", "bar")])]),
            Section("Images", [Figures([Image(image, "a picture") for image in PICTURES], "Two")], screen_only=True),
            Section("Nothing", []),
        ],
        [Fact("length", 3.14159, "mm^2"), Fact("empty", ""), Fact("long", "words", note="a remark")],
        "Research <use>",
        ["careful"],
    )


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """A report with every kind of table."""
    methods = {"coliags": 2.0, "scaffold-gs": 0.5, "ablations/none": 0.0}
    folder = write_comparison(tmp_path_factory.mktemp("comparison"), made_scenes(methods, seeds=2)[:-2])
    return report_page(decided(read_study([folder]), "psnr", "depth_mse"), ReportOptions(note=NASTY))


def tables_of(blocks):
    for block in blocks:
        if isinstance(block, Table):
            yield block
        elif isinstance(block, (Folded, Section)):
            yield from tables_of(block.blocks)


def said(table):
    """Rank, text, spread, stars and mark of the footnote of the shown cells, which every format must have."""
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


def test_all_formats_have_the_same_numbers(report):
    tables, text, tex = [*tables_of(report.sections)], markdown_text(report), latex_text(report)
    names = [table.name for table in tables]
    assert {"summary-test", "summary-rotation", "lead-test-psnr", "costs", "scene-scene-3-test"} < {*names}
    assert len(names) == len({*names})
    assert sum(cell.stars != "" for table in tables for row in table.cells for cell in row) > 10
    means = [table for table in tables if table.name.startswith("summary")]
    assert all(markdown_table(table) in text and latex_table(table) in tex for table in means)
    assert text.count("| Method |") == tex.count(r"\label") == len(means) == 2, "details are left out"
    for table in (*tables, PLAIN, MARKED, OF_NASTY_NAMES):
        assert markdown_cells(markdown_table(table)) == said(table)
        assert latex_cells(latex_table(table)) == said(table)
        assert html_cells(html_blocks([table])) == said(table)


def test_latex_is_tables_and_comments(report):
    """Text between the tables is comments alone, so that the file can be included anywhere."""
    text = latex_text(report)
    outside = re.sub(r"\\begin\{table\}.*?\\end\{table\}", "", text, flags=re.DOTALL)
    assert all(not line or line.startswith("%") for line in outside.splitlines())
    assert all(caution in outside for caution in report.cautions) and report.cautions
    for table in re.findall(r"\\begin\{table\}.*?\\end\{table\}", text, flags=re.DOTALL):
        assert table.count("{") - table.count(r"\{") == table.count("}") - table.count(r"\}")
        assert (table.count("$") - table.count(r"\$")) % 2 == 0
        columns = len(re.search(r"\\begin\{tabular\}\{(.*)\}", table).group(1))
        rows = [line for line in table.splitlines() if line.endswith(r"\\")]
        assert {len(re.split(r"(?<!\\)&", row)) for row in rows} == {columns}
        assert table.isascii()
    text = latex_text(made_page())
    assert r"\caption{Means (8 scenes)}" in text and r"\label{tab:summary}" in text and r"\begin{tabular}{lr}" in text
    assert "other & --$^{a}$ \\\\\n\\midrule\nprinted" in text and "% A & b\n% careful" in text
    assert r"{\footnotesize $^{a}$ no weights. $\pm$ over scenes.}" in text
    nasty = latex_table(OF_NASTY_NAMES)
    assert r"a\_b \& 50 \% $<$of$>$ \{x\} \$y\$ \#1 \textasciitilde{} \textasciicircum{} \textbackslash{}z $|$" in nasty
    assert r"\caption{run \texttt{coliags list\_all}, or \textasciigrave{}a}" in latex_table(
        Table("run `coliags list_all`, or `a", [], [])
    )


def test_text_for_the_terminal():
    printed = "A <title>\nmethod   n  psnr (dB)\na&b     12      31.46\nc        -          -\na note."
    assert str(PLAIN) == repr(PLAIN) == printed and PLAIN._repr_html_() == html_blocks([PLAIN])
    text = page_text(made_page())
    assert text.startswith("length  3.142 mm²\nlong    words (a remark)\nResearch <use>\ncareful\n\nTables\nwhy <so>\n")
    lines = ["coliags 31.20 ± 0.30*", "other - [a]", "printed 30.1", "[a] no weights.", "± over scenes."]
    assert "\n".join(lines) in re.sub(" +", " ", text)
    assert "what: it is. Mend it" in text and "a/mesh.ply: the mesh" in text
    assert not any(word in text for word in ("Recorded", "Nested", "a&b", "Seen", "Images", "Nothing"))


def test_html_page(tmp_path):
    write_html(made_page(), tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text()
    body = re.sub(r"<(style|script)>.*?</\1>", "", text, flags=re.S).replace(" hidden", ' hidden=""')
    tree = ET.fromstring(re.sub(r"(<meta[^>]*|<img[^>]*)>", r"\1/>", body.split("\n", 1)[1]))
    words = " ".join(" ".join(tree.itertext()).split())
    assert "A & b" in words and "3.142 mm²" in words and "why <so>" in words and "empty" not in words
    assert [each.text for each in tree.iter("h2")] == ["Tables", "Found", "Files", "Recorded", "Seen", "Images"]
    assert [each.text for each in tree.iter("h3")] == ["Nested", "Two"]
    assert tree.find(".//span[@class='best']").text == "31.20" and tree.find(".//span[@class='second']").text == "30.1"
    assert [row.get("class") for row in tree.iter("tr")].count("published") == 1
    assert [each.get("class") for each in tree.iter("i")][:2] == ["swatch s0", "swatch s1 dash1"]
    notes = {each.get("data-columns"): each for each in tree.iter("li") if each.get("data-columns")}
    assert notes["psnr"].get("hidden") is None and notes["more"].get("hidden") == ""
    assert tree.find(".//a[@href='a/mesh.ply']").text == "mesh.ply"
    assert len(list(tree.iter("svg"))) == 2 and all(each.get("src")[:5] == "data:" for each in tree.iter("img"))
    assert not (tmp_path / "page_files").exists()
    write_html(made_page(), tmp_path / "again.html")
    assert (tmp_path / "again.html").read_text() == text


def test_settings_in_backticks_are_code_in_html():
    table = Table("", [Column("name", "Name")], [{"name": "a"}], notes=["run `coliags list`"])
    blocks = [Paragraph("Set `losses.depth=null` for <a>"), Bullets([Bullet("or `steps=9`")]), table]
    text = html_blocks(blocks)
    assert "Set <code>losses.depth=null</code> for &lt;a&gt;" in text and "or <code>steps=9</code>" in text
    assert "<code>coliags list</code>" in text


def test_pictures_without_room_are_written_beside_the_page(tmp_path):
    page = made_page()
    write_html(page, tmp_path / "page.html", limit=len(html_text(page)) + 450)
    files = {path.name for path in (tmp_path / "page_files").iterdir()}
    text = (tmp_path / "page.html").read_text()
    assert len(files) == 1 and f'src="page_files/{min(files)}"' in text and text.count('src="data:') == 1
    assert "1 picture in the folder page_files beside this page" in text
    (tmp_path / "page_files" / "notes.txt").write_text("mine")
    write_html(page, tmp_path / "page.html")
    assert [path.name for path in (tmp_path / "page_files").iterdir()] == ["notes.txt"]
    with pytest.raises(InputError, match="is a folder"):
        write_html(page, tmp_path)


def test_markdown():
    text = markdown_text(made_page())
    facts = "- length: 3.142 mm²\n- long: words (a remark)\n\n- **careful**"
    assert text.startswith(f"# A & b\n\n> Research \\<use\\>\n\n{facts}")
    assert "**Means** (8 scenes)\n\n| Method | PSNR ↑ \\[dB\\] |\n| --- | ---: |\n" in text
    assert "<sup>a</sup> no weights.  \n± over scenes." in text and "Nested" not in text and "Seen" not in text
    assert "[mesh.ply](a/mesh.ply): the mesh" in text


def test_json_values():
    values = json.loads(json.dumps(page_values(made_page())))
    assert values["facts"] == {"length": {"value": 3.14159, "unit": "mm^2"}, "empty": "", "long": "words"}
    tables, recorded = values["sections"][0], values["sections"][3]
    (table,) = tables["tables"]
    assert table["rows"][1] == {"method": "other", "psnr": None, "more": None}
    assert table["rows"][0]["psnr"] == 31.2 and table["columns"][1]["unit"] == "dB"
    assert tables["sections"][0]["sections"][0]["tables"][0]["rows"][0] == {"method": "a&b", "n": 12, "psnr": 31.456}
    assert recorded["sections"][0]["facts"] == [{"a.b": "yes", "a.c": "0.25"}]


def test_simple_tables_and_empty_blocks():
    assert (
        terminal_text([simple_table(["name", "value"], [["a", 1.5], ["b", None]])])
        == "name  value\na       1.5\nb         -"
    )
    assert terminal_text([Section("Charts", [Figures([CHART])])]) == ""
    assert "<svg" not in html_blocks([Figures([Chart([], "x", "y")])])
    large = {str(index): index for index in range(20)}
    assert leaves({"a": large, "b": {"c": 1}}) == [("a", large), ("b.c", 1)]
    address = "picture:0123456789abcdef0123"
    assert address in html_text(Page(address, []))


@pytest.mark.parametrize(("count", "columns"), [(0, 1), (1, 1), (4, 4), (5, 3), (6, 3), (7, 4), (8, 4), (9, 3)])
def test_rows_of_pictures_are_filled_evenly(count, columns):
    assert columns_of(count) == columns
    page = html_blocks([Figures([Image(PICTURES[0], "a picture")] * count)])
    assert (f"--cells: {columns}" in page) == (count > 0)


# Tables and numbers


@given(st.lists(st.none() | st.floats(-100, 100), max_size=8), st.sampled_from(["higher", "lower", None]))
@example([30.001, 30.004, 29.0, 29.0, None, 28.0], "higher")  # places are shared by printed values, and then skipped
def test_a_rank_counts_the_better_printed_values(values, direction):
    cells = ranked_cells(values, "dB", direction)
    sign = {"higher": -1.0, "lower": 1.0, None: 0.0}[direction]
    keys = [sign * float(cell.text) for cell in cells if cell.text]
    assert [cell.value is None for cell in cells] == [value is None for value in values]
    if direction is None or len(keys) < 2:
        assert {cell.rank for cell in cells} <= {None}
    else:
        ranks = [1 + sum(other < key for other in keys) for key in keys]
        assert [cell.rank for cell in cells if cell.text] == ranks


@pytest.mark.parametrize(
    ("unit", "values", "printed"),
    [
        ("dB", [30.126, 9.0], ["30.13", "9.00"]),
        ("", [0.91234], ["0.9123"]),
        ("mm^2", [0.5, 20.0], ["0.500", "20.000"]),
        ("mm^2", [0.0123, 1.0], ["0.0123", "1.0000"]),
        ("mm", [0.000004], ["0.0000"]),
        ("mm", [1234.5, 200.0], ["1234", "200"]),
        ("mm", [0.0, None], ["0.00", ""]),
    ],
)
def test_decimals(unit, values, printed):
    assert [cell.text for cell in ranked_cells(values, unit, "lower")] == printed


def test_spreads_have_the_decimals_of_their_values_and_nothing_is_minus_zero():
    cells = ranked_cells([30.0, None], "dB", "higher", [0.126, 3.0])
    assert [cell.spread for cell in cells] == ["0.13", ""]
    assert [number_text(value, 2) for value in (-0.001, -0.006)] == ["0.00", "-0.01"]


def test_equal_footnotes_share_a_mark_and_hidden_columns_have_none():
    columns = [Column("a", "A"), Column("b", "B", shown=False), Column("c", "C")]
    rows = [
        {"a": TableCell(note="x"), "b": TableCell(note="hidden"), "c": TableCell(note="y")},
        {"a": TableCell(note="y"), "b": 1.0, "c": TableCell(note="x")},
    ]
    table = Table("T", columns, rows)
    assert list(table.footnotes.values()) == [
        Footnote("a", "x", ("a", "c")),
        Footnote("b", "y", ("c", "a")),
        Footnote("c", "hidden", ("b",)),
    ]
    shown = table.only_shown()
    assert [column.key for column in shown.columns] == ["a", "c"]
    assert [note.mark for note in shown.footnotes.values()] == ["a", "b"]


@pytest.mark.parametrize(
    ("text", "values", "printed"),
    [
        (lambda number: counted(number, "frame"), [1, 0, 1200], ["1 frame", "0 frames", "1,200 frames"]),
        (
            duration,
            [0.26, 59.0, 59.97, 61.0, 7322.0],
            ["0.3 s", "59.0 s", "1 min 00 s", "1 min 01 s", "2 h 02 min"],
        ),
        (file_size, [4e5, 9.9e8, 3.44e9], ["0 MB", "990 MB", "3.4 GB"]),
        (
            plain,
            [None, True, 0.25, -0.0, 3, "x", [1, 2.5], list(range(9)), {"a": 1}],
            ["", "yes", "0.25", "0", "3", "x", "1, 2.5", "0, 1, …, 8 (9)", "1 entries"],
        ),
    ],
)
def test_numbers_as_people_read_them(text, values, printed):
    assert [text(value) for value in values] == printed
