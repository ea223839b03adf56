"""The example notebooks of docs/notebooks: executed with their outputs stored, and as pages of the site.

    python docs/tools/notebooks.py

executes them all in an empty folder and stores what they show, with nothing that differs from one machine to the next.
"""

from __future__ import annotations

import json
import re
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"
#: For one cell, seconds.
PATIENCE = 1800
#: What a report of progress ends with.
TIMES = re.compile(r", took (\d+ min )?[\d.]+ s\b")


def main() -> None:
    """Execute all notebooks and store their outputs."""
    import nbformat

    for path in sorted(NOTEBOOKS.glob("*.ipynb")):
        with tempfile.TemporaryDirectory() as folder:
            executed = execute(path, Path(folder))
        nbformat.write(nbformat.from_dict(executed), path)


def execute(path: Path, folder: Path) -> dict[str, Any]:
    """The notebook with its outputs.

    Args:
        path: The notebook.
        folder: Where to execute it.

    Raises:
        CellExecutionError: A cell failed.
    """
    import nbformat
    from nbclient import NotebookClient

    notebook = nbformat.read(path, as_version=4)
    NotebookClient(notebook, timeout=PATIENCE, resources={"metadata": {"path": str(folder)}}).execute()
    return plain(notebook)


def plain(notebook: dict[str, Any]) -> dict[str, Any]:
    """The notebook without what is of one machine alone: times, versions, the home folder."""
    cells = json.loads(TIMES.sub("", json.dumps(notebook["cells"])).replace(str(Path.home()), "~"))
    for cell in cells:
        cell["metadata"] = {}
        for output in cell.get("outputs", []):
            if "metadata" in output:
                output["metadata"] = {}
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    metadata = {"kernelspec": kernel, "language_info": {"name": "python"}}
    return {"cells": cells, "metadata": metadata, "nbformat": 4, "nbformat_minor": 5}


def as_markdown(path: Path) -> str:
    """The notebook as a page: its text, its code, and what it shows."""
    notebook = json.loads(path.read_text(encoding="utf-8"))
    return "\n\n".join(part for cell in notebook["cells"] for part in _parts(cell)) + "\n"


def _parts(cell: dict[str, Any]) -> Iterator[str]:
    source = "".join(cell["source"])
    if cell["cell_type"] == "markdown":
        yield source
        return
    yield f"```python\n{source}\n```"
    for output in cell["outputs"]:
        shown = output.get("data", {"text/plain": output.get("text", "")})
        if "text/html" in shown:
            yield "".join(shown["text/html"])
        elif "image/jpeg" in shown:
            yield f'<img alt="" src="data:image/jpeg;base64,{shown["image/jpeg"].strip()}">'
        else:
            yield f"```text\n{''.join(shown['text/plain']).rstrip()}\n```"


if __name__ == "__main__":
    main()
