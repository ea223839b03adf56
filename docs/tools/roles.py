"""Griffe extension for two conventions of this package's docstrings.

Sphinx's roles, as in :class:`Scene`, become links where the name can be found; comments ``#:`` above an attribute
become its docstring.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import griffe

ROLE = re.compile(r":(?:class|meth|attr|func|data|mod|exc):`~?([^`]+)`")


class Roles(griffe.Extension):
    """Rewrites docstrings once all modules are read."""

    def on_object(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        """Rewrite one docstring; called for every object when all are loaded."""
        if obj.is_attribute and obj.docstring is None and (comment := _comment_above(obj)):
            obj.docstring = griffe.Docstring(comment, parent=obj)
        if obj.docstring is not None:
            obj.docstring.value = ROLE.sub(lambda role: _link(obj, role[1]), obj.docstring.value)


def _comment_above(obj: griffe.Object) -> str:
    """The lines that begin with ``#:`` right above an attribute."""
    if obj.lineno is None or not isinstance(obj.filepath, Path):
        return ""
    lines = obj.lines_collection[obj.filepath]
    first = last = obj.lineno - 1
    while first > 0 and lines[first - 1].strip().startswith("#:"):
        first -= 1
    return " ".join(line.strip().removeprefix("#:").strip() for line in lines[first:last])


def _link(obj: griffe.Object, name: str) -> str:
    """A link to a name as the object's docstring may write it, or code where it is not known or not documented."""
    try:
        path = _target(obj, name)
    except (KeyError, griffe.GriffeError):
        return f"`{name}`"
    return f"[`{name}`][{path}]"


def _target(obj: griffe.Object, name: str) -> str:
    first, *rest = name.split(".")
    if first == obj.package.name:
        found = obj.package[".".join(rest)] if rest else obj.package
    else:
        found = obj.package[obj.resolve(first).removeprefix(f"{obj.package.name}.")]
        for part in rest:
            found = found[part]
    found = found.final_target if found.is_alias else found
    if found.docstring is None or any(part.startswith("_") for part in found.path.split(".")):
        raise KeyError(found.path)
    return found.path
