"""YAML trees with the origin of every value, merged by inheritance; settings as ``key.path=value`` texts."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import yaml

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.settings import Settings, invalid_reported
from coliags_plugin.core.text_files import read_text


@dataclass(frozen=True)
class Node:
    """A value with its origin."""

    value: Any  # a mapping of nodes, or a plain scalar or tuple
    origin: str  # ``file:line``, or the command-line option that set it

    @property
    def is_mapping(self) -> bool:
        """True for a mapping of further nodes."""
        return isinstance(self.value, dict)

    def plain(self) -> Any:
        """The value without origins."""
        if self.is_mapping:
            return {key: child.plain() for key, child in self.value.items()}
        return self.value

    def find(self, path: Sequence[object]) -> Node:
        """The deepest node on a path that exists."""
        node = self
        for key in path:
            if not node.is_mapping or key not in node.value:
                break
            node = node.value[key]
        return node


class _Loader(yaml.SafeLoader):
    """Safe loader in which ``1e-5`` is a number and ``on`` is a word, as YAML 1.2 has it."""


_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag not in (_FLOAT, _BOOL)]
    for _FLOAT, _BOOL in [("tag:yaml.org,2002:float", "tag:yaml.org,2002:bool")]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
#: Tag, pattern and first characters of numbers as YAML 1.2 has them.
_NUMBERS = (
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?$|^[-+]?\.(inf|Inf|INF)$|^\.(nan|NaN|NAN)$"),
    list("-+0123456789."),
)
_Loader.add_implicit_resolver(*_NUMBERS)
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:bool", re.compile(r"^(true|True|TRUE|false|False|FALSE)$"), list("tTfF")
)


class _Dumper(yaml.SafeDumper):
    """Safe dumper that quotes text which either version of YAML would take for something else."""

    def ignore_aliases(self, data: object) -> bool:
        """Write what is there twice twice."""
        return True


_Dumper.add_implicit_resolver(*_NUMBERS)


def read_tree(path: Path) -> Node:
    """Read a YAML file whose top level is a mapping, without repeated keys."""
    return parse_tree(read_text(path, "a YAML file"), path.name)


def parse_tree(text: str, source: str) -> Node:
    """Parse YAML text whose top level is a mapping; ``source`` names it in origins."""
    try:
        loader = _Loader(text)
        try:
            root = loader.get_single_node()
            tree = Node({}, source) if root is None else _convert(loader, root, source)
        finally:
            loader.dispose()
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 0
        raise InputError(f"{source}:{line}: {error.problem}", "valid YAML") from error
    except (yaml.YAMLError, ValueError) as error:
        raise InputError(f"{source}: {error}", "valid YAML") from error
    except RecursionError as error:
        raise InputError(f"{source} is nested too deeply", "a few levels") from error
    if not tree.is_mapping:
        raise InputError(f"{source} holds {type(tree.value).__name__}", "a mapping at the top level")
    return tree


def parse_value(text: str) -> object:
    """The value of an assignment ``key.path=value``, read as YAML."""
    try:
        return tuples(yaml.load(text, _Loader))
    except (yaml.YAMLError, ValueError, RecursionError):
        return text


def _convert(loader: _Loader, node: yaml.Node, source: str) -> Node:
    origin = f"{source}:{node.start_mark.line + 1}"
    if not isinstance(node, yaml.MappingNode):
        try:
            return Node(tuples(loader.construct_object(node, deep=True)), origin)
        except ValueError as error:  # of a date or number
            raise InputError(f"{origin}: {error}", "valid YAML") from error
    children: dict[str, Node] = {}
    for key_node, value_node in node.value:
        key = str(loader.construct_object(key_node))
        line = f"{source}:{key_node.start_mark.line + 1}"
        if key in children:
            raise InputError(f"{line}: key '{key}' is there twice, first at {children[key].origin}", "each key once")
        children[key] = Node(_convert(loader, value_node, source).value, line)
    return Node(children, origin)


def tuples(value: object) -> object:
    """Plain values with lists as the tuples that settings are made of."""
    if isinstance(value, list):
        return tuple(tuples(item) for item in value)
    if isinstance(value, dict):
        return {key: tuples(item) for key, item in value.items()}
    return value


def merge(base: Node, over: Node) -> Node:
    """Merge ``over`` into ``base``, key by key.

    A component whose ``name`` changes keeps nothing of the options inherited for the old name.
    """
    if isinstance(base.value, str) and over.is_mapping:
        base = Node({"name": base}, base.origin)  # a bare name is short for a component without options
    if not base.is_mapping or not over.is_mapping:
        return over
    names = [node.value["name"].value if "name" in node.value else None for node in (base, over)]
    if None not in names and names[0] != names[1]:
        return over
    merged = dict(base.value)
    for key, child in over.value.items():
        merged[key] = merge(merged[key], child) if key in merged else child
    return Node(merged, over.origin)


#: One key of a path, quoted or not.
_KEY = re.compile(r'"[^"]+"|[^".]+')


def parse_assignment(assignment: str) -> Node:
    """The tree of one ``key.path=value``; a key with a dot is put in double quotes."""
    path, equals, text = assignment.partition("=")
    keys = _KEY.findall(path.strip())
    if not equals or ".".join(keys) != path.strip():
        raise InputError(f"setting '{assignment}'", "key.path=value, for instance field.geometry_head.frequencies=8")
    origin = f"`{assignment}`"
    node = nodes(parse_value(text), origin)
    for key in reversed(keys):
        node = Node({key.strip('"'): node}, origin)
    return node


def nodes(value: object, origin: str) -> Node:
    """A plain value as a tree of nodes, all of one origin."""
    if not isinstance(value, dict):
        return Node(value, origin)
    return Node({str(key): nodes(child, origin) for key, child in value.items()}, origin)


def override_all(tree: Node, assignments: Iterable[str]) -> Node:
    """Apply ``key.path=value`` assignments, the last one last."""
    for assignment in assignments:
        tree = merge(tree, parse_assignment(assignment))
    return tree


def dump(plain: object) -> str:
    """YAML text of plain data, keys in their own order, the innermost collections on one line."""
    return _dumped(plain, flow=None, width=1000)


def dump_inline(plain: object) -> str:
    """YAML text of plain data as it stands behind ``key=``, which :func:`parse_value` reads."""
    return _dumped([plain], flow=True, width=math.inf).strip()[1:-1]  # a list, so that no end of document is written


def _dumped(plain: object, flow: bool | None, width: float) -> str:
    text: str = yaml.dump(
        plain, Dumper=_Dumper, sort_keys=False, allow_unicode=True, default_flow_style=flow, width=width
    )
    return text


@contextmanager
def at_origins(tree: Node, content: str = "config") -> Iterator[None]:
    """Report what a validation of a tree refuses, line by line, each with where the value was written."""

    def place(path: Sequence[object]) -> str:
        return f"{tree.find([key for key in path if isinstance(key, str)]).origin}: "

    with invalid_reported(place, content=content):
        yield


def parse_assignments(texts: Iterable[str]) -> dict[str, object]:
    """Values by key path, read as YAML; of a key that is there twice the last one counts, in its place."""
    values: dict[str, object] = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals:
            raise InputError(f"setting '{text}'", "KEY=VALUE")
        values.pop(key.strip(), None)
        values[key.strip()] = parse_value(value)
    return values


def assignments(settings: Mapping[str, object] | None) -> tuple[str, ...]:
    """``key.path=value`` texts, in the settings' order; what :func:`parse_assignments` reads as the same settings.

    A key with a dot in it is put in double quotes.
    """
    if settings is None:
        return ()
    if not isinstance(settings, Mapping) or not all(isinstance(key, str) for key in settings):
        raise InputError(f"settings {settings!r}", 'values by key path, for instance {"schedule.steps": 5000}')
    return tuple(f"{key}={dump_inline(plain_value(value, key))}" for key, value in settings.items())


def plain_value(value: object, key: str) -> object:
    """Value of a node as plain lists, mappings and scalars; the key is for errors."""
    if hasattr(value, "item") and getattr(value, "ndim", None) == 0:
        value = value.item()  # a number of NumPy
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Mapping):
        return {str(name): plain_value(child, f"{key}.{name}") for name, child in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain_value(child, key) for child in value]
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise InputError(
        f"setting {key} is a {type(value).__name__}: {value!r}", "a number, text, None, or a list or mapping of them"
    )


S = TypeVar("S", bound=Settings)


def settings_of(kind: type[S], assignments: Sequence[str], prefix: str = "") -> S:
    """Settings from their defaults and ``key.path=value`` assignments; messages put the prefix before keys."""
    tree = override_all(Node({}, "options"), assignments)
    with invalid_reported(f"setting {prefix}"):
        # Merged with the defaults, as a nested part's defaults may differ from its class's.
        return kind.model_validate(deep_merge(kind().model_dump(), tree.plain()))


def deep_merge(base: object, over: object) -> object:
    """``over`` merged into ``base``, mapping by mapping; other values are replaced."""
    if not isinstance(base, dict) or not isinstance(over, dict):
        return over
    return {**base, **{key: deep_merge(base.get(key), value) for key, value in over.items()}}
