"""PLY files: vertices and triangles, read from ASCII and binary files and written as binary ones.

Read and written by hand. Of a file that is cut short, open3d 0.20 returns the triangles before the cut, and vertices
that were never read; plyfile has the GPL; trimesh hands on other properties, those of Gaussians, only as metadata.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise, repeat
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_write

_KINDS = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "<"}
#: Most digits of a count.
_DIGITS = 12
#: Names that programs give to the corners of a face.
_CORNERS = ("vertex_indices", "vertex_index")
#: Reads the next items of a row, of a data type and number.
_Take = Callable[[str, int], list[Any]]


@dataclass
class _Element:
    """An ``element`` of a header: its properties by name and type, those of length and items where it is a list."""

    name: str
    count: int
    properties: list[tuple[str, str | tuple[str, str]]] = field(default_factory=list)

    def layout(self, order: str) -> np.dtype:
        """A row, all of whose lists have three items; the length of list NAME is ``NAME/length``."""
        fields: list[tuple] = []
        for name, kind in self.properties:
            if isinstance(kind, tuple):
                fields += [(f"{name}/length", order + kind[0]), (name, order + kind[1], (3,))]
            else:
                fields.append((name, order + kind))
        return np.dtype(fields)


@dataclass(frozen=True)
class _PlyFile:
    """A file whose header is read: its format, its elements in order, and what follows the header."""

    path: Path
    form: str
    elements: list[_Element]
    body: bytes


def read_vertices(path: Path, needed: tuple[str, ...] = ("x", "y", "z")) -> dict[str, np.ndarray]:
    """The vertex properties of a PLY file by name, in their stored types; the file begins with its vertices."""
    return _vertices(_opened(path), needed)[0]


def read_triangles(path: Path) -> tuple[dict[str, np.ndarray], Int[np.ndarray, "F 3"]]:
    """Vertex properties as of :func:`read_vertices`, and triangles; polygons are split into fans.

    The file has vertices, then faces.
    """
    file = _opened(path)
    columns, rest = _vertices(file, ("x", "y", "z"))
    if len(file.elements) < 2 or file.elements[1].name != "face":
        raise InputError(f"{path} has no faces behind its vertices", "a mesh", "Check that it is no cloud of points")
    triangles = _faces(file, rest)
    if triangles.size and (triangles.min() < 0 or triangles.max() >= file.elements[0].count):
        raise InputError(f"{path} has triangles of vertices that are not there", "a mesh", "Fetch it again")
    return columns, triangles


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


def _opened(path: Path) -> _PlyFile:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}", "a PLY file") from error
    header, _, body = data.partition(b"end_header")
    if not data.startswith(b"ply") or not body:
        raise InputError(f"{path} ({len(data)} bytes) has no PLY header", "a PLY file", "Fetch it again")
    form, elements = "", list[_Element]()
    for line in header.decode("ascii", errors="replace").splitlines():
        match line.split():
            case ["format", name, *_] if name in _ORDERS:
                form = name
            case ["element", name, count] if count.isdecimal() and len(count) <= _DIGITS:
                elements.append(_Element(name, int(count)))
            case ["property", "list", length, kind, name] if elements and length in _KINDS and kind in _KINDS:
                elements[-1].properties.append((name, (_KINDS[length], _KINDS[kind])))
            case ["property", kind, name] if elements and kind in _KINDS:
                elements[-1].properties.append((name, _KINDS[kind]))
            case [] | ["ply"] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise InputError(f"{path}: header line '{line.strip()[:60]}'", "a PLY header")
    for element in elements:
        names = [name for name, _ in element.properties]
        if twice := [name for name in names if names.count(name) > 1]:
            raise InputError(f"{path}: the header names property {twice[0]} of {element.name} twice", "each once")
    if not form:
        raise InputError(f"{path}: the header names no format", f"one of {', '.join(_ORDERS)}")
    return _PlyFile(path, form, elements, body[body.find(b"\n") + 1 :])


def _vertices(file: _PlyFile, needed: tuple[str, ...]) -> tuple[dict[str, np.ndarray], bytes]:
    """Properties of the vertices, and what follows them."""
    # Only files with the vertices first are supported: behind a list, their offset would be unknown.
    vertex = next(iter(file.elements), _Element("", 0))
    if vertex.name != "vertex" or any(isinstance(kind, tuple) for _, kind in vertex.properties):
        raise InputError(f"{file.path} does not begin with vertices of plain numbers", "a PLY file of points")
    layout = vertex.layout(_ORDERS[file.form])
    names = list(layout.names or ())
    if missing := [name for name in needed if name not in names]:
        raise InputError(
            f"{file.path}: vertices have {', '.join(names) or 'no properties'}, but no {', '.join(missing)}",
            f"vertices with {', '.join(needed)}",
        )
    if file.form != "ascii":
        _check_count(file, "vertices", vertex.count, len(file.body) // layout.itemsize)
        rows, rest = np.frombuffer(file.body, layout, vertex.count), file.body[vertex.count * layout.itemsize :]
        return {name: rows[name].astype(layout[name].newbyteorder("=")) for name in names}, rest
    lines = [line for line in file.body.splitlines() if line.strip()]
    _check_count(file, "vertices", vertex.count, len(lines))
    words = [line.split() for line in lines[: vertex.count]]
    try:
        table = np.array(words, np.float64).reshape(vertex.count, len(names))
    except ValueError as error:
        raise InputError(f"{file.path}: a vertex row that is not numbers", f"rows of {len(names)} numbers") from error
    columns = {name: table[:, index].astype(layout[name]) for index, name in enumerate(names)}
    return columns, b"\n".join(lines[vertex.count :])


def _faces(file: _PlyFile, data: bytes) -> Int[np.ndarray, "F 3"]:
    face, order = file.elements[1], _ORDERS[file.form]
    lists = {name for name, kind in face.properties if isinstance(kind, tuple) and kind[1][0] in "iu"}
    corners = next((name for name in _CORNERS if name in lists), None)
    if corners is None:
        raise InputError(f"{file.path}: its faces have no list of {' or '.join(_CORNERS)}", "a mesh", "Fetch it again")
    if file.form == "ascii":
        lines = data.splitlines()
        _check_count(file, "faces", face.count, len(lines))
        return _fans(file, corners, (_text_items(line.split()) for line in lines[: face.count]))
    layout = face.layout(order)
    if face.count * layout.itemsize <= len(data):
        rows = np.frombuffer(data, layout, face.count)
        if all((rows[name] == 3).all() for name in layout.names or () if name.endswith("/length")):
            return np.asarray(rows[corners]).astype(np.int64)
    return _fans(file, corners, repeat(_binary_items(data, order), face.count))


def _fans(file: _PlyFile, corners: str, rows: Iterable[_Take]) -> Int[np.ndarray, "F 3"]:
    """Triangles of polygons, read row by row."""
    triangles = []
    try:
        for take in rows:
            for name, kind in file.elements[1].properties:
                length, item = kind if isinstance(kind, tuple) else ("", kind)
                items = take(item, int(take(length, 1)[0]) if length else 1)
                if name == corners:
                    first, *others = [int(corner) for corner in items] or [0]
                    triangles += [(first, *pair) for pair in pairwise(others)]
        return np.array(triangles, np.int64).reshape(-1, 3)
    except (ValueError, OverflowError) as error:
        message = f"{file.path} is damaged or cut short in its faces"
        raise InputError(message, "a complete file", "Fetch it again") from error


def _text_items(words: list[bytes]) -> _Take:
    remaining = iter(words)

    def take(kind: str, count: int) -> list[Any]:
        if not 0 <= count <= len(words):
            raise ValueError("a list of another length")
        items = [word for _, word in zip(range(count), remaining, strict=False)]
        if len(items) < count:
            raise ValueError("a row that is too short")
        return items

    return take


def _binary_items(data: bytes, order: str) -> _Take:
    position = 0

    def take(kind: str, count: int) -> list[Any]:
        nonlocal position
        if count < 0:
            raise ValueError("a list of negative length")
        items = np.frombuffer(data, order + kind, count, position)  # refuses what goes beyond the data
        position += items.nbytes
        return items.tolist()

    return take


def _check_count(file: _PlyFile, rows: str, count: int, held: int) -> None:
    if held < count:
        message = f"{file.path} says it has {count} {rows}, but holds {held}"
        raise InputError(message, "a complete file", "Fetch it again")
