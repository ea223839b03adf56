"""PLY files: written ones are read by open3d; vertices in every form are read whole or not at all."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.ply import point_properties, read_triangles, read_vertices, write_ply
from coliags_plugin.datamanagers.fusion import load_points
from coliags_plugin.geometry.meshes.files import read_mesh

FIELDS = [("x", "f4"), ("y", "f4"), ("z", "f8"), ("red", "u1"), ("green", "u1"), ("blue", "u1"), ("label", "i2")]
WORDS = {"f4": "float", "f8": "double", "u1": "uchar", "i2": "short"}
FORMATS = {"<": "binary_little_endian", ">": "binary_big_endian", "a": "ascii"}


def vertices(order: str = "<") -> np.ndarray:
    rng = np.random.default_rng(0)
    rows = np.empty(5, [(name, order + kind) for name, kind in FIELDS])
    for name, kind in FIELDS:
        rows[name] = rng.normal(size=5) if kind[0] == "f" else rng.integers(0, 255, 5)
    return rows


def header(form: str, count: int = 5, more: str = "") -> str:
    properties = "".join(f"property {WORDS[kind]} {name}\n" for name, kind in FIELDS)
    return f"ply\nformat {form} 1.0\ncomment a\nelement vertex {count}\n{properties}{more}end_header\n"


FACES = "property uchar kind\nproperty list uchar int vertex_indices\nproperty list uchar float texcoord\n"
SPLIT = [(0, 1, 2), (0, 2, 3), (1, 2, 3), (1, 3, 4)]


@pytest.mark.parametrize("order", FORMATS)
@pytest.mark.parametrize(
    ("faces", "triangles"), [([], []), ([(0, 1, 2), (2, 3, 4)],) * 2, ([(0, 1, 2, 3), (1, 2, 3, 4)], SPLIT)]
)
def test_every_form(tmp_path, order, faces, triangles):
    """Files with other lists, and polygons, which are split into triangles."""
    binary = order.replace("a", "<")
    table, path = vertices(binary), tmp_path / "p.ply"
    body = table.tobytes()
    for face in faces:
        body += struct.pack("BB", 7, len(face)) + np.array(face, f"{binary}i4").tobytes()
        body += struct.pack("B", 2 * len(face)) + bytes(8 * len(face))
    if order == "a":
        rows = [" ".join(repr(value.item()) for value in row) for row in table]
        rows += [f"7 {len(face)} {' '.join(map(str, face))} {2 * len(face)}{2 * len(face) * ' 0'}" for face in faces]
        body = "\n".join([*rows, ""]).encode()
    whole = header(FORMATS[order], more=f"element face 2\n{FACES}" if faces else "").encode() + body
    path.write_bytes(whole)
    properties = read_vertices(path)
    assert list(properties) == [name for name, _ in FIELDS]
    for name, kind in FIELDS:
        assert properties[name].dtype == np.dtype(kind)
        np.testing.assert_array_equal(properties[name], table[name])
    points = load_points(path)
    np.testing.assert_array_equal(points.positions[:, 0], table["x"])
    np.testing.assert_array_equal(points.colors[:, 2], table["blue"])
    if faces:
        assert set(map(tuple, np.sort(read_triangles(path)[1], axis=1).tolist())) == set(triangles)
        for cut in range(3, 40):
            path.write_bytes(whole[:-cut])
            with pytest.raises(InputError):
                read_triangles(path)


@pytest.mark.parametrize(
    ("kind", "stored", "colors"),
    [
        ("float", "0.5 1.5 nan", [128, 255, 0]),
        ("double", "127.6 255 0", [128, 255, 0]),
        ("ushort", "32896 65535 0", [128, 255, 0]),
        ("ushort", "128 255 0", [128, 255, 0]),
        ("int", "300 -5 255", [1, 0, 1]),
        ("uchar", "1 1 0", [1, 1, 0]),
    ],
)
@pytest.mark.parametrize(
    "names", ["red green blue", "r g b", "diffuse_red diffuse_green diffuse_blue", "Red Green Blue"]
)
def test_colours_of_every_type_and_name(tmp_path, kind, stored, colors, names):
    path = tmp_path / "p.ply"
    properties = "".join(f"property float {name}\n" for name in "xyz")
    properties += "".join(f"property {kind} {name}\n" for name in names.split())
    faces = "element face 1\nproperty list uchar int vertex_indices\n"
    path.write_text(f"ply\nformat ascii 1.0\nelement vertex 3\n{properties}{faces}end_header\n")
    path.write_text(path.read_text() + f"1 2 3 {stored}\n" * 3 + "3 0 1 2\n")
    assert load_points(path).colors.tolist() == [colors] * 3
    assert read_mesh(path).colors.tolist() == [colors] * 3


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", r"\(0 bytes\) cannot be read as PLY"),
        (b"plenty of text", "cannot be read as PLY"),
        (header("binary_little_endian").encode() + vertices().tobytes()[:-1], "cannot be read as PLY"),
        (header("ascii").encode() + b"1 2 3 4 5 6 7\n", "not a number x for each vertex"),
        (header("ascii", 1).encode() + b"1 2 3\n", "cannot be read as PLY"),
        (header("ascii", 2).encode() + b"1 2 3 4 5 6 7\n1 2 3\n", "not a number red for each vertex"),
        (header("ascii", 2).encode() + b"1 2 3 4 5 6 7\n1 2 3 4 five 6 7\n", "cannot be read as PLY"),
        (header("binary").encode(), "cannot be read as PLY"),
        (header("ascii").replace("format ascii 1.0\n", "").encode(), "cannot be read as PLY"),
        (header("ascii").replace("float x", "half x").encode(), "cannot be read as PLY"),
        (header("ascii").replace("vertex", "face").encode(), "no x, y, z"),
        (header("ascii").replace("float x", "list uchar int x").encode(), "not a number x for each vertex"),
    ],
)
def test_refused(tmp_path, content, message):
    (tmp_path / "p.ply").write_bytes(content)
    with pytest.raises(InputError, match=message):
        read_vertices(tmp_path / "p.ply")


def test_written_files_are_read_by_open3d(tmp_path):
    import open3d

    positions, colors = np.arange(9.0).reshape(3, 3) ** 2, np.array([[1, 2, 3], [255, 0, 128], [9, 8, 7]], np.uint8)
    write_ply(tmp_path / "folder" / "points.ply", point_properties(positions, colors))
    cloud = open3d.io.read_point_cloud(str(tmp_path / "folder" / "points.ply"))
    np.testing.assert_array_equal(cloud.points, positions)
    np.testing.assert_allclose(cloud.colors, colors / 255.0)
    write_ply(tmp_path / "mesh.ply", point_properties(positions), np.array([[0, 1, 2]]), "millimetres")
    mesh = open3d.io.read_triangle_mesh(str(tmp_path / "mesh.ply"))
    assert np.asarray(mesh.triangles).tolist() == [[0, 1, 2]] and not mesh.has_vertex_colors()
    np.testing.assert_array_equal(mesh.vertices, positions)
    assert b"\ncomment millimetres\n" in (tmp_path / "mesh.ply").read_bytes()
    # Other types become float32.
    write_ply(tmp_path / "rows.ply", {"x": np.array([1, 2]), "weight": np.array([0.5, 0.25])})
    header, _, body = (tmp_path / "rows.ply").read_bytes().partition(b"end_header\n")
    assert header.endswith(b"element vertex 2\nproperty float x\nproperty float weight\n")
    assert np.frombuffer(body, "<f4").tolist() == [1.0, 0.5, 2.0, 0.25]
