"""Settings as values by key path, and as the ``key.path=value`` texts of the command line."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

from coliags_plugin.config.yaml_tree import Node, dump_inline, override_all, parse_value
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.settings import Settings, invalid_reported


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
    return tuple(f"{key}={dump_inline(_plain(value, key))}" for key, value in settings.items())


def _plain(value: object, key: str) -> object:
    """The value as YAML has it."""
    if hasattr(value, "item") and getattr(value, "ndim", None) == 0:
        value = value.item()  # a number of NumPy
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Mapping):
        return {str(name): _plain(child, f"{key}.{name}") for name, child in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(child, key) for child in value]
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
