"""Encoding of GLB files: glTF 2.0 with its arrays in one binary file."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Shaped

from coliags_plugin.core.json_files import JsonObject

_MAGIC, _VERSION, _JSON_CHUNK, _BINARY_CHUNK = 0x46546C67, 2, 0x4E4F534A, 0x004E4942
#: glTF's numbers of types, and names of shapes by their channels.
_COMPONENTS = {"|u1": 5121, "<u4": 5125, "<f4": 5126}
_SHAPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
#: What a part of the buffer is for.
_VERTICES, _INDICES = 34962, 34963


@dataclass(frozen=True, eq=False)
class GlbArray:
    """An array of a GLB file, which becomes an accessor.

    Attributes:
        values: uint8, uint32 or float32. [N, C]
        indices: Whether these are indices of vertices, instead of attributes of them.
        normalized: Whether integers stand for numbers from 0 to 1.
        bounds: Whether to state the smallest and largest values, as glTF requires of positions.
    """

    values: Shaped[np.ndarray, "N C"]
    indices: bool = False
    normalized: bool = False
    bounds: bool = False

    def accessor(self, view: int) -> JsonObject:
        """Its description."""
        stored = self.values.dtype.newbyteorder("<")
        made: JsonObject = {
            "bufferView": view,
            "componentType": _COMPONENTS[stored.str],
            "count": len(self.values),
            "type": _SHAPES[self.values.shape[1]],
        }
        if self.normalized:
            made["normalized"] = True
        if self.bounds:
            made |= {"min": self.values.min(axis=0).tolist(), "max": self.values.max(axis=0).tolist()}
        return made


def encode_glb(
    document: Mapping[str, Any], arrays: Sequence[GlbArray], extras: str = "", png: bytes | None = None
) -> bytes:
    """The bytes of a GLB file of a glTF document without asset, buffers, views and accessors; accessor i is array i.

    Rows of arrays have a multiple of four bytes; ``extras`` is a comment, ``png`` a file that becomes image 0.
    """
    views, chunks, offset = [], [], 0
    for array in arrays:
        data = np.ascontiguousarray(array.values, array.values.dtype.newbyteorder("<")).tobytes()
        target = _INDICES if array.indices else _VERTICES
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": len(data), "target": target})
        chunks.append(data)
        offset += len(data)
    if png is not None:
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": len(png)})
        chunks.append(_padded(png, b"\0"))
        offset += len(chunks[-1])
        document = {**document, "images": [{"bufferView": len(arrays), "mimeType": "image/png"}]}
    asset: JsonObject = {"version": "2.0", "generator": "coliags_plugin"}
    if extras:
        asset["extras"] = {"comment": extras}
    whole = {
        "asset": asset,
        **document,
        "buffers": [{"byteLength": offset}],
        "bufferViews": views,
        "accessors": [array.accessor(view) for view, array in enumerate(arrays)],
    }
    text = _padded(json.dumps(whole, allow_nan=False).encode(), b" ")
    body = _padded(b"".join(chunks), b"\0")
    header = struct.pack("<III", _MAGIC, _VERSION, 12 + 8 + len(text) + 8 + len(body))
    parts = [header, struct.pack("<II", len(text), _JSON_CHUNK), text, struct.pack("<II", len(body), _BINARY_CHUNK)]
    return b"".join([*parts, body])


def _padded(data: bytes, filling: bytes) -> bytes:
    """Filled up to a multiple of four bytes."""
    return data + filling * (-len(data) % 4)
