"""Progress callbacks that long jobs call."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

_Item = TypeVar("_Item")

#: Called with a description of the work, the number of units done, and their total.
Progress = Callable[[str, int, int], None]


def with_progress(items: Sequence[_Item], what: str, progress: Progress | None) -> Iterator[_Item]:
    """The items; each is reported when the next one is asked for."""
    for done, item in enumerate(items, start=1):
        yield item
        if progress is not None:
            progress(what, done, len(items))
