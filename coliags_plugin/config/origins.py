"""Validation errors of YAML files, each with the line of the value that it rejects."""

from __future__ import annotations

from pydantic import ValidationError

from coliags_plugin.config.yaml_tree import Node

#: Errors of this package, with messages of their own.
_TELLING = frozenset({"no_name", "unknown_key", "unknown_component", "no_settings", "value_error", "zero_end"})


def errors_with_origins(error: ValidationError, tree: Node, what: str = "config") -> list[str]:
    """One line per problem: where the value was written, its key, and what is wrong with it.

    Args:
        error: What validation raised.
        tree: What was validated.
        what: Name of the whole, for problems without a key.
    """
    lines = []
    for item in error.errors():
        path = [key for key in item["loc"] if isinstance(key, str)]
        message = item["msg"].removeprefix("Value error, ")
        if item["type"] == "missing":
            message = "is missing"
        elif item["type"] not in _TELLING:
            message = f"{message}, got {item['input']!r}"
        lines.append(f"{tree.find(path).origin}: {'.'.join(path) or what}: {message.strip()}")
    return lines
