"""Key of a result: a hash of everything that determines it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

#: Keys of a method config that do not change a result.
_IGNORED = ("description",)


def result_key(
    config: Mapping[str, Any], fingerprint: str, seed: int, package_version: str, protocol: str, protocol_version: int
) -> str:
    """Key of a result, 16 hexadecimal digits.

    Args:
        config: The resolved method config as plain data.
        fingerprint: Of the scene's files.
        seed: Of the run.
        package_version: Of this package.
        protocol: Name of the evaluation protocol.
        protocol_version: Its version.
    """
    relevant = {name: value for name, value in config.items() if name not in _IGNORED}
    parts = [relevant, fingerprint, seed, package_version, protocol, protocol_version]
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]
