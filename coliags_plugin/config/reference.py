"""Reference of options: types, ranges and defaults from settings classes, meanings from their source."""

from __future__ import annotations

import inspect
import re
import types
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic.fields import FieldInfo
from pydantic_core import to_jsonable_python

from coliags_plugin.core.components import Component
from coliags_plugin.core.settings import Settings

_NAMES = {int: "integer", float: "number", bool: "true or false", str: "text", type(None): "null", Path: "path"}
_BOUNDS = {"ge": ">=", "gt": ">", "le": "<=", "lt": "<", "min_length": "at least"}
#: Comments on lines of their own, then an option, on one line or several, and the comment or string behind it.
_OPTION = re.compile(
    r"((?:^    #.*\n)*)^    (\w+): (?:.*[(\[]\n(?: {8}.*\n)*    [)\]].*?|.*?)"
    r'(?: +#(?! *(?:noqa|type:)) *(.*)|\n    """([^"]*)""")?$',
    re.MULTILINE,
)


def plain_doc(target: object, end: str = "\n\n") -> str:
    """First paragraph of a docstring, or other beginning, on one line, with names in single backticks."""
    text = inspect.cleandoc(vars(target).get("__doc__") or "").partition(end)[0]
    return re.sub(r":\w+:`~?([^`]+)`", r"`\1`", " ".join(text.replace("``", "`").split()))


def options_of(target: object) -> list[dict[str, Any]]:
    """Options of settings or of a component: name, type, default as a JSON value unless one is required, meaning."""
    settings = getattr(target, "Settings", target)
    if not (isinstance(settings, type) and issubclass(settings, Settings)):
        return []
    told = meanings(settings)
    return [
        {
            "name": name,
            "type": type_text(field.annotation, field.metadata),
            **_default(field),
            "meaning": told.get(name, ""),
        }
        for name, field in settings.model_fields.items()
    ]


def _default(field: FieldInfo) -> dict[str, Any]:
    default = field.get_default(call_default_factory=True)
    return {} if field.is_required() else {"default": to_jsonable_python(default)}


def type_text(annotation: Any, metadata: Sequence[Any] = ()) -> str:
    """Type and range of an option, in words."""
    if get_origin(annotation) is Annotated:
        annotation, *metadata = get_args(annotation)
    origin, args = get_origin(annotation), get_args(annotation)
    if annotation is Component:
        text = f"component of {metadata[0].func.args[0]}"
    elif origin is Literal:
        text = f"one of {', '.join(map(str, args))}"
    elif origin in (Union, types.UnionType):
        text = " or ".join(map(type_text, args))
    elif origin is tuple and len(set(args)) == 1:
        text = f"{len(args)} times {type_text(args[0])}"
    elif origin is tuple:
        text = f"list of {type_text(args[0])}" if ... in args else f"[{', '.join(map(type_text, args))}]"
    elif origin is not None and issubclass(origin, Mapping):
        text = f"entries, each {type_text(args[1])}"
    elif isinstance(annotation, type) and issubclass(annotation, Settings):
        text = "options below"
    else:
        text = _NAMES.get(annotation, getattr(annotation, "__name__", str(annotation)))
    # A Field inside Annotated holds its bounds in a list.
    limits = [limit for each in metadata for limit in getattr(each, "metadata", [each])]
    bounds = [(sign, getattr(limit, name, None)) for limit in limits for name, sign in _BOUNDS.items()]
    return ", ".join([text, *(f"{sign} {bound:g}" for sign, bound in bounds if bound is not None)])


@cache
def meanings(settings: type[Settings]) -> dict[str, str]:
    """Meaning of each option: its ``description``, or the comment or string at it in the source, where there is any."""
    found: dict[str, str] = {}
    for owner in reversed(settings.__mro__):
        try:
            source = inspect.getsource(owner) if issubclass(owner, Settings) else ""
        except (OSError, TypeError):
            continue  # defined in a console
        for above, name, behind, below in _OPTION.findall(source):
            found[name] = below or behind or re.sub(r"^    #:?", "", above, flags=re.MULTILINE) or found.get(name, "")
    found |= {name: field.description for name, field in settings.model_fields.items() if field.description}
    texts = {name: " ".join(found.get(name, "").replace("``", "`").split()) for name in settings.model_fields}
    return {name: f"{text[0].upper()}{text[1:].removesuffix('.')}." for name, text in texts.items() if text}
