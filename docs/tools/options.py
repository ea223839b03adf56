"""The page *Options* of the site: every option of every component, from the settings classes themselves.

Names, types, ranges and defaults are pydantic's; what an option means is its ``description``, the string below it, the
comment behind it or the one above it, whichever the source has. ``make docs`` builds the page;
``python docs/tools/options.py`` prints it.
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
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import PlainValidator
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from coliags_plugin.config.method_config import MethodConfig, OptimizerSettings, ScheduleSettings
from coliags_plugin.core.registry import REGISTRIES, Registry
from coliags_plugin.core.settings import Settings
from coliags_plugin.phantom.settings import PhantomSettings
from coliags_plugin.pipeline.settings import FrameSettings, ReconstructionSettings
from coliags_plugin.reconstruction.depth.sweeping import DepthEstimationSettings
from coliags_plugin.reconstruction.structure.sfm_settings import (
    CameraSettings,
    FeatureSettings,
    SfmSettings,
    TrackSettings,
)
from coliags_plugin.surface.coverage.visibility import CoverageSettings
from coliags_plugin.surface.meshing.views import MeshSettings

HEAD = """\
# Options

Every option there is, generated from the settings classes. How a method config is written and changed is in
[configs.md](configs.md), where constants come from in [methods.md](methods.md).

A component is `{name: ..., options...}`. Lengths are in scene units: mm, where the data are metric.
"""

#: Where a method config names a component of each kind.
PLACES = {
    "datamanagers": "under `datamanager`",
    "fields": "under `field`",
    "geometry_heads": "under `field.geometry_head`",
    "appearance_heads": "under `field.appearance_head`",
    "renderers": "under `renderer`",
    "modules": "under `modules`, by names of your choice",
    "samplers": "under `sampler`",
    "strategies": "under `strategy`",
    "losses": "under `losses`, by names of your choice",
    "metrics": "named by protocols, not by method configs",
    "protocols": "named under `protocol`; they have no options",
}

#: Settings of commands, under the prefix that ``--set`` of the command needs.
COMMANDS: dict[str, type[Settings]] = {
    "phantom": PhantomSettings,
    "reconstruct": ReconstructionSettings,
    "reconstruct, under `frames.`": FrameSettings,
    "poses sfm": SfmSettings,
    "poses sfm, under `camera.`": CameraSettings,
    "poses sfm, under `tracks.`": TrackSettings,
    "poses sfm and depth, under `features.`": FeatureSettings,
    "depth": DepthEstimationSettings,
    "mesh": MeshSettings,
    "coverage": CoverageSettings,
}


def page() -> str:
    """The whole page."""
    parts = [HEAD, *_config_keys()]
    for kind, registry in REGISTRIES.items():
        parts += _of_kind(kind, registry)
    parts.append("## Commands\n\nSettings of `--set NAME=VALUE` of commands that read no method config.\n")
    for name, settings in COMMANDS.items():
        parts += [f"### {name}\n", f"{whole_text(settings)}\n", table(settings)]
    return "\n".join(parts).rstrip() + "\n"


def _config_keys() -> Iterator[str]:
    yield "## Method config\n"
    yield "Beside these, `base` names the config to inherit from.\n"
    yield table(MethodConfig)
    yield "### optimizers\n"
    yield f"{whole_text(OptimizerSettings)}\n"
    yield table(OptimizerSettings)
    yield "### schedule\n"
    yield f"{whole_text(ScheduleSettings)}\n"
    yield table(ScheduleSettings)


def _of_kind(kind: str, registry: Registry) -> Iterator[str]:
    yield f"## {kind}\n"
    yield f"Components of kind `{kind}`, {PLACES.get(kind, 'named by method configs')}.\n"
    builtin = {name: registry.get(name) for name in registry if registry.source(name) == "built in"}
    chains = {name: declaring_classes(getattr(found, "Settings", None)) for name, found in builtin.items()}
    used = [settings for chain in chains.values() for settings in chain]
    shared = sorted({settings for settings in used if used.count(settings) > 1}, key=used.index)
    for settings in shared:
        yield f"### {kind}: shared, {settings.__name__}\n"
        yield f"{whole_text(settings)}\n"
        yield table(settings, own_only=True)
    for name, found in builtin.items():
        yield f"### {kind}: {name}\n"
        yield f"{summary(found)}\n"
        inherited = [f"those of `{settings.__name__}`" for settings in chains[name] if settings in shared]
        own = [settings for settings in chains[name] if settings not in shared]
        if inherited:
            text = f"{'Also ' if own else 'Options: '}{' and '.join(inherited)}."
            yield f"{text}\n"
        for settings in own:
            yield table(settings, own_only=True)


def declaring_classes(settings: type[Settings] | None) -> list[type[Settings]]:
    """The classes that declare a component's options, base class first."""
    chain = [] if settings is None else [found for found in settings.__mro__ if issubclass(found, Settings)]
    return [found for found in reversed(chain) if own_names(found)]


def own_names(settings: type[Settings]) -> list[str]:
    """Options that a class declares itself, in its order."""
    return [name for name in settings.model_fields if name in inspect.get_annotations(settings)]


def summary(found: type) -> str:
    """The first paragraph of a class's docstring as Markdown on one line."""
    first = (inspect.getdoc(found) or "").split("\n\n")[0]
    return as_markdown(" ".join(first.split()))


def whole_text(found: type) -> str:
    """A class's docstring as Markdown."""
    return as_markdown(inspect.getdoc(found) or "")


