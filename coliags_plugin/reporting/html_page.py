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
from typing import ClassVar

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from jinja2.environment import TemplateModule
from markupsafe import Markup, escape

from coliags_plugin.core import __version__
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_write
from coliags_plugin.reporting.colormaps import ColorMap, color_table, scale_ticks
from coliags_plugin.reporting.image_files import EncodedImage
from coliags_plugin.reporting.model import Block, Figure, Page, Series
from coliags_plugin.reporting.numbers import (
    DASH,
    counted,
    linear_ticks,
    log_ticks,
    sentence,
    tick_label,
    unit_text,
)

#: Colours of series; a series beyond them takes the first one again, dashed.
COLORS = 8
#: Colours of a gradient, and width of one character of an x tick label, view box units.
_STOPS, _LABEL_ROOM = 16, 7.5
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


def pictures_folder(output: Path) -> Path:
    """Folder of the pictures that a page has no room for."""
    return output.with_name(f"{output.stem}_files")


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
    folder = None if output is None else pictures_folder(output)
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
    functions = (color_stops, columns_of, enumerate, scale_ticks, sentence, style_classes, tick_label, unit_text)
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


def style_classes(style: int) -> str:
    """CSS classes of a series style."""
    return f"s{style % COLORS}" + (f" dash{style // COLORS}" if style >= COLORS else "")


def color_stops(color_map: ColorMap) -> list[tuple[float, str]]:
    """Offsets, 0 to 1, and hexadecimal colours of a gradient."""
    table = color_table(color_map)
    return [(index / _STOPS, bytes(table[round(index / _STOPS * 255)]).hex()) for index in range(_STOPS + 1)]


class Axes:
    """Mapping from the values of series, which have points, to the coordinates of a chart's view box.

    The template ``charts.html`` draws it as SVG without colours, so that it can be read on a light and on a dark page:
    classes of the style sheet give them. ``names`` are those of x = 0, 1, ... of a categorical axis.
    """

    width: ClassVar[int] = 600
    height: ClassVar[int] = 300
    left: ClassVar[int] = 68
    right: ClassVar[int] = 586
    top: ClassVar[int] = 12
    bottom: ClassVar[int] = 250

    def __init__(
        self,
        series: Sequence[Series],
        log_y: bool = False,
        names: Sequence[str] | None = None,
        equal_scales: bool = False,
    ) -> None:
        self._log_y, self._names = log_y, names
        xs, ys = zip(*(point for line in series for point in line.points(log_y) if point), strict=True)
        self._x_limits = (min(xs), max(xs)) if names is None else (-0.5, len(names) - 0.5)
        if self._x_limits[0] == self._x_limits[1]:
            self._x_limits = self._x_limits[0] - 0.5, self._x_limits[1] + 0.5
        low, high = min(ys), max(ys)
        if log_y:
            # At least half a decade, so that there are tick labels.
            margin = max(1.1, math.sqrt(10.0**0.5 / min(high / low, 10.0**0.5)))
            self._y_limits = low / margin, high * margin
        else:
            margin = 0.06 * (high - low) or max(abs(high), 1.0) * 0.05
            self._y_limits = low - margin, high + margin
        if equal_scales:
            sides = [(self._x_limits, self.right - self.left), (self._y_limits, self.bottom - self.top)]
            unit = max((high - low) / length for (low, high), length in sides)
            self._x_limits, self._y_limits = (
                ((low + high - unit * length) / 2, (low + high + unit * length) / 2) for (low, high), length in sides
            )

    def x(self, value: float) -> float:
        """Horizontal coordinate of a value."""
        low, high = self._x_limits
        return self.left + (value - low) / (high - low) * (self.right - self.left)

    def y(self, value: float) -> float:
        """Vertical coordinate of a value."""
        low, high = self._y_limits
        share = math.log(value / low) / math.log(high / low) if self._log_y else (value - low) / (high - low)
        return self.bottom - share * (self.bottom - self.top)

    @property
    def y_ticks(self) -> list[tuple[float, str]]:
        """Coordinates and labels of the y axis."""
        ticks = log_ticks(*self._y_limits) if self._log_y else linear_ticks(*self._y_limits)
        return [(self.y(tick), tick_label(tick)) for tick in ticks]

    @property
    def x_ticks(self) -> list[tuple[float, str]]:
        """Coordinates and labels of the x axis; of many names, some."""
        if (names := self._names) is None:
            return [(self.x(tick), tick_label(tick)) for tick in linear_ticks(*self._x_limits)]
        longest = max(map(len, names)) + 2
        room = max(1, int((self.right - self.left) / (longest * _LABEL_ROOM)))
        return [(self.x(index), names[index]) for index in range(0, len(names), math.ceil(len(names) / room))]

    def paths(self, line: Series) -> list[str]:
        """SVG paths of the uninterrupted segments of a line."""
        segments: list[list[str]] = [[]]
        for point in line.points(self._log_y):
            if point is None:
                segments.append([])
            else:
                segments[-1].append(f"{self.x(point[0]):.1f} {self.y(point[1]):.1f}")
        # A segment of one point is visible too: round caps draw a line of no length as a dot.
        return ["M" + "L".join(s if len(s) > 1 else s * 2) for s in segments if s]

    def markers(self, line: Series) -> list[tuple[float, float, str]]:
        """Coordinates and label of a marker at every point of a line."""
        return [
            (self.x(x), self.y(y), f"{line.name}, {self._names[int(x)] if self._names else tick_label(x)}: {y:.4g}")
            for x, y in filter(None, line.points(self._log_y))
        ]
