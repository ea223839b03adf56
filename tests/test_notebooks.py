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
NOTEBOOKS = [ROOT / "docs" / "notebooks" / "first_reconstruction.ipynb"]
#: What a page can hold, bytes.
LARGEST = 1_500_000


def shown(notebook):
    """Types of what each code cell shows, in order."""
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    return [[sorted(output.get("data", [output.get("name")])) for output in cell["outputs"]] for cell in cells]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_it_executes_and_shows_what_is_stored(path, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    executed = TOOLS["execute"](path, tmp_path)
    assert shown(executed) == shown(json.loads(path.read_text(encoding="utf-8")))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_what_is_stored_is_small_whole_and_of_no_machine_and_on_its_page(path):
    text = path.read_text(encoding="utf-8")
    notebook = json.loads(text)
    assert len(text) < LARGEST
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    assert not any("stream" in output["output_type"] for cell in code for output in cell["outputs"])
    assert not re.search(r"/root|/home|/work|/tmp", text)
    assert TOOLS["plain"](notebook) == notebook | {"nbformat_minor": 5}, "make notebooks"
    page = TOOLS["as_markdown"](path)
    assert page.startswith("# ") and "```python\nimport numpy" in page
    assert page.count('src="data:image/png;base64,') >= 5 and page.count("<table") >= 2
