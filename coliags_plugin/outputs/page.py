"""Self-contained HTML pages in a common style."""

from __future__ import annotations

import base64
import re
from collections.abc import Iterable, Mapping
from html import escape
from pathlib import Path
from string import Template
from typing import Any

from coliags_plugin._version import __version__
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_write
from coliags_plugin.outputs.axis_ticks import tick_label

_TEMPLATE = Path(__file__).with_name("page_template.html")
_LONGEST_LIST = 6
_LARGEST_MAPPING = 12
_ABSOLUTE_PATH = re.compile(r"^(/|~|[A-Za-z]:[\\/]|\\\\|file:)")


def write_page(
    output: Path, title: str, header: str, sections: Iterable[str], style: str = "", script: str = ""
) -> None:
    """Write an HTML page.

    Args:
        output: The file; an existing one is replaced.
        title: Page title, plain text.
        header: HTML of the heading.
        sections: HTML; empty ones are left out.
        style: CSS, after that of all pages.
        script: JavaScript, run once the page is there.

    Raises:
        InputError: ``output`` is a folder, or cannot be written.
    """
    refuse_folder(output)
    page = Template(_TEMPLATE.read_text(encoding="utf-8")).substitute(
        title=escape(title),
        style=style,
        header=header,
        script=f"<script>\n{script}</script>" if script else "",
        sections="\n".join(filter(None, sections)),
        footer=f"Written by coliags_plugin {escape(__version__)}.",
    )
    atomic_write(output, page)


def refuse_folder(output: Path) -> None:
    """Raise InputError where the output path is a folder."""
    if output.is_dir():
        raise InputError(f"{output} is a folder", "a file", f"Write to {output / 'report.html'}")


def fact_list(facts: Mapping[str, str]) -> str:
    """HTML list of names and values; empty values are left out."""
    items = "".join(f"<div><dt>{escape(k)}</dt><dd>{escape(v)}</dd></div>" for k, v in facts.items() if v)
    return f'<dl class="facts">{items}</dl>'


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """HTML table; cells are plain text, the first of each row is its header."""
    columns = "".join(f'<th scope="col">{escape(cell)}</th>' for cell in head)
    lines = []
    for first, *others in rows:
        cells = "".join(f"<td>{escape(cell)}</td>" for cell in others)
        lines.append(f'<tr><th scope="row">{escape(first)}</th>{cells}</tr>')
    return f'<div class="scroll"><table><thead><tr>{columns}</tr></thead><tbody>{"".join(lines)}</tbody></table></div>'


def figure(png: bytes, caption: str) -> str:
    """HTML figure of an image and its caption, a cell of a ``view`` row."""
    source = base64.b64encode(png).decode()
    name = escape(caption, quote=True)
    return (
        f'<figure class="cell"><div class="name">{name}</div>'
        f'<img src="data:image/png;base64,{source}" alt="{name}"></figure>'
    )


def record(title: str, values: Mapping[str, Any]) -> str:
    """Collapsible HTML list of nested values."""
    texts = ((key, plain(value)) for key, value in leaves(values))
    rows = "".join(f"<dt>{escape(key)}</dt><dd>{escape(text)}</dd>" for key, text in texts if text)
    body = f'<dl class="record">{rows}</dl>' if rows else '<p class="record">nothing recorded</p>'
    return f"<details><summary>{escape(title)}</summary>{body}</details>"


def leaves(values: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    """Leaf values by dotted keys; large mappings are kept whole, and paths of this machine are left out."""
    found: list[tuple[str, Any]] = []
    for key, value in values.items():
        if isinstance(value, Mapping) and len(value) <= _LARGEST_MAPPING:
            found += leaves(value, f"{prefix}{key}.")
        elif key != "path" and not (isinstance(value, str) and _ABSOLUTE_PATH.match(value)):
            found.append((f"{prefix}{key}", value))
    return found


def plain(value: Any) -> str:
    """JSON value as text; long lists are abbreviated to their ends."""
    if isinstance(value, Mapping):
        return f"{len(value)} entries"
    if isinstance(value, (list, tuple)):
        words = [plain(entry) for entry in value]
        if len(words) > _LONGEST_LIST:
            return f"{words[0]}, {words[1]}, …, {words[-1]} ({len(words)})"
        return ", ".join(words)
    if isinstance(value, float):
        return tick_label(value)
    return {None: "", True: "yes", False: "no"}[value] if value is None or isinstance(value, bool) else str(value)
