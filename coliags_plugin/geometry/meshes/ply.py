"""Reading triangle meshes from PLY files, ASCII or binary."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Int

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.ply_vertices import PlyElement, PlyFile, open_ply, vertices_of
from coliags_plugin.geometry.meshes.mesh import TriangleMesh

_COLORS = ("red", "green", "blue")
#: Names that programs give to the corners of a face.
_CORNERS = ("vertex_indices", "vertex_index")


def read_ply_mesh(path: Path) -> TriangleMesh:
    """Read the triangles of a PLY file; polygons are split into fans.

    Args:
        path: The file: vertices, then faces.

    Returns:
        The mesh, with vertex colours where there are ``red``, ``green`` and ``blue`` of 8 bits.

    Raises:
        InputError: The file is damaged, or holds no faces behind its vertices.
    """
    file = open_ply(path)
    columns = vertices_of(path, file)
    if len(file.elements) < 2 or file.elements[1].name != "face":
        raise InputError(f"{path} has no faces behind its vertices", "a mesh", "Check that it is no cloud of points")
    triangles = (_text_faces if file.form == "ascii" else _binary_faces)(path, file)
    if triangles.size and (triangles.min() < 0 or triangles.max() >= file.elements[0].count):
        raise InputError(f"{path} has triangles of vertices that are not there", "a mesh", "Fetch it again")
    colored = all(name in columns and columns[name].dtype == np.uint8 for name in _COLORS)
    with np.errstate(over="ignore"):
        vertices = np.stack([columns[name] for name in "xyz"], axis=1).astype(np.float32)
    return TriangleMesh(vertices, triangles, np.stack([columns[name] for name in _COLORS], axis=1) if colored else None)


def _binary_faces(path: Path, file: PlyFile) -> Int[np.ndarray, "F 3"]:
    vertex, face = file.elements[0], file.elements[1]
    data = file.body[vertex.count * vertex.layout(file.form).itemsize :]
    place = _corners(path, face)
    triangle = np.dtype([field for index in range(len(face.properties)) for field in _fields(face, file, index)])
    if face.count * triangle.itemsize <= len(data):
        rows = np.frombuffer(data, triangle, face.count)
        lengths = [
            rows[f"{index}/length"] for index, (_, kind) in enumerate(face.properties) if isinstance(kind, tuple)
        ]
        if all((found == 3).all() for found in lengths):
            return np.asarray(rows[f"{place}/items"]).astype(np.int64)
    return _fans(_polygons(path, file, data, place))


def _fields(face: PlyElement, file: PlyFile, index: int) -> list[tuple]:
    """Fields of a property in a row all of whose lists have three items."""
    order = ">" if file.form == "binary_big_endian" else "<"
    kind = face.properties[index][1]
    if isinstance(kind, tuple):
        return [(f"{index}/length", order + kind[0]), (f"{index}/items", order + kind[1], (3,))]
    return [(f"{index}/value", order + kind)]


def _polygons(path: Path, file: PlyFile, data: bytes, place: int) -> list[np.ndarray]:
    """Corners of each face, row by row."""
    face, order = file.elements[1], ">" if file.form == "binary_big_endian" else "<"
    found, at = list[np.ndarray](), 0
    for _ in range(face.count):
        for index, (_, kind) in enumerate(face.properties):
            length, item = kind if isinstance(kind, tuple) else ("", kind)
            count = 1
            if length:
                count = int(_items(path, data, at, np.dtype(order + length), 1)[0])
                at += np.dtype(length).itemsize
            items = _items(path, data, at, np.dtype(order + item), count)
            at += items.nbytes
            if index == place:
                found.append(items)
    return found


def _items(path: Path, data: bytes, at: int, kind: np.dtype, count: int) -> np.ndarray:
    if count < 0 or at + count * kind.itemsize > len(data):
        raise InputError(f"{path} is damaged or cut short in its faces", "a complete file", "Fetch it again")
    return np.frombuffer(data, kind, count, at)


def _text_faces(path: Path, file: PlyFile) -> Int[np.ndarray, "F 3"]:
    vertex, face = file.elements[0], file.elements[1]
    place = _corners(path, face)
    lines = [line for line in file.body.splitlines() if line.strip()][vertex.count : vertex.count + face.count]
    if len(lines) < face.count:
        raise InputError(f"{path} says it has {face.count} faces, but holds {len(lines)}", "a complete file")
    found = []
    try:
        for line in lines:
            words, at = line.split(), 0
            for index, (_, kind) in enumerate(face.properties):
                count = 1
                if isinstance(kind, tuple):
                    count, at = int(words[at]), at + 1
                if count < 0 or at + count > len(words):
                    raise ValueError("a row of another length")
                if index == place:
                    found.append(np.array([int(word) for word in words[at : at + count]], np.int64))
                at += count
    except (ValueError, IndexError, OverflowError) as error:
        raise InputError(f"{path} has a face that is not indices", "a mesh", "Fetch it again") from error
    return _fans(found)


def _corners(path: Path, face: PlyElement) -> int:
    """Which property of the faces holds their corners."""
    for index, (name, kind) in enumerate(face.properties):
        if name in _CORNERS and isinstance(kind, tuple) and kind[1][0] in "iu":
            return index
    raise InputError(f"{path}: its faces have no list of {' or '.join(_CORNERS)}", "a mesh", "Fetch it again")


def _fans(polygons: list[np.ndarray]) -> Int[np.ndarray, "F 3"]:
    triangles = [(face[0], *pair) for face in polygons if len(face) >= 3 for pair in pairwise(face[1:])]
    return np.array(triangles, np.int64).reshape(-1, 3)
