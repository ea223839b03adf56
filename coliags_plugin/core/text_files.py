"""Reading text of unknown origin."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from coliags_plugin.core import bounds
from coliags_plugin.core.errors import InputError


def whole_text(path: Path, most: int = bounds.TEXT_BYTES) -> str:
    """The content of a file in UTF-8, with or without a byte order mark, of at most so many bytes; else ValueError."""
    size = path.stat().st_size
    if size > most:
        raise ValueError(f"it has {size:,} bytes, and at most {most:,} are read")
    return path.read_text(encoding="utf-8-sig")


def read_text(path: Path, expected: str) -> str:
    """The content of a file, as :func:`whole_text`, for readers of what users wrote."""
    try:
        return whole_text(path)
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read {path}: {error}", expected) from error


def text_lines(path: Path, expected: str) -> Iterator[tuple[int, str]]:
    """The lines of a UTF-8 text file with their numbers, from 1, one after the other: files may be large."""
    try:
        with path.open(encoding="utf-8-sig") as file:
            yield from enumerate(file, start=1)
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read {path}: {error}", expected) from error


def without_places(text: str, places: Iterable[Path]) -> str:
    """A message in which files and folders, and what they hold, stand without the absolute path that leads to them."""
    parents = {path.parent for place in places for path in (place.absolute(), place.resolve())}
    for parent in sorted(parents, key=lambda parent: -len(parent.parts)):  # the longest first, as they may be nested
        if parent != parent.parent:
            text = text.replace(f"{parent}/", "")
    return text
