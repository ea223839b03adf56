"""HTML pages: one file that works without a server, without other files and, but for choosing, without scripts.

The same page gives the same bytes: the file contains neither the time nor the machine it was written on.
"""

from __future__ import annotations

import hashlib
import math
import re
import shutil
from base64 import b64encode
from collections.abc import Sequence
from functools import cache
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup, escape

from coliags_plugin._version import __version__
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_write
from coliags_plugin.reporting.charts import color_bar_svg, line_chart, style_classes
from coliags_plugin.reporting.model import Block, Chart, ColorBar, EncodedImage, Figure, Image, Page, Template
from coliags_plugin.reporting.numbers import DASH, counted, sentence, unit_text

#: Largest page, bytes; pictures that have no room in it are written into a folder beside it.
PAGE_LIMIT = 40_000_000

_ASSETS = Path(__file__).with_name("assets")
_SUFFIXES = {"image/jpeg": ".jpg", "image/png": ".png", "image/webp": ".webp"}
#: Names of pictures beside a page; nothing else is ever removed.
_NAME = re.compile(r"[0-9a-f]{20}\.(jpg|png|webp)")
#: Bytes of a note, and where it is: how many pictures are beside the page.
_NOTE_ROOM = 500
_BESIDE = "<!-- pictures beside the page -->"
#: Where a picture's address will be.
_PLACEHOLDER = re.compile(r"picture:([0-9a-f]{20})")


def write_html(page: Page, output: Path, limit: int = PAGE_LIMIT) -> None:
    """Write a page; pictures that do not fit into ``limit`` bytes go into a folder beside it."""
    refuse_folder(output)
    atomic_write(output, html_text(page, output, limit))


def html_text(page: Page, output: Path | None = None, limit: int = PAGE_LIMIT) -> str:
    """A page as HTML, all pictures within it, or those beyond ``limit`` bytes in files beside ``output``."""
    pictures: dict[str, EncodedImage] = {}
    style, script = (Markup((_ASSETS / name).read_text(encoding="utf-8")) for name in ("page.css", "page.js"))
    text = _filled(pictures, "page.html", page=page, style=style, script=script, version=__version__)
    return _with_pictures(text, pictures, output, limit)


def html_blocks(blocks: Sequence[Block]) -> str:
    """Blocks as HTML without a page around them, all pictures within the text."""
    pictures: dict[str, EncodedImage] = {}
    return _with_pictures(_filled(pictures, "fragment.html", blocks=blocks), pictures)


def refuse_folder(output: Path) -> None:
    """Raise InputError where the output path is a folder."""
    if output.is_dir():
        raise InputError(f"{output} is a folder", "a file", f"Write to {output / 'report.html'}")


def _filled(pictures: dict[str, EncodedImage], file: str, **values: object) -> Markup:
    """The text of a template, with placeholders for pictures, which are added to ``pictures``."""

    def address(image: EncodedImage) -> str:
        key = hashlib.sha256(image.data).hexdigest()[:20]
        pictures[key] = image
        return f"picture:{key}"

    def filled(block: Template) -> Markup:
        return _filled(pictures, block.file, **block.values)

    return Markup(environment(_ASSETS).get_template(file).render(address=address, filled=filled, **values))


def _with_pictures(text: str, pictures: dict[str, EncodedImage], output: Path | None = None, limit: int = 0) -> str:
    """A text with the addresses of its pictures: data URIs while there is room, then files beside the output."""
    room = limit - len(text.encode()) - _NOTE_ROOM
    folder = None if output is None else output.with_name(f"{output.stem}_files")
    beside: dict[str, str] = {}

    def address(match: re.Match[str]) -> str:
        nonlocal room
        key = match.group(1)
        if key not in pictures:
            return match.group()
        image = pictures[key]
        room -= 4 * ((len(image.data) + 2) // 3)
        if folder is None or (room >= 0 and not beside):
            return f"data:{image.mime};base64,{b64encode(image.data).decode('ascii')}"
        if key not in beside:
            beside[key] = key + _SUFFIXES[image.mime]
            atomic_write(folder / beside[key], image.data)
        return f"{folder.name}/{beside[key]}"

    text = _PLACEHOLDER.sub(address, text)
    if folder is None:
        return text
    _remove_former(folder, set(beside.values()))
    note = f"{counted(len(beside), 'picture')} in the folder {folder.name} beside this page: they belong together."
    return text.replace(_BESIDE, f"<p>{escape(note)}</p>" if beside else "")


@cache
def environment(assets: Path) -> Environment:
    """The Jinja environment of the templates in a folder."""
    loader = FileSystemLoader(assets)
    made = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    functions = (columns_of, drawn, enumerate, sentence, style_classes, unit_text)
    made.tests["a"] = lambda block, kind: kind in (each.__name__ for each in type(block).__mro__)
    made.globals |= {"dash": DASH, **{function.__name__: function for function in functions}}
    return made


def columns_of(count: int) -> int:
    """Pictures in a row, at most four, such that rows are filled evenly: 3 for six pictures."""
    return math.ceil(count / math.ceil(count / 4)) if count else 1


def drawn(figures: Sequence[Figure]) -> list[tuple[Figure, Markup]]:
    """Figures with their SVG, without charts that have no point to draw."""
    return [(figure, Markup(_svg(figure))) for figure in figures if not isinstance(figure, Chart) or figure.has_points]


def _svg(figure: Figure) -> str:
    """SVG of a chart or colour bar; empty for pictures."""
    if isinstance(figure, Image):
        return ""
    if isinstance(figure, ColorBar):
        return color_bar_svg(figure.limits, figure.unit, figure.color_map, figure.label, figure.name)
    return line_chart(
        figure.series,
        figure.x_label,
        figure.y_label,
        log_y=figure.log_y,
        x_names=figure.x_names,
        markers=figure.markers,
    )


def _remove_former(folder: Path, kept: set[str]) -> None:
    """Remove the pictures of a former page of this name that this one has not."""
    if not folder.is_dir():
        return
    for file in folder.iterdir():
        if _NAME.fullmatch(file.name) and file.name not in kept:
            file.unlink()
    if not any(folder.iterdir()):
        shutil.rmtree(folder)
