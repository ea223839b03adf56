"""GLB files of Gaussians: glTF with the extension ``KHR_gaussian_splatting``, only written."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from coliags_plugin.core.files import atomic_write
from coliags_plugin.export.splats.cloud import SplatCloud
from coliags_plugin.geometry.meshes.mesh import linear_light

EXTENSION = "KHR_gaussian_splatting"
#: glTF's numbers of a primitive of points, of float32 and of a buffer of vertices, and its shapes by their channels.
_POINTS, _FLOAT32, _VERTICES = 0, 5126, 34962
_SHAPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def write(path: Path, cloud: SplatCloud, comment: str = "") -> None:
    """Write Gaussians as one primitive of points, float32, with the comment in ``asset.extras``.

    Attributes keep the world frame and unit of the cloud, and no node turns them, as in GLB files of meshes. Readers
    without the extension see plain points in the colours of ``COLOR_0``, linear light as in all of glTF.
    """
    attributes = _attributes(cloud)
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    size = 0
    for index, values in enumerate(attributes.values()):
        views.append({"buffer": 0, "byteOffset": size, "byteLength": values.nbytes, "target": _VERTICES})
        shape = {"count": len(values), "type": _SHAPES[values.shape[1]]}
        accessors.append({"bufferView": index, "componentType": _FLOAT32, **shape})
        size += values.nbytes
    accessors[0] |= {"min": cloud.means.min(axis=0).tolist(), "max": cloud.means.max(axis=0).tolist()}
    primitive = {
        "attributes": {name: index for index, name in enumerate(attributes)},
        "mode": _POINTS,
        "extensions": {EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
    document = {
        "asset": {"version": "2.0", "generator": "coliags_plugin", "extras": {"comment": comment}},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": size}],
        "bufferViews": views,
        "accessors": accessors,
    }
    text = json.dumps(document, allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    body = b"".join(np.ascontiguousarray(values, "<f4").tobytes() for values in attributes.values())
    # Version 2; each chunk has its length and kind.
    header = struct.pack("<4sIII4s", b"glTF", 2, 12 + 8 + len(text) + 8 + len(body), len(text), b"JSON")
    atomic_write(path, header + text + struct.pack("<I4s", len(body), b"BIN\0") + body)


def _attributes(cloud: SplatCloud) -> dict[str, np.ndarray]:
    """Attributes by their names. [N, C] each"""
    opaque = np.clip(cloud.opacities, 0.0, 1.0)[:, None]
    named = {
        "POSITION": cloud.means,
        "COLOR_0": np.concatenate([linear_light(cloud.colors), opaque], axis=1),
        f"{EXTENSION}:ROTATION": np.roll(cloud.unit_quats_wxyz, -1, axis=1),
        f"{EXTENSION}:SCALE": cloud.scales,
        f"{EXTENSION}:OPACITY": opaque,
    }
    for degree in range(cloud.degree + 1):
        for order in range(2 * degree + 1):
            coefficients = cloud.harmonics[:, degree * degree + order]
            named[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{order}"] = coefficients
    return {name: values.astype(np.float32) for name, values in named.items()}
