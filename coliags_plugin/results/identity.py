"""Key of a result: a hash of everything that determines it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from pydantic_core import to_json

#: Keys of a method config that do not change a result; the protocol counts as what it was evaluated under.
_IGNORED = ("description", "protocol")


def plain_config(config: Mapping[str, Any]) -> dict[str, Any]:
    """A method config as data of standard JSON: tuples become lists, infinity the string ``Infinity``."""
    plain: dict[str, Any] = json.loads(to_json(config, inf_nan_mode="strings"))
    return plain


def result_key(
    config: Mapping[str, Any],
    fingerprint: str,
    seed: int,
    package_version: str,
    protocol: str,
    protocol_version: int,
    deviations: Mapping[str, Any] | None = None,
) -> str:
    """Key of a result, 16 hexadecimal digits.

    Args:
        config: The resolved method config as plain data.
        fingerprint: Of the scene's files.
        seed: Of the run.
        package_version: Of this package.
        protocol: Name of the evaluation protocol.
        protocol_version: Its version.
        deviations: How the run differs from one that goes through as configured: taken to another step, or with
            another schedule on the way. None where it does not.
    """
    relevant = {name: value for name, value in plain_config(config).items() if name not in _IGNORED}
    parts: list[Any] = [relevant, fingerprint, seed, package_version, protocol, protocol_version]
    if deviations:
        parts.append(plain_config(deviations))
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]
