"""Writing binary PLY files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8

from coliags_plugin.core.files import atomic_write

#: PLY's name of each type that is written here.
_KINDS = {"<f4": "float", "|u1": "uchar"}


def write_ply(
    path: Path,
    vertices: Mapping[str, np.ndarray],
    triangles: Int[np.ndarray, "F 3"] | None = None,
    comment: str = "",
) -> None:
    """Write vertices and triangles atomically; the folder is made.

    Args:
        path: Where to.
        vertices: Properties by name, in their order: uint8 is kept, everything else becomes float32. Each [V]
        triangles: Indices of vertices, counted from 0. [F, 3]
        comment: A line for the header.

    Raises:
        InputError: The folder cannot be written.
    """
    kinds = {name: np.dtype("u1" if values.dtype == np.uint8 else "<f4") for name, values in vertices.items()}
    rows = np.empty(len(next(iter(vertices.values()))), list(kinds.items()))
    for name, values in vertices.items():
        rows[name] = values
    header = ["ply", "format binary_little_endian 1.0"]
    header += [f"comment {comment}"] if comment else []
    header += [f"element vertex {len(rows)}"]
    header += [f"property {_KINDS[kind.str]} {name}" for name, kind in kinds.items()]
    body = rows.tobytes()
    if triangles is not None:
        header += [f"element face {len(triangles)}", "property list uchar int vertex_indices"]
        faces = np.empty(len(triangles), [("count", "u1"), ("vertices", "<i4", (3,))])
        faces["count"], faces["vertices"] = 3, triangles
        body += faces.tobytes()
    atomic_write(path, ("\n".join([*header, "end_header"]) + "\n").encode() + body)


def point_properties(
    positions: Float[np.ndarray, "N 3"], colors: UInt8[np.ndarray, "N 3"] | None = None
) -> dict[str, np.ndarray]:
    """Points as :func:`write_ply` takes them: x, y, z and, where there are colours, red, green, blue."""
    properties = dict(zip("xyz", np.asarray(positions).T, strict=True))
    if colors is not None:
        properties |= dict(zip(("red", "green", "blue"), np.asarray(colors).T, strict=True))
    return properties
