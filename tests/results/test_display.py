"""Tables and summaries of results as people see them."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import pytest

from coliags_plugin.core.errors import InputError
from coliags_plugin.results.display import Table
from tests.results.made import made_result, made_set

TABLE = Table(
    "A <title>",
    ("method", "n", "psnr"),
    [{"method": "a&b", "n": 12, "psnr": 31.456}, {"method": "c"}],
    {"psnr": "psnr (dB)"},
    ["a note"],
)


def test_a_table_as_text():
    assert str(TABLE) == "A <title>\nmethod   n  psnr (dB)\na&b     12      31.46\nc        -          -\na note"
    assert repr(TABLE) == str(TABLE)


def test_a_table_as_html_says_the_same():
    html = ET.fromstring(f"<div>{TABLE._repr_html_()}</div>")
    cells = [[cell.text for cell in row] for row in html.iter("tr")]
    assert cells == [["method", "n", "psnr (dB)"], ["a&b", "12", "31.46"], ["c", "-", "-"]]
    assert html.find("table/caption").text == "A <title>" and html.find("p").text == "a note"


def test_means_of_a_result():
    result = made_result({"test": made_set(), "rotation": made_set(("a",), (20.0,), (None,))})
    assert result.mean("psnr") == 30.75 and result.mean("psnr", "rotation") == 20.0
    assert result.mean("lpips") is None and result.mean("depth_mse", "rotation") is None
    with pytest.raises(InputError, match=r"no metric 'pnsr'.*Did you mean 'psnr'"):
        result.mean("pnsr")
    with pytest.raises(InputError, match=r"no test set 'rotatoin'.*Did you mean 'rotation'"):
        result.mean("psnr", "rotatoin")


def test_a_result_in_one_line_and_as_a_table():
    result = made_result({"test": made_set(), "rotation": made_set(("a",), (20.0,), (None,))})
    assert repr(result) == "coliags on wall, seed 0, 60 steps, protocol paper v1: psnr 30.75 dB, depth_mse 0.25 mm^2"
    table = result.table()
    assert table.rows[0] == {"metric": "psnr", "unit": "dB", "test": 30.75, "rotation": 20.0}
    assert table.notes == ["not shown: lpips: no weights"]
    assert "test (2 frames)  rotation (1 frames)" in str(result) == str(table)
    assert result._repr_html_() == table._repr_html_()
