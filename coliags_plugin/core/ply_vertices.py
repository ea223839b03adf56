"""Reading the vertices of a PLY file; truncated files are errors."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from coliags_plugin.core.errors import InputError

_KINDS = {
    **{name: "i1" for name in ("char", "int8")},
    **{name: "u1" for name in ("uchar", "uint8")},
    **{name: "i2" for name in ("short", "int16")},
    **{name: "u2" for name in ("ushort", "uint16")},
    **{name: "i4" for name in ("int", "int32")},
    **{name: "u4" for name in ("uint", "uint32")},
    **{name: "f4" for name in ("float", "float32")},
    **{name: "f8" for name in ("double", "float64")},
}
#: Most digits of a count.
_DIGITS = 12
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "<"}


@dataclass
class PlyElement:
    """An ``element`` of a PLY header.

    Attributes:
        name: Of the element.
        count: Of its rows.
        properties: In order: name and data type, without byte order; of a list, those of its length and its items.
    """

    name: str
    count: int
    properties: list[tuple[str, str | tuple[str, str]]] = field(default_factory=list)

    @property
    def has_lists(self) -> bool:
        """Whether rows are of different lengths."""
        return any(isinstance(kind, tuple) for _, kind in self.properties)

    def layout(self, form: str) -> np.dtype:
        """A row without lists, as it is stored in a file of a format."""
        return np.dtype([(name, _ORDERS[form] + str(kind)) for name, kind in self.properties])


@dataclass(frozen=True)
class PlyFile:
    """A PLY file whose header is read.

    Attributes:
        form: ``ascii``, ``binary_little_endian`` or ``binary_big_endian``.
        elements: In order.
        body: What follows the header.
    """

    form: str
    elements: list[PlyElement]
    body: bytes


def open_ply(path: Path) -> PlyFile:
    """Read the header of a PLY file.

    Raises:
        InputError: The file cannot be read, or has no valid header.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}", "a PLY file") from error
    header, _, body = data.partition(b"end_header")
    if not data.startswith(b"ply") or not body:
        raise InputError(f"{path} ({len(data)} bytes) has no PLY header", "a PLY file", "Fetch it again")
    form, elements = _parsed(path, header.decode("ascii", errors="replace"))
    return PlyFile(form, elements, body[body.find(b"\n") + 1 :])


def read_vertices(path: Path, needed: tuple[str, ...] = ("x", "y", "z")) -> dict[str, np.ndarray]:
    """Read the vertex properties of an ASCII or binary PLY file, by name.

    Args:
        path: The file.
        needed: Required properties.

    Returns:
        One array per property, of the stored data type. Each [N]

    Raises:
        InputError: The file is damaged or not a PLY file, or its vertices lack a property.
    """
    return vertices_of(path, open_ply(path), needed)


def vertices_of(path: Path, file: PlyFile, needed: tuple[str, ...] = ("x", "y", "z")) -> dict[str, np.ndarray]:
    """:func:`read_vertices` of a file whose header is read.

    Raises:
        InputError: The file is damaged, or its vertices lack a property.
    """
    elements = file.elements
    # Only files with the vertices first are supported: behind a list, their offset would be unknown.
    if not elements or elements[0].name != "vertex" or elements[0].has_lists:
        raise InputError(f"{path} does not begin with vertices of plain numbers", "a PLY file of points")
    vertex = elements[0]
    names = [name for name, _ in vertex.properties]
    if missing := [name for name in needed if name not in names]:
        raise InputError(
            f"{path}: vertices have {', '.join(names) or 'no properties'}, but no {', '.join(missing)}",
            f"vertices with {', '.join(needed)}",
        )
    layout, body = vertex.layout(file.form), file.body
    if file.form == "ascii":
        return _ascii(path, body, vertex, layout)
    if len(body) < vertex.count * layout.itemsize:
        raise _cut_short(path, vertex.count, len(body) // layout.itemsize)
    vertices = np.frombuffer(body, layout, vertex.count)
    return {name: vertices[name].astype(layout[name].newbyteorder("=")) for name in layout.names or ()}


def _parsed(path: Path, header: str) -> tuple[str, list[PlyElement]]:
    form, elements = "", list[PlyElement]()
    for line in header.splitlines():
        match line.split():
            case ["format", name, *_] if name in _ORDERS:
                form = name
            case ["element", name, count] if count.isdecimal() and len(count) <= _DIGITS:
                elements.append(PlyElement(name, int(count)))
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
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise InputError(f"{path}: the header names property {twice} of {element.name} twice", "each once")
    if not form:
        raise InputError(f"{path}: the header names no format", f"one of {', '.join(_ORDERS)}")
    return form, elements


def _ascii(path: Path, body: bytes, vertex: PlyElement, layout: np.dtype) -> dict[str, np.ndarray]:
    lines = [line for line in body.splitlines() if line.strip()][: vertex.count]
    if len(lines) < vertex.count:
        raise _cut_short(path, vertex.count, len(lines))
    try:
        rows = np.array([line.split() for line in lines], np.float64).reshape(vertex.count, len(vertex.properties))
    except ValueError as error:
        expected = f"rows of {len(vertex.properties)} numbers"
        raise InputError(f"{path}: a vertex row that is not numbers", expected) from error
    return {name: rows[:, index].astype(layout[name]) for index, name in enumerate(layout.names or ())}


def _cut_short(path: Path, expected: int, found: int) -> InputError:
    return InputError(f"{path} says it has {expected} vertices, but holds {found}", "a complete file", "Fetch it again")