def as_markdown(text: str) -> str:
    """Sphinx's roles as code, and pages of the documentation as links."""
    text = re.sub(r":\w+:`~?([^`]+)`", r"`\1`", text.replace("``", "`"))
    return re.sub(r"`?docs/((?:layouts/|rivals/)?[\w-]+\.md)`?", r"[\1](\1)", text)


def table(settings: type[Settings], own_only: bool = False) -> str:
    """Options of a class as a Markdown table."""
    rows = ["| option | type | default | what |", "|---|---|---|---|"]
    told = meanings(settings)
    for name, field in settings.model_fields.items():
        if own_only and name not in own_names(settings):
            continue
        cells = (f"`{name}`", type_text(field), default_text(field), told.get(name, ""))
        rows.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(rows) + "\n"


# Defaults and types


def default_text(field: FieldInfo) -> str:
    """The default as YAML writes it; nothing where a value must be given."""
    if field.is_required():
        return "required"
    value = field.default if field.default_factory is None else {}  # of entries, the only ones with a factory
    if isinstance(value, Settings):
        return "as below"
    if isinstance(value, str):
        return f"`{value}`" if value else "empty"
    if isinstance(value, float) and len(json.dumps(value)) > 8:
        return f"`{value:.4g}`"
    return f"`{json.dumps(value)}`"


NAMES = {int: "integer", float: "number", bool: "`true`, `false`", str: "text", type(None): "`null`", Path: "path"}


def type_text(field: FieldInfo) -> str:
    """Type and range of an option, in words."""
    return _with_range(_type(field.annotation, field.metadata), field.metadata)


def _type(annotation: Any, metadata: Any = ()) -> str:  # noqa: PLR0911 (one for each kind of annotation)
    kind = next((_kind_of(item) for item in metadata if isinstance(item, PlainValidator)), None)
    if kind is not None:
        return f"component of `{kind}`"
    origin, args = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _with_range(_type(args[0], args[1:]), args[1:])
    if origin is Literal:
        return ", ".join(f"`{value}`" for value in args)
    if origin in (Union, types.UnionType):
        return " or ".join(_type(part) for part in args)
    if origin is tuple and args[-1:] == (Ellipsis,):
        return f"list of {_type(args[0])}"
    if origin is tuple:
        same = len(set(args)) == 1
        return f"[{', '.join(_type(part) for part in args)}]" if not same else f"{len(args)} times {_type(args[0])}"
    if origin is dict or (origin is not None and issubclass(origin, Mapping)):
        return f"entries, each {_type(args[1])}"
    if inspect.isclass(annotation) and issubclass(annotation, Settings):
        return "options below"
    return NAMES.get(annotation, getattr(annotation, "__name__", str(annotation)))


def _with_range(text: str, metadata: Any) -> str:
    signs = {"ge": ">=", "gt": ">", "le": "<=", "lt": "<"}
    limits = []
    for item in metadata:
        item_limits = getattr(item, "metadata", [item])  # a Field inside Annotated holds its limits in a list
        for limit in item_limits:
            limits += [f"{sign} {getattr(limit, side):g}" for side, sign in signs.items() if hasattr(limit, side)]
            if hasattr(limit, "min_length"):
                limits.append(f"at least {limit.min_length}")
    return ", ".join([text, *limits])


def _kind_of(validator: PlainValidator) -> str | None:
    """Kind of component that a validator of ``core.components`` makes; None for other validators."""
    args = getattr(validator.func, "args", ())
    return args[0] if args and args[0] in REGISTRIES else None


# Meanings, from the source


def meanings(settings: type[Settings]) -> dict[str, str]:
    """What each option means, as far as description or source say so, inherited ones included."""
    found: dict[str, str] = {}
    for owner in reversed(settings.__mro__):
        if issubclass(owner, Settings) and inspect.get_annotations(owner):
            found |= written_meanings(owner)
    described = {name: field.description for name, field in settings.model_fields.items()}
    found |= {name: text for name, text in described.items() if text and text is not PydanticUndefined}
    return {name: as_markdown(text if text.endswith(".") else f"{text}.") for name, text in found.items()}


@cache
def written_meanings(settings: type[Settings]) -> dict[str, str]:
    """Strings and comments at the options in a class's own source."""
    source = textwrap.dedent(inspect.getsource(settings))
    lines = source.splitlines()
    comments = {
        token.start[0]: (token.start[1], token.string.lstrip("#: ").strip())
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type == tokenize.COMMENT and not re.match(r"#\s*(noqa|type:|ruff:)", token.string)
    }
    body = ast.parse(source).body[0].body  # type: ignore[attr-defined]
    found = {}
    for node, after in zip(body, [*body[1:], None], strict=True):
        if not isinstance(node, ast.AnnAssign) or not isinstance(node.target, ast.Name):
            continue
        text = _string(after) or " ".join(
            comments[line][1] for line in range(node.lineno, (node.end_lineno or node.lineno) + 1) if line in comments
        )
        if not text:  # comments on lines of their own, right above
            above = []
            line = node.lineno - 1
            while line in comments and not lines[line - 1][: comments[line][0]].strip():
                above.append(comments[line][1])
                line -= 1
            text = " ".join(reversed(above))
        if text:
            found[node.target.id] = text[0].upper() + text[1:]
    return found


def _string(node: ast.stmt | None) -> str:
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
        return " ".join(node.value.value.split())
    return ""


if __name__ == "__main__":
    print(page(), end="")
