"""Leaving out of what is written where on whose machine the data were."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

#: Absolute paths in a text: of at least two parts, so that units like mm/s and fractions stay. Quoted ones may hold
#: blanks.
_PATH = re.compile(r"""(?<![\w.<:/])(?:~|[A-Za-z]:)?(?:[/\\][^\s/\\'"<>|,;:()\[\]]+)+[/\\]([^\s/\\'"<>|,;:()\[\]]*)""")
_WHOLE = re.compile(r"(?:~|[A-Za-z]:)?[/\\][^\n]*")


def without_places(value: Any) -> Any:
    """Plain data without absolute paths, of each of which the last part stays.

    A text that begins like an absolute path is taken for one, blanks included; paths are also found within texts.
    """
    if isinstance(value, str):
        if _WHOLE.fullmatch(value):
            return re.split(r"[/\\]", value.rstrip("/\\"))[-1]
        return _PATH.sub(lambda found: found[1], value)
    if isinstance(value, Path):
        return value.name if value.is_absolute() else str(value)
    if isinstance(value, Mapping):
        return {key: without_places(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(without_places(item) for item in value)
    return value
