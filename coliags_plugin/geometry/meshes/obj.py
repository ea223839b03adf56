"""Wavefront OBJ text of triangle meshes, with the texture indices that C3VD uses as flags.

Read by hand: open3d 0.20 gives texture coordinates in place of their indices, which are lost where two coordinates are
equal, splits vertices there, and of a damaged file returns an empty mesh without an error.
"""

from __future__ import annotations

import io
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Int

from coliags_plugin.core.errors import InputError
from coliags_plugin.geometry.meshes.mesh import TriangleMesh

#: Numbers of a vertex at most: position, w, colour. What follows them is not read one by one.
_MOST_NUMBERS = 7
#: Characters of a line of a triangle at most; polygons may have more.
_LONGEST_TRIANGLE = 200


def decode_obj(path: Path) -> tuple[TriangleMesh, Int[np.ndarray, "F"] | None]:
    """Read the triangles of an OBJ file; polygons are split into fans.

    The mesh has vertex colours where every ``v`` has six numbers, the last three in [0, 1]. Beside it, for each
    triangle, the texture index (``vt``, counted from 1) of its first corner; None where corners have none.

    Raises:
        InputError: It cannot be read, or a line of a vertex or a face is damaged.
    """
    found: dict[str, list[str]] = {"v ": [], "f ": []}
    try:
        with path.open(encoding="utf-8", errors="replace") as lines:
            for line in lines:
                if line[:2] in found:
                    found[line[:2]].append(line[2:])
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}", "an OBJ file") from error
    vertices, faces = _numbers(path, found["v "]), found["f "]
    corners, textures = _corners(path, faces)
    corners = np.where(corners < 0, corners + len(vertices), corners - 1)
    if corners.size and (corners.min() < 0 or corners.max() >= len(vertices)):
        raise InputError(f"{path} has faces of vertices that are not there", "a mesh", "Fetch it again")
    colors = None
    if vertices.shape[1] >= 6:
        colors = np.rint(vertices[:, 3:6] * 255.0).clip(0, 255).astype(np.uint8)
    return TriangleMesh(vertices[:, :3].astype(np.float32), corners, colors), textures


def encode_obj(mesh: TriangleMesh) -> bytes:
    """OBJ text of a mesh, colours in [0, 1] behind the positions."""
    text = io.BytesIO()
    rows, form = mesh.vertices.astype(np.float64), "v %.5f %.5f %.5f"
    if mesh.colors is not None:
        rows, form = np.concatenate([rows, mesh.colors / 255.0], axis=1), form + " %.4f %.4f %.4f"
    np.savetxt(text, rows, form)
    np.savetxt(text, mesh.triangles + 1, "f %d %d %d")
    return text.getvalue()


def _numbers(path: Path, rows: list[str]) -> np.ndarray:
    try:
        values = np.array([row.split(maxsplit=_MOST_NUMBERS) for row in rows], np.float64).reshape(len(rows), -1)
    except ValueError as error:
        raise InputError(f"{path} has vertices that are not rows of numbers", "an OBJ file") from error
    if len(rows) and values.shape[1] < 3:
        raise InputError(f"{path} has vertices of {values.shape[1]} numbers", "x, y, z")
    return values if len(rows) else np.zeros((0, 3))


def _corners(path: Path, faces: list[str]) -> tuple[np.ndarray, np.ndarray | None]:
    """Vertex indices as they stand, [F, 3], and the texture index of each first corner, [F]."""
    vertices, textures = list[tuple[int, int, int]](), list[int]()
    try:
        if (quick := _triangles_alike(faces)) is not None:
            return quick
        for face in faces:
            fields = [corner.split("/") for corner in face.split()]
            indices = [int(field[0]) for field in fields]
            texture = int(fields[0][1]) if len(fields[0]) > 1 and fields[0][1] else 0
            for second, third in pairwise(indices[1:]):
                vertices.append((indices[0], second, third))
                textures.append(texture)
        corners, flags = np.array(vertices, np.int64).reshape(-1, 3), np.array(textures, np.int64)
    except (ValueError, IndexError, OverflowError) as error:
        raise InputError(f"{path} has a face that is not indices", "an OBJ file") from error
    return corners, flags if len(flags) and flags.all() else None


def _triangles_alike(faces: list[str]) -> tuple[np.ndarray, np.ndarray | None] | None:
    """The same of faces that are all triangles of the form ``v`` or ``v/vt``, much faster; None of others."""
    if max(map(len, faces), default=0) > _LONGEST_TRIANGLE:
        return None
    text = "\n".join(faces)
    slashes = text.count("/")
    if not faces or slashes not in (0, 3 * len(faces)) or "//" in text:
        return None
    numbers = np.array(text.replace("/", " ").split(), np.int64)
    if len(numbers) != 3 * len(faces) + slashes:
        return None
    rows = numbers.reshape(len(faces), 3, -1)
    return rows[:, :, 0], rows[:, 0, 1] if slashes and rows[:, 0, 1].all() else None
