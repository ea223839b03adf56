"""Reading text of unknown origin."""

from __future__ import annotations

import codecs
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from io import TextIOWrapper
from pathlib import Path

from coliags_plugin.core import bounds
from coliags_plugin.core.errors import InputError

#: Bytes of a file that tell its encoding, and what is in its place.
_START_BYTES = 512


def encoding_of(start: bytes) -> str:
    """The encoding of a text that begins with these bytes: UTF-16 by its byte order mark, else UTF-8."""
    return "utf-16" if start.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) else "utf-8-sig"


def _stand_in(start: bytes) -> str:
    """Describe a Git LFS pointer or web page that is there instead of a file, by its first bytes; empty if neither."""
    start = start.removeprefix(codecs.BOM_UTF8).lstrip().lower()
    if start.startswith(b"version https://git-lfs"):
        return "it is a pointer of Git LFS, in the place of the file, which `git lfs pull` fetches"
    if start.startswith((b"<!doctype html", b"<html")):
        return "it is a web page (HTML), in the place of the file: download the file itself"
    return ""


def unreadable(path: Path, seen: str, expected: str, do: str = "") -> InputError:
    """Error for a file that cannot be parsed: ``seen``, or that it is a Git LFS pointer or a web page."""
    try:
        with path.open("rb") as file:
            stand_in = _stand_in(file.read(_START_BYTES))
    except OSError:
        stand_in = ""
    return InputError(f"cannot read {path}: {stand_in}" if stand_in else seen, expected, "" if stand_in else do)


def whole_text(path: Path, most: int = bounds.TEXT_BYTES) -> str:
    """The content of a file of at most so many bytes, UTF-8, or UTF-16 with a byte order mark; else ValueError."""
    size = path.stat().st_size
    if size > most:
        raise ValueError(f"it has {size:,} bytes, and at most {most:,} are read")
    with _opened(path) as text:
        return text.read()


def read_text(path: Path, expected: str) -> str:
    """The content of a file, as :func:`whole_text`, for readers of what users wrote."""
    try:
        return whole_text(path)
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read {path}: {error}", expected) from error


def text_lines(path: Path, expected: str) -> Iterator[tuple[int, str]]:
    """The lines of a text file, as :func:`whole_text`, with their numbers, from 1, one by one: files may be large."""
    try:
        with _opened(path) as text:
            yield from enumerate(text, start=1)
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read {path}: {error}", expected) from error


@contextmanager
def _opened(path: Path) -> Iterator[TextIOWrapper]:
    """A text file, opened once, as it may be a pipe; ValueError if something is in its place."""
    with path.open("rb") as file:
        start = file.peek(_START_BYTES)[:_START_BYTES]
        if stand_in := _stand_in(start):
            raise ValueError(stand_in)
        yield TextIOWrapper(file, encoding=encoding_of(start))


def shortened(line: str) -> str:
    """A line shortened for messages."""
    text = line.strip()
    return text if len(text) <= 60 else f"{text[:57]}..."


def without_places(text: str, places: Iterable[Path]) -> str:
    """A message in which files and folders, and what they hold, stand without the absolute path that leads to them."""
    parents = {path.parent for place in places for path in (place.absolute(), place.resolve())}
    for parent in sorted(parents, key=lambda parent: -len(parent.parts)):  # the longest first, as they may be nested
        if parent != parent.parent:
            text = text.replace(f"{parent}/", "")
    return text
