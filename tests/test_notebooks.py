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
each_notebook = pytest.mark.parametrize(
    "path", sorted((ROOT / "docs" / "notebooks").glob("*.ipynb")), ids=lambda path: path.stem
)


@each_notebook
def test_what_is_stored_is_small_whole_and_of_no_machine_and_on_its_page(path):
    text = path.read_text(encoding="utf-8")
    notebook = json.loads(text)
    assert len(text) < 400_000, "what a page can hold"
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    assert not any("stream" in output["output_type"] for cell in code for output in cell["outputs"])
    assert not re.search(r"/root|/home|/work|/tmp", text)
    assert TOOLS["plain"](notebook) == notebook | {"nbformat_minor": 5}, "make notebooks"
    page = TOOLS["as_markdown"](path)
    assert page.startswith("# ") and "```python\nimport" in page
    assert len(re.findall('src="data:image/(png|jpeg);base64,', page)) >= 4 and "<table" in page


def test_each_notebook_is_on_the_site_and_on_the_page_of_the_api():
    names = [path.stem for path in (ROOT / "docs" / "notebooks").glob("*.ipynb")]
    menu, page = ((ROOT / name).read_text(encoding="utf-8") for name in ("docs/tools/mkdocs.yml", "docs/api.md"))
    assert all(f"notebooks/{name}.md" in menu and f"notebooks/{name}.ipynb" in page for name in names)


@each_notebook
def test_it_executes_and_shows_what_is_stored(path, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    notebooks = (TOOLS["execute"](path, tmp_path), json.loads(path.read_text(encoding="utf-8")))
    cells = [[cell for cell in notebook["cells"] if cell["cell_type"] == "code"] for notebook in notebooks]
    executed, stored = (
        [[sorted(output.get("data", [output.get("name")])) for output in cell["outputs"]] for cell in of_notebook]
        for of_notebook in cells
    )
    assert executed == stored
