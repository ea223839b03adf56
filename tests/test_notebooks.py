"""The example notebooks execute, and what they have stored is what they show."""

from __future__ import annotations

import json
import re
from pathlib import Path
from runpy import run_path

import pytest

pytestmark = pytest.mark.thorough

ROOT = Path(__file__).parents[1]
TOOLS = run_path(str(ROOT / "docs" / "tools" / "notebooks.py"))
PATH = ROOT / "docs" / "notebooks" / "first_reconstruction.ipynb"


def test_what_is_stored_is_small_whole_and_of_no_machine_and_on_its_page():
    text = PATH.read_text(encoding="utf-8")
    notebook = json.loads(text)
    assert list(PATH.parent.glob("*.ipynb")) == [PATH]
    assert len(text) < 1_500_000, "what a page can hold"
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    assert not any("stream" in output["output_type"] for cell in code for output in cell["outputs"])
    assert not re.search(r"/root|/home|/work|/tmp", text)
    assert TOOLS["plain"](notebook) == notebook | {"nbformat_minor": 5}, "make notebooks"
    page = TOOLS["as_markdown"](PATH)
    assert page.startswith("# ") and "```python\nimport numpy" in page
    assert page.count('src="data:image/png;base64,') >= 5 and page.count("<table") >= 2


def test_it_executes_and_shows_what_is_stored(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    notebooks = (TOOLS["execute"](PATH, tmp_path), json.loads(PATH.read_text(encoding="utf-8")))
    cells = [[cell for cell in notebook["cells"] if cell["cell_type"] == "code"] for notebook in notebooks]
    executed, stored = (
        [[sorted(output.get("data", [output.get("name")])) for output in cell["outputs"]] for cell in of_notebook]
        for of_notebook in cells
    )
    assert executed == stored
