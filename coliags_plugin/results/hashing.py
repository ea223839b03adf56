"""Hashes of what a result was computed from, and of its values."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping

import numpy as np

from coliags_plugin.results.record import SetRecord


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
