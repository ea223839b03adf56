"""Reference of components: what each is, its options, and its default learning rates, from classes and their source.

Names, types, ranges and defaults of options are pydantic's. The meaning of one is its ``description``, the string below
it, the comment behind it or the one above it, whichever the source has.
"""

from __future__ import annotations

import ast
import inspect
import io
import json
import re
import textwrap
import tokenize
import types
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import PlainValidator
from pydantic.fields import FieldInfo
from pydantic_core import to_jsonable_python

from coliags_plugin.core.registry import REGISTRIES
from coliags_plugin.core.settings import Settings


@dataclass(frozen=True)
class OptionReference:
    """An option of a component or command; names in texts are in backticks."""

    name: str
    type: str  # with choices and range
    required: bool
    default: Any  # as JSON value; None where it is required
    meaning: str

    @property
    def default_text(self) -> str:
        """The default as YAML writes it."""
        if self.required:
            return "required"
        if isinstance(self.default, str):
            return self.default or "empty"
        if isinstance(self.default, dict) and self.default:  # of nested settings
            return "as below"
        exact = json.dumps(self.default)
        return f"{self.default:.4g}" if isinstance(self.default, float) and len(exact) > 8 else exact


def describe(kind: str, name: str) -> dict[str, Any]:
    """A registered component as JSON values: description, source, options and default learning rates by group."""
    found = REGISTRIES[kind].get(name)
    settings = getattr(found, "Settings", None)
    return {
        "kind": kind,
        "name": name,
        "source": REGISTRIES[kind].source(name),
        "description": " ".join(plain(inspect.getdoc(found) or "").split("\n\n")[0].split()),
        "options": options_of(settings) if settings else [],
        "parameter_groups": getattr(found, "rates", {}),
    }


def first_line(found: object) -> str:
    """First line of a docstring; empty without one."""
    return plain(inspect.getdoc(found) or "").partition("\n")[0]


def plain(text: str) -> str:
    """A docstring with names in single backticks, without Sphinx's roles."""
    return re.sub(r":\w+:`~?([^`]+)`", r"`\1`", text.replace("``", "`"))


def options_of(settings: type[Settings]) -> list[OptionReference]:
    """All options of a settings class, inherited ones first."""
    told = meanings(settings)
    return [
        OptionReference(name, type_text(field), field.is_required(), _default(field), told.get(name, ""))
        for name, field in settings.model_fields.items()
    ]


def _default(field: FieldInfo) -> Any:
    return None if field.is_required() else to_jsonable_python(field.get_default(call_default_factory=True))


_NAMES = {int: "integer", float: "number", bool: "true or false", str: "text", type(None): "null", Path: "path"}


def type_text(field: FieldInfo) -> str:
    """Type and range of an option, in words."""
    return _with_range(_type(field.annotation, field.metadata), field.metadata)


def _type(annotation: Any, metadata: Sequence[Any] = ()) -> str:  # noqa: PLR0911 (one for each kind of annotation)
    for item in metadata:
        kind = next(iter(getattr(item.func, "args", ())), None) if isinstance(item, PlainValidator) else None
        if kind in REGISTRIES:  # a node of core.components
            return f"component of {kind}"
    origin, args = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _with_range(_type(args[0], args[1:]), args[1:])
    if origin is Literal:
        return f"one of {', '.join(map(str, args))}"
    if origin in (Union, types.UnionType):
        return " or ".join(map(_type, args))
    if origin is tuple and args[-1:] == (Ellipsis,):
        return f"list of {_type(args[0])}"
    if origin is tuple:
        return f"{len(args)} times {_type(args[0])}" if len(set(args)) == 1 else f"[{', '.join(map(_type, args))}]"
    if inspect.isclass(origin) and issubclass(origin, Mapping):
        return f"entries, each {_type(args[1])}"
    if inspect.isclass(annotation) and issubclass(annotation, Settings):
        return "options below"
    return _NAMES.get(annotation, getattr(annotation, "__name__", str(annotation)))


def _with_range(text: str, metadata: Sequence[Any]) -> str:
    signs = {"ge": ">=", "gt": ">", "le": "<=", "lt": "<", "min_length": "at least"}
    # A Field inside Annotated holds its limits in a list.
    limits = [limit for item in metadata for limit in getattr(item, "metadata", [item])]
    found = [(sign, getattr(limit, side, None)) for limit in limits for side, sign in signs.items()]
    return ", ".join([text, *(f"{sign} {bound:g}" for sign, bound in found if bound is not None)])


def meanings(settings: type[Settings]) -> dict[str, str]:
    """Meaning of each option as a sentence, inherited ones included, as far as description or source say it."""
    found: dict[str, str] = {}
    for owner in reversed(settings.__mro__):
        if issubclass(owner, Settings):
            found |= _written_meanings(owner)
    found |= {name: field.description for name, field in settings.model_fields.items() if field.description}
    return {name: plain(text[0].upper() + text[1:].removesuffix(".") + ".") for name, text in found.items()}


@cache
def _written_meanings(settings: type[Settings]) -> dict[str, str]:
    """Strings and comments at the options in a class's own source; none without source, as in a console."""
    try:
        source = textwrap.dedent(inspect.getsource(settings))
    except (OSError, TypeError):
        return {}
    lines = source.splitlines()
    comments = {
        token.start[0]: token.string.lstrip("#: ").strip()
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type == tokenize.COMMENT and not re.match(r"#\s*(noqa|type:|ruff:)", token.string)
    }
    body = ast.parse(source).body[0].body  # type: ignore[attr-defined]
    found = {}
    for node, after in zip(body, [*body[1:], None], strict=True):
        if not isinstance(node, ast.AnnAssign) or not isinstance(node.target, ast.Name):
            continue
        below = getattr(getattr(after, "value", None), "value", None) if isinstance(after, ast.Expr) else None
        beside = [comments[line] for line in range(node.lineno, (node.end_lineno or 0) + 1) if line in comments]
        above = list[str]()
        while (line := node.lineno - 1 - len(above)) in comments and lines[line - 1].lstrip().startswith("#"):
            above.insert(0, comments[line])
        text = " ".join([below] if isinstance(below, str) else beside or above)
        if text:
            found[node.target.id] = " ".join(text.split())
    return found
