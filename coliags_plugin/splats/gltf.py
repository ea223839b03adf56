"""GLB files of Gaussians: glTF 2.0 with the extension ``KHR_gaussian_splatting`` (ratified in January 2026)."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from coliags_plugin.core.files import atomic_write
from coliags_plugin.splats.cloud import SplatCloud

EXTENSION = "KHR_gaussian_splatting"
_MAGIC, _VERSION, _JSON_CHUNK, _BINARY_CHUNK = 0x46546C67, 2, 0x4E4F534A, 0x004E4942
_FLOAT, _ARRAY_BUFFER, _POINTS = 5126, 34962, 0
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
#: Half a turn about x (x, y, z, w), from camera-like axes (y down, z forward) to glTF's (y up).
UPRIGHT = (1.0, 0.0, 0.0, 0.0)


def write_splat_glb(path: Path, cloud: SplatCloud, comment: str = "") -> None:
    """Write Gaussians as one primitive of points, float32.

    Attributes keep the world frame and unit of the cloud. The node turns them by half a turn about x, so that y is up
    as glTF has it. Readers without the extension see plain points in the colours of ``COLOR_0``.

    Args:
        path: Where to.
        cloud: With three scales each.
        comment: For ``asset.extras``.

    Raises:
        InputError: The folder cannot be written.
    """
    attributes = _attributes(cloud)
    views, chunks, offset = [], [], 0
    accessors: list[dict[str, Any]] = []
    for name, values in attributes.items():
        data = np.ascontiguousarray(values, values.dtype.newbyteorder("<"))
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": data.nbytes, "target": _ARRAY_BUFFER})
        accessors.append(_accessor(name, data, len(accessors)))
        chunks.append(data.tobytes())
        offset += data.nbytes
    primitive = {
        "attributes": {name: index for index, name in enumerate(attributes)},
        "mode": _POINTS,
        "extensions": {EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "coliags_plugin", "extras": {"comment": comment}},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "rotation": UPRIGHT}],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": offset}],
        "bufferViews": views,
        "accessors": accessors,
    }
    text = _padded(json.dumps(document, allow_nan=False).encode(), b" ")
    body = _padded(b"".join(chunks), b"\0")
    header = struct.pack("<III", _MAGIC, _VERSION, 12 + 8 + len(text) + 8 + len(body))
    parts = [header, struct.pack("<II", len(text), _JSON_CHUNK), text, struct.pack("<II", len(body), _BINARY_CHUNK)]
    atomic_write(path, b"".join([*parts, body]))


def _attributes(cloud: SplatCloud) -> dict[str, np.ndarray]:
    """Attributes by their names. [N, C] each"""
    opaque = np.clip(cloud.opacities, 0.0, 1.0)[:, None]
    named = {
        "POSITION": cloud.means,
        "COLOR_0": np.concatenate([cloud.colors, opaque], axis=1),
        f"{EXTENSION}:ROTATION": np.roll(cloud.unit_quats_wxyz, -1, axis=1),
        f"{EXTENSION}:SCALE": cloud.scales,
        f"{EXTENSION}:OPACITY": opaque,
    }
    for degree in range(cloud.degree + 1):
        for order in range(2 * degree + 1):
            coefficients = cloud.harmonics[:, degree * degree + order]
            named[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{order}"] = coefficients
    return {name: values.astype(np.float32) for name, values in named.items()}


def _accessor(name: str, data: np.ndarray, view: int) -> dict[str, Any]:
    accessor = {
        "bufferView": view,
        "componentType": _FLOAT,
        "count": len(data),
        "type": _TYPES[data.shape[1]],
    }
    if name == "POSITION":  # the one attribute whose bounds glTF requires
        accessor |= {"min": data.min(axis=0).tolist(), "max": data.max(axis=0).tolist()}
    return accessor


def _padded(data: bytes, filling: bytes) -> bytes:
    """Filled up to a multiple of four bytes."""
    return data + filling * (-len(data) % 4)
