"""Keys of runs and results: hashes of everything that determines them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

#: Keys of a method config that do not change a trained model; the protocol has a place of its own in a result's key.
_IGNORED = ("description", "protocol")
#: Likewise of its schedule.
_IGNORED_OF_SCHEDULE = ("log_every", "checkpoint_every")


def training_key(config: Mapping[str, Any], fingerprint: str, seed: int, package_version: str) -> str:
    """Key of a trained model, 16 hexadecimal digits.

    Args:
        config: The resolved method config as plain data.
        fingerprint: Of the scene's files.
        seed: Of the run.
        package_version: Of this package.
    """
    relevant = {name: value for name, value in config.items() if name not in _IGNORED}
    schedule = relevant.get("schedule", {})
    relevant["schedule"] = {name: value for name, value in schedule.items() if name not in _IGNORED_OF_SCHEDULE}
    return _digest([relevant, fingerprint, seed, package_version])


def result_key(
    config: Mapping[str, Any], fingerprint: str, seed: int, package_version: str, protocol: str, protocol_version: int
) -> str:
    """Key of a result, 16 hexadecimal digits.

    Args:
        config: See :func:`training_key`.
        fingerprint: See :func:`training_key`.
        seed: See :func:`training_key`.
        package_version: See :func:`training_key`.
        protocol: Name of the evaluation protocol.
        protocol_version: Its version.
    """
    return _digest([training_key(config, fingerprint, seed, package_version), protocol, protocol_version])


def _digest(parts: list[Any]) -> str:
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]
