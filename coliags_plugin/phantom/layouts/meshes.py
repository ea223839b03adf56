"""Writing the wall and points of it: PLY and OBJ."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8

from coliags_plugin.phantom.colon import ColonSurface

_COLORS = ("red", "green", "blue")


def write_ply(path: Path, surface: ColonSurface, vertex_albedo: Float[np.ndarray, "V 3"]) -> None:
    """The wall as a binary PLY; vertex colours are the albedo, encoded with gamma 2.2."""
    path.parent.mkdir(parents=True, exist_ok=True)
    kinds = {name: "float" for name in ("x", "y", "z", "nx", "ny", "nz")}
    kinds |= {name: "uchar" for name in _COLORS}
    vertices = np.empty(
        len(surface.vertices), [(name, "<f4" if kind == "float" else "u1") for name, kind in kinds.items()]
    )
    for axis, name in enumerate("xyz"):
        vertices[name] = surface.vertices[:, axis]
        vertices[f"n{name}"] = surface.normals[:, axis]
    colors = np.rint(255.0 * np.clip(vertex_albedo, 0.0, 1.0) ** (1.0 / 2.2)).astype(np.uint8)
    for channel, name in enumerate(_COLORS):
        vertices[name] = colors[:, channel]
    faces = np.empty(len(surface.triangles), [("count", "u1"), ("vertices", "<i4", (3,))])
    faces["count"], faces["vertices"] = 3, surface.triangles
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment millimetres; colour = albedo ^ (1 / 2.2)",
        f"element vertex {len(vertices)}",
        *(f"property {kind} {name}" for name, kind in kinds.items()),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    path.write_bytes(("\n".join(header) + "\n").encode() + vertices.tobytes() + faces.tobytes())


def write_coverage_obj(path: Path, surface: ColonSurface, observed: Bool[np.ndarray, "F"]) -> None:
    """The wall as C3VD's coverage mesh: face corners ``v/vt`` with vt 1 for observed triangles and 2 for others."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w") as file:
        file.write("# millimetres; vt 1 = observed, vt 2 = not observed\n")
        np.savetxt(file, surface.vertices, "v %.6f %.6f %.6f")
        file.write("vt 0.25 0.5\nvt 0.75 0.5\n")
        corners = np.empty((len(surface.triangles), 6), np.int64)
        corners[:, ::2] = surface.triangles.astype(np.int64) + 1
        corners[:, 1::2] = np.where(observed, 1, 2)[:, None]
        np.savetxt(file, corners, "f %d/%d %d/%d %d/%d")


def write_points(path: Path, positions: Float[np.ndarray, "N 3"], colors: UInt8[np.ndarray, "N 3"]) -> None:
    """Coloured points as a binary PLY."""
    path.parent.mkdir(parents=True, exist_ok=True)
    vertices = np.empty(len(positions), [(name, "<f4") for name in "xyz"] + [(name, "u1") for name in _COLORS])
    for axis, name in enumerate("xyz"):
        vertices[name] = positions[:, axis]
    for channel, name in enumerate(_COLORS):
        vertices[name] = colors[:, channel]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(vertices)}",
        *(f"property float {name}" for name in "xyz"),
        *(f"property uchar {name}" for name in _COLORS),
        "end_header",
    ]
    path.write_bytes(("\n".join(header) + "\n").encode() + vertices.tobytes())
