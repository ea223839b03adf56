"""Type of the progress callbacks that long jobs call."""

from __future__ import annotations

from collections.abc import Callable

#: Called with a description of the work, the number of units done, and their total.
Progress = Callable[[str, int, int], None]
