"""HTML pages: one file that works without a server, without other files and, but for choosing, without scripts.

The same page gives the same bytes: the file contains neither the time nor the machine it was written on.
"""

from __future__ import annotations

import hashlib
import math
import re
import shutil
from collections.abc import Sequence
from functools import cache, cached_property
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from jinja2.environment import TemplateModule
from markupsafe import Markup, escape

from coliags_plugin.core import __version__
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_write
from coliags_plugin.reporting.charts import Axes, color_stops, style_classes
from coliags_plugin.reporting.image_files import EncodedImage
from coliags_plugin.reporting.model import Block, Figure, Page
from coliags_plugin.reporting.numbers import DASH, counted, linear_ticks, sentence, tick_label, unit_text

#: Largest page, bytes; pictures that have no room in it are written into a folder beside it.
PAGE_LIMIT = 40_000_000

_ASSETS = Path(__file__).with_name("assets")
#: Names of pictures beside a page; nothing else is ever removed.
_NAME = re.compile(r"[0-9a-f]{20}\.(jpg|png|webp)")
#: Bytes of a note, and where it is: how many pictures are beside the page.
_NOTE_ROOM = 500
_BESIDE = "<!-- pictures beside the page -->"
#: A setting that a message quotes.
_QUOTED = re.compile(r"`([^`]+)`")
#: Where a picture's address will be.
_PLACEHOLDER = re.compile(r"picture:([0-9a-f]{20})")


def write_html(page: Page, output: Path, limit: int = PAGE_LIMIT) -> None:
    """Write a page; pictures that do not fit into ``limit`` bytes go into a folder beside it."""
    refuse_folder(output)
    atomic_write(output, html_text(page, output, limit))


def html_text(page: Page, output: Path | None = None, limit: int = PAGE_LIMIT) -> str:
    """A page as HTML, all pictures within it, or those beyond ``limit`` bytes in files beside ``output``."""
    style, script = (Markup((_ASSETS / name).read_text(encoding="utf-8")) for name in ("page.css", "page.js"))
    writer = _Writer()
    text = writer.filled("page.html", page=page, style=style, script=script, version=__version__)
    return _with_pictures(text, writer.pictures, output, limit)


def html_blocks(blocks: Sequence[Block | Figure]) -> str:
    """Blocks or figures as HTML without a page around them, all pictures within the text."""
    writer = _Writer()
    return _with_pictures("".join(map(writer.show, blocks)), writer.pictures)


def refuse_folder(output: Path) -> None:
    """Raise InputError where the output path is a folder."""
    if output.is_dir():
        raise InputError(f"{output} is a folder", "a file", f"Write to {output / 'report.html'}")


class _Writer:
    """Writer of blocks and figures by the macros that ``blocks.html`` has of their kinds; collects their pictures."""

    def __init__(self) -> None:
        self.pictures: dict[str, EncodedImage] = {}
        self._names = {"show": self.show, "filled": self.filled, "address": self.address}

    def show(self, block: Block | Figure, level: int = 2) -> Markup:
        return Markup(getattr(self._macros, block.kind)(block, level))

    @cached_property
    def _macros(self) -> TemplateModule:
        return environment(_ASSETS).get_template("blocks.html").make_module(self._names)

    def filled(self, file: str, **values: object) -> Markup:
        """The text of a template, with placeholders for pictures."""
        return Markup(environment(_ASSETS).get_template(file).render(values | self._names))

    def address(self, image: EncodedImage) -> str:
        """Placeholder for the address of a picture."""
        key = hashlib.sha256(image.data).hexdigest()[:20]
        self.pictures[key] = image
        return f"picture:{key}"


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
            return image.uri
        if key not in beside:
            beside[key] = key + image.suffix
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
    templates = Environment(
        loader=FileSystemLoader(assets),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    functions = (color_stops, columns_of, enumerate, linear_ticks, sentence, style_classes, tick_label, unit_text)
    templates.filters["prose"] = prose
    templates.globals |= {"dash": DASH, "axes_of": Axes, **{function.__name__: function for function in functions}}
    return templates


def prose(text: str) -> Markup:
    """Text as HTML, with settings in backticks as code."""
    return Markup(_QUOTED.sub(r"<code>\1</code>", str(escape(text))))


def columns_of(count: int) -> int:
    """Pictures in a row, at most four, such that rows are filled evenly: 3 for six pictures."""
    return math.ceil(count / math.ceil(count / 4)) if count else 1


def _remove_former(folder: Path, present: set[str]) -> None:
    """Remove the pictures of a former page of this name that this one has not."""
    if not folder.is_dir():
        return
    for file in folder.iterdir():
        if _NAME.fullmatch(file.name) and file.name not in present:
            file.unlink()
    if not any(folder.iterdir()):
        shutil.rmtree(folder)
