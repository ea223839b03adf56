"""Writes the wall's mesh as PLY and OBJ."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from coliags_plugin.core.ply import point_properties, write_ply
from coliags_plugin.phantom.colon import ColonSurface


def write_mesh(path: Path, surface: ColonSurface, vertex_albedo: Float[np.ndarray, "V 3"]) -> None:
    """Write the wall as a binary PLY; vertex colours are the albedo, encoded with gamma 2.2."""
    colors = np.rint(255.0 * np.clip(vertex_albedo, 0.0, 1.0) ** (1.0 / 2.2)).astype(np.uint8)
    places, shades = point_properties(surface.vertices), dict(zip(("red", "green", "blue"), colors.T, strict=True))
    normals = dict(zip(("nx", "ny", "nz"), surface.normals.T, strict=True))
    write_ply(path, places | normals | shades, surface.triangles, "millimetres; colour = albedo ^ (1 / 2.2)")


def write_coverage_obj(path: Path, surface: ColonSurface, observed: Bool[np.ndarray, "F"]) -> None:
    """Write C3VD's coverage mesh: face corners ``v/vt`` with vt 1 for observed triangles and 2 for others."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w") as file:
        file.write("# millimetres; vt 1 = observed, vt 2 = not observed\n")
        np.savetxt(file, surface.vertices, "v %.6f %.6f %.6f")
        file.write("vt 0.25 0.5\nvt 0.75 0.5\n")
        corners = np.empty((len(surface.triangles), 6), np.int64)
        corners[:, ::2] = surface.triangles.astype(np.int64) + 1
        corners[:, 1::2] = np.where(observed, 1, 2)[:, None]
        np.savetxt(file, corners, "f %d/%d %d/%d %d/%d")
