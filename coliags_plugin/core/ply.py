"""PLY files: vertices and triangles, read by trimesh from ASCII and binary files, and written as binary ones."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Shaped, UInt8

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_write
from coliags_plugin.core.text_files import unreadable

log = logging.getLogger(__name__)

#: Names of colours, in lower case.
_COLORS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))


def read_vertices(path: Path, needed: tuple[str, ...] = ("x", "y", "z")) -> dict[str, np.ndarray]:
    """The vertex properties of a PLY file by name, plain numbers in their stored types."""
    return _columns(path, _read(path), needed)


def read_triangles(path: Path) -> tuple[dict[str, np.ndarray], Int[np.ndarray, "F 3"]]:
    """Vertex properties as of :func:`read_vertices`, and triangles; polygons are split into triangles."""
    from trimesh.geometry import triangulate_quads

    elements = _read(path)
    columns, faces = _columns(path, elements), elements.get("faces")
    if faces is None:
        raise InputError(f"{path} has no faces", "a mesh", "Check that it is no cloud of points")
    triangles = np.asarray(triangulate_quads(faces))
    if triangles.ndim != 2 or triangles.shape[1] != 3 or triangles.dtype.kind not in "iu":
        raise InputError(f"{path} has faces that are no triangles", "a mesh", "Fetch it again")
    if triangles.size and (triangles.min() < 0 or triangles.max() >= len(columns["x"])):
        raise InputError(f"{path} has triangles of vertices that are not there", "a mesh", "Fetch it again")
    return columns, triangles.astype(np.int64)


def vertex_colors(path: Path, columns: Mapping[str, np.ndarray]) -> UInt8[np.ndarray, "V 3"] | None:
    """The colours among vertex properties, of any type, by the usual names; None if there are none."""
    by_name = {name.lower(): values for name, values in columns.items()}
    names = next((names for names in _COLORS if by_name.keys() >= set(names)), None)
    if names is None:
        return None
    stored = np.stack([by_name[name] for name in names], axis=1)
    colors, top = eight_bits(stored)
    if stored.dtype != np.uint8:
        log.info("%s: colours are %s, read as 0 to %d", path, stored.dtype, top)
    return colors


def eight_bits(stored: Shaped[np.ndarray, "N C"]) -> tuple[UInt8[np.ndarray, "N C"], int]:
    """Convert colours of any type to 8 bits; also return the value that was taken for full intensity.

    PLY and OBJ do not define it: it is 1 for floats with a mean up to 1, else 255 for values up to that, else 65535.
    """
    if stored.dtype == np.uint8:
        return stored, 255
    values = np.nan_to_num(stored) if stored.dtype.kind == "f" else stored.astype(np.float64)
    shares = stored.dtype.kind == "f" and values.size and values.mean() <= 1.0
    top = 1 if shares else 255 if values.max(initial=0.0) <= 255.0 else 65535
    return np.rint(np.clip(values * (255.0 / top), 0.0, 255.0)).astype(np.uint8), top


def write_ply(
    path: Path, vertices: Mapping[str, np.ndarray], triangles: Int[np.ndarray, "F 3"] | None = None, comment: str = ""
) -> None:
    """Write vertices and triangles atomically; the folder is made.

    Vertices are properties by name, [V] each: uint8 is kept, everything else becomes float32.
    """
    kinds = {name: "u1" if values.dtype == np.uint8 else "<f4" for name, values in vertices.items()}
    rows = np.empty(len(next(iter(vertices.values()))), list(kinds.items()))
    for name, values in vertices.items():
        rows[name] = values
    header = ["ply", "format binary_little_endian 1.0"]
    header += [f"comment {comment}"] if comment else []
    header += [f"element vertex {len(rows)}"]
    header += [f"property {'uchar' if kind == 'u1' else 'float'} {name}" for name, kind in kinds.items()]
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


def _columns(path: Path, elements: dict[str, Any], needed: tuple[str, ...] = ("x", "y", "z")) -> dict[str, np.ndarray]:
    vertices = elements["metadata"]["_ply_raw"].get("vertex", {"properties": {}, "length": 0})
    names = list(vertices["properties"])
    if missing := [name for name in needed if name not in names]:
        raise InputError(
            f"{path}: vertices have {', '.join(names) or 'no properties'}, but no {', '.join(missing)}",
            f"vertices with {', '.join(needed)}",
        )
    rows = vertices.get("data", {name: np.zeros(0, np.float32) for name in names})
    columns = {}
    for name in names:
        column = np.asarray(rows[name]).reshape(-1)
        if column.dtype.kind not in "iuf" or len(column) != vertices["length"]:
            raise InputError(f"{path}: not a number {name} for each vertex", "a complete file", "Fetch it again")
        columns[name] = column.astype(column.dtype.newbyteorder("="))
    return columns


def _read(path: Path) -> dict[str, Any]:
    """Faces of a file as trimesh reads them, and every element as it is stored."""
    from trimesh.exchange.ply import load_ply

    try:
        with path.open("rb") as file, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of text that is not numbers, which is refused below
            elements: dict[str, Any] = load_ply(file, fix_texture=False, skip_materials=True)
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}", "a PLY file") from error
    except Exception as error:  # trimesh raises whatever it meets
        size = path.stat().st_size
        problem = f"{path} ({size} bytes) cannot be read as PLY: {error}"
        raise unreadable(path, problem, "a complete PLY file", "Fetch it again") from error
    return elements
