"""The components of a method, and the line of the user's code that an exception comes from."""

from __future__ import annotations

import sys
import sysconfig
import traceback
from collections.abc import Iterator
from inspect import unwrap
from pathlib import Path
from types import CodeType
from typing import Any

from coliags_plugin.config.components import Component
from coliags_plugin.config.method_config import MethodConfig
from coliags_plugin.core.errors import ReportedError

_PACKAGE = Path(__file__).parents[2]
#: Code of the checks themselves, never the cause.
_CHECKS = Path(__file__).parent
_LIBRARIES = tuple(Path(sysconfig.get_path(name)) for name in ("stdlib", "platstdlib", "purelib", "platlib"))


def components(config: MethodConfig) -> dict[str, Component]:
    """Every component of a method by its path in the config, for instance ``field.geometry_head``."""
    fields = {name: getattr(config, name) for name in type(config).model_fields}
    return {path: node for name, value in fields.items() for path, node in _nested(name, value)}


def _nested(path: str, node: Any) -> Iterator[tuple[str, Component]]:
    """Paths and components of a value of the config: itself, its entries, or those among its options."""
    children: dict[str, Any] = node if isinstance(node, dict) else {}
    if isinstance(node, Component):
        yield path, node
        children = {name: getattr(node.settings, name) for name in type(node.settings).model_fields}
    for name, child in children.items():
        yield from _nested(f"{path}.{name}", child)


def describe(error: BaseException, config: MethodConfig | None) -> str:
    """An exception in one line: its message, with type and line in the user's code unless it is a reported one.

    The user's code is that of the components in the config, which is None where it could not be read.
    """
    message = "; ".join(str(error).split("\n"))
    if isinstance(error, ReportedError):
        return message
    location = _location(error, config)
    return f"{type(error).__name__}: {message}{f' ({location})' if location else ''}"


def _location(error: BaseException, config: MethodConfig | None) -> str:
    """``file:line`` of the innermost frame in the method's own components, or else in code that is no library's."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if not _within(frame.filename, [_CHECKS])]
    own = [] if config is None else [root for node in components(config).values() for root in _roots(node.target)]
    theirs = [root for root in own if not _within(root, [_PACKAGE])]
    for chosen in (
        [frame for frame in frames if _within(frame.filename, theirs)],
        [frame for frame in frames if not _within(frame.filename, [_PACKAGE, *_LIBRARIES])],
        [frame for frame in frames if _within(frame.filename, [_PACKAGE])],
    ):
        if chosen:
            return f"{_short(chosen[-1].filename)}:{chosen[-1].lineno}"
    return ""


def _roots(target: Any) -> Iterator[Path]:
    """The package that a component's class is from, and the files of its methods."""
    top = sys.modules.get(str(getattr(target, "__module__", "")).partition(".")[0])
    if top is not None and hasattr(top, "__path__"):
        yield from map(Path, top.__path__)
    for value in vars(target).values() if isinstance(target, type) else ():
        function = unwrap(value.__func__) if isinstance(value, (classmethod, staticmethod)) else value
        code = getattr(unwrap(function) if callable(function) else function, "__code__", None)
        if isinstance(code, CodeType):
            yield Path(code.co_filename)


def _short(path: str) -> Path:
    """Relative to the working directory where it lies within."""
    return Path(path).relative_to(Path.cwd()) if _within(path, [Path.cwd()]) else Path(path)


def _within(path: str | Path, roots: Any) -> bool:
    return any(Path(path) == root or root in Path(path).parents for root in roots)
