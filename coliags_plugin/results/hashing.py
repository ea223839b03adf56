"""Hashes: of what a result was computed from, of its values, and of everything that determines a run or result."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from pydantic_core import to_json

from coliags_plugin.results.record import SetRecord

#: Keys of a method config that do not change a trained model; the protocol has a place of its own in a result's key.
_IGNORED = ("description", "protocol")
#: Keys within its data manager, of what it allows to be read, and within its schedule, likewise.
_IGNORED_WITHIN = {"datamanager": ("outside_files",), "schedule": ("log_every", "checkpoint_every")}
#: Code that determines training and evaluation: all packages that the engine imports but presentation.
_CODE = (
    *("core", "config", "contracts", "geometry", "datamanagers", "fields", "renderers", "modules"),
    *("strategies", "losses", "metrics", "engine"),
)


class ArraysHash:
    """SHA-256 of named arrays, in the order they are added.

    Each array enters as a line of JSON, ``[frame, part, dtype, shape]``, followed by its numbers in rows,
    little-endian: floats as float32 with one bit pattern for NaN, masks as one byte a pixel.
    """

    def __init__(self) -> None:
        self._sha = hashlib.sha256()

    def add(self, frame: str, part: str, values: np.ndarray) -> None:
        """Add an array of floats or of bool, for instance the part ``rgb`` of a frame."""
        if values.dtype != np.bool_:
            values = np.where(np.isnan(values), np.float32(np.nan), values).astype("<f4")
        header = json.dumps([frame, part, values.dtype.str, list(values.shape)])
        self._sha.update(f"{header}\n".encode())
        self._sha.update(values.tobytes())

    def hexdigest(self) -> str:
        """The hash of everything added, 64 hexadecimal digits."""
        return self._sha.hexdigest()


def metrics_sha256(sets: Mapping[str, SetRecord]) -> str:
    """SHA-256 of the raw values of all test sets, 64 hexadecimal digits.

    Hashed is JSON without spaces, ``{set: {"frames": [...], "values": {metric: [...]}}}`` with sorted keys; floats
    as the shortest digits that float64 reads back, missing values as null.
    """
    plain = {name: {"frames": part.frames, "values": part.values} for name, part in sets.items()}
    text = json.dumps(plain, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def plain_config(config: Mapping[str, Any]) -> dict[str, Any]:
    """A method config as data of standard JSON: tuples become lists, infinity the string ``Infinity``."""
    plain: dict[str, Any] = json.loads(to_json(config, inf_nan_mode="strings"))
    return plain


def training_config(config: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of a resolved method config that determine the trained model, as data of standard JSON."""
    relevant = {name: value for name, value in plain_config(config).items() if name not in _IGNORED}
    for section, ignored in _IGNORED_WITHIN.items():
        if isinstance(relevant.get(section), Mapping):
            relevant[section] = {name: value for name, value in relevant[section].items() if name not in ignored}
    return relevant


def code_files() -> dict[str, Path]:
    """Source files that determine training and evaluation, by their places within the package, sorted."""
    package = Path(__file__).parents[1]
    files = [file for name in _CODE for file in (package / name).rglob("*.py")]
    return dict(sorted((file.relative_to(package).as_posix(), file) for file in files))


@cache
def code_key() -> str:
    """Key of the package's code that determines training and evaluation, 16 hexadecimal digits.

    It changes with any letter of these files. Components from elsewhere and libraries are not in it.
    """
    return _digest([[name, file.read_text(encoding="utf-8")] for name, file in code_files().items()])


def training_key(config: Mapping[str, Any], fingerprint: str, seed: int, code: str) -> str:
    """Key of a trained model by its resolved config, 16 hexadecimal digits; without how often is logged and saved."""
    return _digest([training_config(config), fingerprint, seed, code])


def result_key(
    config: Mapping[str, Any],
    fingerprint: str,
    seed: int,
    code: str,
    protocol: str,
    protocol_version: int,
    deviations: Mapping[str, Any] | None = None,
) -> str:
    """Key of a result, 16 hexadecimal digits.

    ``code`` is that of :func:`code_key`. Deviations are how the run differs from one that goes through as configured:
    taken to another step, with another schedule on the way, or trained by other code.
    """
    parts: list[Any] = [training_key(config, fingerprint, seed, code), protocol, protocol_version]
    if deviations:
        parts.append(plain_config(deviations))
    return _digest(parts)


def _digest(parts: list[Any]) -> str:
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]
