"""The page *Methods at a glance* of the site: what every method optimises, and the source of each constant.

Everything is read from the method configs: values from the resolved config, the source of a constant from the comment
on its line or, without one, on the line of the key that it belongs to. ``make docs`` builds the page;
``python docs/tools/methods.py`` prints it.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import Any

import yaml

from coliags_plugin.config.method_config import MethodConfig, load_method, method_files
from coliags_plugin.config.yaml_tree import Node, read_tree

HEAD = """\
# Methods at a glance

Generated from `method_configs/`. Formulas and differences from released
code are in [methods.md](methods.md) and in the pages on rivals; the meaning of options is in [options.md](options.md).
Ablations (`method_configs/ablations/`) change one part of `coliags` each and are not listed.

Step numbers and intervals (`every`, `reset_every`) are written for the run length in the column `steps` and keep their
share of a run of another length ([configs.md](configs.md)).
"""

#: Parts of a method config that hold constants, in the order of the tables.
PARTS = (
    "datamanager",
    "field",
    "renderer",
    "near_plane",
    "modules",
    "sampler",
    "strategy",
    "losses",
    "optimizers",
    "schedule",
)
#: Values that are no constants of a method.
TECHNICAL = frozenset({"name", "log_every", "checkpoint_every"})


def page() -> str:
    """The whole page."""
    names = sorted(name for name in method_files() if "/" not in name)
    configs = {name: load_method(name).config for name in names}
    parts = [HEAD, "## Summary\n", summary(configs), "## Constants\n"]
    for name in names:
        parts += of_method(name)
    return "\n".join(parts).rstrip() + "\n"


def summary(configs: Mapping[str, MethodConfig]) -> str:
    """One row for each method."""
    rows = ["| method | optimises | losses (weight, first step) | strategy | steps |", "|---|---|---|---|---|"]
    for name, config in configs.items():
        groups = ", ".join(f"`{group}`" for group in config.optimizers)
        losses = "; ".join(_loss(key, node.name, node.settings) for key, node in config.losses.items())
        made = f"{config.field.target.primitive} of field `{config.field.name}`: {groups}"
        rows.append(f"| `{name}` | {made} | {losses} | `{config.strategy.name}` | {config.schedule.written_for:,} |")
    return "\n".join(rows) + "\n"


def _loss(key: str, name: str, settings: Any) -> str:
    fades = f" to {settings.final_weight:g}" if settings.final_weight is not None else ""
    begins = f", after {settings.from_step:,}" if settings.from_step else ""
    ends = f", until {settings.until_step:,}" if settings.until_step else ""
    shown = f"`{name}`" if key == name else f"`{name}` ({key})"
    return f"{shown} {settings.weight:g}{fades}{begins}{ends}"


def of_method(name: str) -> Iterator[str]:
    """The constants that a method's own file sets."""
    tree = read_tree(method_files()[name])
    description = tree.value["description"].value
    base = tree.value.get("base")
    yield f"### {name}\n"
    yield f"{description}." + (f" Everything else is as in `{base.value}`." if base else "") + "\n"
    rows = []
    for (parent, source), group in groupby(constants(name), key=lambda row: (row[0][:-1], row[2])):
        values = ", ".join(f"`{path[-1]}` {_text(value)}" for path, value, _ in group)
        rows.append(f"| `{'.'.join(parent) or 'method'}` | {values} | {source} |")
    if rows:
        yield "\n".join(["| of | constants | source or meaning |", "|---|---|---|", *rows]) + "\n"


def constants(name: str) -> Iterator[tuple[tuple[str, ...], Any, str]]:
    """Path, value and source of every constant in a method's own file; the source is empty where none is written."""
    path = method_files()[name]
    tree, comments = read_tree(path), line_comments(path)
    for part in PARTS:
        if part in tree.value:
            yield from _leaves(tree.value[part], (part,), "", comments)


def _leaves(
    node: Node, path: tuple[str, ...], inherited: str, comments: Mapping[int, str]
) -> Iterator[tuple[tuple[str, ...], Any, str]]:
    source = comments.get(int(node.origin.rpartition(":")[2]), inherited)
    if node.is_mapping:
        for key, child in node.value.items():
            if key not in TECHNICAL:
                yield from _leaves(child, (*path, key), source, comments)
        return
    yield path, node.value, source


def _text(value: Any) -> str:
    text: str = yaml.safe_dump(list(value) if isinstance(value, tuple) else value, default_flow_style=True)
    return text.removesuffix("...\n").strip()


@cache
def line_comments(path: Path) -> dict[int, str]:
    """Comments of a YAML file by the number of the line they stand on; one on a line of its own is the next line's."""
    found: dict[int, str] = {}
    above: list[str] = []
    for number, line in enumerate(io.StringIO(path.read_text(encoding="utf-8")), start=1):
        code, mark, comment = line.partition("#")
        if mark and not code.strip():
            above.append(comment.strip())
            continue
        parts = [*above, comment.strip()] if mark else above
        if parts and code.strip():
            found[number] = " ".join(parts)
        above = []
    return found


if __name__ == "__main__":
    print(page(), end="")
