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
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "<"}


@dataclass
class _Element:
    """A PLY ``element`` with its properties in order: name and data type, None for a list."""

    name: str
    count: int
    properties: list[tuple[str, str | None]] = field(default_factory=list)


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
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}", "a PLY file") from error
    header, _, body = data.partition(b"end_header")
    if not data.startswith(b"ply") or not body:
        raise InputError(f"{path} ({len(data)} bytes) has no PLY header", "a PLY file", "Fetch it again")
    form, elements = _parsed(path, header.decode("ascii", errors="replace"))
    # Only files with the vertices first are supported: behind a list, their offset would be unknown.
    if not elements or elements[0].name != "vertex" or any(kind is None for _, kind in elements[0].properties):
        raise InputError(f"{path} does not begin with vertices of plain numbers", "a PLY file of points")
    vertex = elements[0]
    names = [name for name, _ in vertex.properties]
    if missing := [name for name in needed if name not in names]:
        raise InputError(
            f"{path}: vertices have {', '.join(names) or 'no properties'}, but no {', '.join(missing)}",
            f"vertices with {', '.join(needed)}",
        )
    layout = np.dtype([(name, _ORDERS[form] + str(kind)) for name, kind in vertex.properties])
    # Skip the rest of the header's last line.
    body = body[body.find(b"\n") + 1 :]
    if form == "ascii":
        return _ascii(path, body, vertex, layout)
    if len(body) < vertex.count * layout.itemsize:
        raise _cut_short(path, vertex.count, len(body) // layout.itemsize)
    vertices = np.frombuffer(body, layout, vertex.count)
    return {name: vertices[name].astype(layout[name].newbyteorder("=")) for name in names}


def _parsed(path: Path, header: str) -> tuple[str, list[_Element]]:
    form, elements = "", list[_Element]()
    for line in header.splitlines():
        match line.split():
            case ["format", name, *_] if name in _ORDERS:
                form = name
            case ["element", name, count] if count.isdecimal():
                elements.append(_Element(name, int(count)))
            case ["property", "list", _, _, name] if elements:
                elements[-1].properties.append((name, None))
            case ["property", kind, name] if elements and kind in _KINDS:
                elements[-1].properties.append((name, _KINDS[kind]))
            case [] | ["ply"] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise InputError(f"{path}: header line '{line.strip()[:60]}'", "a PLY header")
    if not form:
        raise InputError(f"{path}: the header names no format", f"one of {', '.join(_ORDERS)}")
    return form, elements


def _ascii(path: Path, body: bytes, vertex: _Element, layout: np.dtype) -> dict[str, np.ndarray]:
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
