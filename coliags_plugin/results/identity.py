"""Keys of runs and results: hashes of everything that determines them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from pydantic_core import to_json

#: Keys of a method config that do not change a trained model; the protocol has a place of its own in a result's key.
_IGNORED = ("description", "protocol")
#: Likewise of its data manager: what it allows to be read.
_IGNORED_OF_DATA = ("outside_files",)
#: Likewise of its schedule.
_IGNORED_OF_SCHEDULE = ("log_every", "checkpoint_every")


def plain_config(config: Mapping[str, Any]) -> dict[str, Any]:
    """A method config as data of standard JSON: tuples become lists, infinity the string ``Infinity``."""
    plain: dict[str, Any] = json.loads(to_json(config, inf_nan_mode="strings"))
    return plain


def training_config(config: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of a resolved method config that determine the trained model, as data of standard JSON."""
    relevant = {name: value for name, value in plain_config(config).items() if name not in _IGNORED}
    data = relevant.get("datamanager")
    if isinstance(data, Mapping):
        relevant["datamanager"] = {name: value for name, value in data.items() if name not in _IGNORED_OF_DATA}
    schedule = relevant.get("schedule")
    if isinstance(schedule, Mapping):
        relevant["schedule"] = {name: value for name, value in schedule.items() if name not in _IGNORED_OF_SCHEDULE}
    return relevant


def training_key(config: Mapping[str, Any], fingerprint: str, seed: int, package_version: str) -> str:
    """Key of a trained model, 16 hexadecimal digits; how often is logged and saved does not count."""
    return _digest([training_config(config), fingerprint, seed, package_version])


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

    Deviations are how the run differs from one that goes through as configured: taken to another step, with another
    schedule on the way, or trained by another version.
    """
    parts: list[Any] = [training_key(config, fingerprint, seed, package_version), protocol, protocol_version]
    if deviations:
        parts.append(plain_config(deviations))
    return _digest(parts)


def _digest(parts: list[Any]) -> str:
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]
