"""Settings from ``key.path=value`` assignments upon their defaults."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

from pydantic import ValidationError

from coliags_plugin.config.yaml_tree import Node, override_all
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.settings import Settings, first_error

S = TypeVar("S", bound=Settings)


def settings_of(kind: type[S], assignments: Sequence[str], prefix: str = "") -> S:
    """Settings from their defaults and ``--set`` assignments.

    Args:
        kind: The class.
        assignments: ``key.path=value``.
        prefix: Prefix of the keys in messages.

    Raises:
        InputError: An assignment is malformed, or a key or value is invalid; the message names it.
    """
    tree = override_all(Node({}, "options"), assignments)
    try:
        # Merged with the defaults, as a nested part's defaults may differ from its class's.
        return kind.model_validate(deep_merge(kind().model_dump(), tree.plain()))
    except ValidationError as error:
        key, message, value = first_error(error)
        raise InputError(f"--set {prefix}{key}: {message} (got {value!r})") from error


def deep_merge(base: Any, over: Any) -> Any:
    """``over`` merged into ``base``, mapping by mapping; other values are replaced."""
    if not isinstance(base, dict) or not isinstance(over, dict):
        return over
    return {**base, **{key: deep_merge(base.get(key), value) for key, value in over.items()}}
