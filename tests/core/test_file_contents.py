"""Contents of files: arrays, text, JSON, PLY and images, read whole or refused with a message."""

from __future__ import annotations

import io
import os
import resource
import struct
import subprocess
import sys
import zipfile
import zlib
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coliags_plugin.core.arrays import read_array, read_arrays
from coliags_plugin.core.bounds import JSON_BYTES
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import decode_image, encode_image, write_image, write_mask
from coliags_plugin.core.json_files import read_json
from coliags_plugin.core.libraries import decoder_messages
from coliags_plugin.core.ply import point_properties, read_triangles, read_vertices, write_ply
from coliags_plugin.core.text_files import read_text, text_lines, whole_text
from coliags_plugin.datamanagers.fusion import load_points
from coliags_plugin.export.splats.formats import read_splats
from coliags_plugin.geometry.meshes.mesh import read_mesh
from coliags_plugin.geometry.poses.formats import format_of
from tests.layouts import write_exr

# NPZ and NPY files that are damaged or lie about their size


EXPECTED = "an NPZ file with an array 'positions'"


def npz_bytes(compressed=False, **arrays):
    data = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(data, **arrays)
    return data.getvalue()


def test_wanted_arrays_come_back(tmp_path):
    path = tmp_path / "a.npz"
    path.write_bytes(npz_bytes(one=np.arange(6).reshape(2, 3), two=np.array(1.5), three=np.array("text")))
    assert read_arrays(path, EXPECTED, ["one"])["one"].tolist() == [[0, 1, 2], [3, 4, 5]]
    assert list(read_arrays(path, EXPECTED, ["one"], ["two", "nine"])) == ["one", "two"]
    assert list(read_arrays(path, EXPECTED, optional=None)) == ["one", "two", "three"]
    with pytest.raises(InputError, match=r"a\.npz lacks nine"):
        read_arrays(path, EXPECTED, ["one", "nine"])


def test_an_archive_that_expands_enormously_is_refused_before_it_does(tmp_path):
    path = tmp_path / "bomb.npz"
    path.write_bytes(npz_bytes(compressed=True, positions=np.zeros((3_000_000, 3), np.float64)))
    assert path.stat().st_size < 1_000_000
    with pytest.raises(InputError, match=r"expands to 72,000,\d\d\d"):
        read_arrays(path, EXPECTED, ["positions"])


def test_what_is_no_array_is_refused(tmp_path):
    np.savez(tmp_path / "objects.npz", positions=np.array([{}], object))
    np.save(tmp_path / "objects.npy", np.array([{}], object))
    with zipfile.ZipFile(tmp_path / "text.npz", "w") as archive:
        archive.writestr("positions", b"text")
    # A header that promises more than follows reserves nothing.
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (100000, 1000000), }"
    (tmp_path / "short.npy").write_bytes(
        b"\x93NUMPY\x01\x00" + (len(header)).to_bytes(2, "little") + header + bytes(100)
    )
    for name in ("objects.npz", "objects.npy", "text.npz", "short.npy"):
        message = "'positions', which is no array" if name == "text.npz" else "cannot read"
        with pytest.raises(InputError, match=message):
            read_array(tmp_path / name, EXPECTED) if name.endswith("npy") else read_arrays(
                tmp_path / name, EXPECTED, ["positions"]
            )


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_any_damage_is_an_input_error(data, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "damaged.npz"
    whole = npz_bytes(compressed=data.draw(st.booleans()), positions=np.arange(300.0).reshape(100, 3))
    spoiled = bytearray(whole)
    for _ in range(data.draw(st.integers(1, 4))):
        spoiled[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(spoiled[: data.draw(st.integers(0, len(whole)))] if data.draw(st.booleans()) else spoiled)
    try:
        arrays = read_arrays(path, EXPECTED, ["positions"])
    except InputError:
        return
    assert arrays["positions"].nbytes <= 64 << 20


# Text and JSON are read up to a size, long texts line by line; anything else is a message


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_text_and_json_with_and_without_a_byte_order_mark(tmp_path, encoding):
    file = tmp_path / "a"
    file.write_bytes("à\nb\n".encode(encoding))
    assert whole_text(file) == read_text(file, "x") == "à\nb\n"
    assert list(text_lines(file, "x")) == [(1, "à\n"), (2, "b\n")]
    file.write_bytes('{"a": [1, 2.5]}'.encode(encoding))
    assert read_json(file, "x") == {"a": [1, 2.5]}


def test_sizes_up_to_the_largest_are_read(tmp_path):
    file = tmp_path / "a"
    file.write_bytes(b"abc")
    assert whole_text(file, 3) == "abc"
    with pytest.raises(ValueError, match="3 bytes, and at most 2"):
        whole_text(file, 2)
    file.write_bytes(bytes(1_000_001))
    with pytest.raises(InputError, match=r"cannot read .*a: it has 1,000,001 bytes, and at most 1,000,000 are read"):
        read_text(file, "x")
    assert sum(len(line) for _, line in text_lines(file, "x")) == 1_000_001
    os.truncate(file, JSON_BYTES + 1)
    with pytest.raises(InputError, match=r"cannot read .*a: it has 100,000,001 bytes"):
        read_json(file, "x")


@pytest.mark.parametrize("content", [None, "loop", b"\xff\xfe\x00", b"\xfe"])
@pytest.mark.parametrize("read", [read_text, lambda *args: list(text_lines(*args)), read_json])
def test_what_is_not_text_is_a_message(tmp_path, read, content):
    if content == "loop":
        (tmp_path / "a").symlink_to("a")
    elif content is not None:
        (tmp_path / "a").write_bytes(content)
    with pytest.raises(InputError, match="cannot read") as caught:
        read(tmp_path / "a", "a test")
    assert caught.value.expected == "a test"


@pytest.mark.parametrize("content", ["", "{", "[" * 100_000, "9" * 5000])
def test_what_is_not_json_is_a_message(tmp_path, content):
    (tmp_path / "a.json").write_text(content)
    with pytest.raises(InputError, match=r"a\.json is not JSON") as caught:
        read_json(tmp_path / "a.json", "a test", "Repair it")
    assert (caught.value.expected, caught.value.do) == ("a test", "Repair it")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('{\n  "a": [1,\n  2,],\n}', r"in line 3, column \d: '2,\],'.*nor a comma behind the last value"),
        ('{\n  "a": 1 // one\n}', r"in line 2, column 10: '\"a\": 1 // one'.*neither comments"),
        ("<!DOCTYPE html>\n<html>", "cannot read .*a: it is a web page"),
    ],
)
def test_where_json_ends_is_told(tmp_path, content, message):
    (tmp_path / "a").write_text(content)
    with pytest.raises(InputError, match=message):
        read_json(tmp_path / "a", "x")


@pytest.mark.parametrize(
    ("name", "read"),
    [
        ("a.png", decode_image),
        ("a.ply", read_vertices),
        ("a.npz", lambda path: read_arrays(path, "x")),
        ("a.npy", lambda path: read_array(path, "x")),
        ("a.json", lambda path: read_json(path, "x")),
        ("a.obj", read_mesh),
        ("a.glb", read_mesh),
        ("a.spz", read_splats),
        ("a.txt", format_of),
        ("a.txt", lambda path: list(text_lines(path, "x"))),
    ],
)
def test_what_is_in_the_place_of_a_file_is_told(tmp_path, name, read):
    path = tmp_path / name
    path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n")
    with pytest.raises(InputError, match=rf"{name}: it is a pointer of Git LFS.*`git lfs pull`"):
        read(path)
    path.write_text("\n<html><head>")
    with pytest.raises(InputError, match=rf"{name}: it is a web page"):
        read(path)


@pytest.mark.parametrize("number", ["NaN", "-Infinity", "1e999"])
def test_numbers_that_cannot_be_written_again(tmp_path, number):
    (tmp_path / "a.json").write_text(f'{{"a": [{number}]}}')
    assert set(read_json(tmp_path / "a.json", "x")) == {"a"}
    with pytest.raises(InputError, match=f"{number} is not a finite number"):
        read_json(tmp_path / "a.json", "x", finite=True)


# PLY files: written ones are read by open3d; vertices in every form are read whole or not at all


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


# Images


@pytest.mark.parametrize(("suffix", "bits"), [(".png", 8), (".png", 16), (".tiff", 8), (".tiff", 16), (".bmp", 8)])
def test_lossless_images_keep_their_numbers_and_masks_are_black_and_white(suffix, bits, tmp_path):
    path = tmp_path / "folder" / f"a{suffix}"
    pixels = np.random.default_rng(0).integers(0, 2**bits, (5, 7, 3)).astype(f"u{bits // 8}")
    write_image(path, pixels)
    path.write_bytes(path.read_bytes() + b"behind the end")
    for read in (decode_image, lambda file: cv2.imread(str(file), cv2.IMREAD_UNCHANGED)):
        np.testing.assert_array_equal(read(path)[..., ::-1], pixels)
        write_image(tmp_path / f"grey{suffix}", pixels[..., 0])
        np.testing.assert_array_equal(read(tmp_path / f"grey{suffix}"), pixels[..., 0])
        write_mask(tmp_path / f"mask{suffix}", np.array([[True, False]]))
        assert read(tmp_path / f"mask{suffix}").tolist() == [[255, 0]]
    assert decode_image(path, cv2.IMREAD_GRAYSCALE).shape == (5, 7)


def test_what_a_format_cannot_hold_is_refused():
    with pytest.raises(InputError, match=r"a uint8 \[0, 4\] image cannot be written as \.png"):
        encode_image(np.zeros((0, 4), np.uint8))
    with pytest.raises(InputError, match=r"cannot be written as \.nothing"):
        encode_image(np.zeros((2, 2), np.uint8), ".nothing")


def chunk(kind, data, length=None):
    length = len(data) if length is None else length
    return length.to_bytes(4, "big") + kind + data + zlib.crc32(kind + data).to_bytes(4, "big")


def test_damaged_images_are_refused_before_memory_is_asked_for(tmp_path):
    whole = encode_image(np.zeros((5, 7), np.uint8))
    start, rest = whole[:33], whole[33:]
    # OpenCV would allocate what the length of a chunk says.
    long = start + chunk(b"IDAT", b"x" * 20, 1 << 30) + rest
    sizes = ((60_000, 60_000), (30_000, 30_000), (40_000, 10), (2**31 - 1, 1))
    damaged = {
        "cut": (whole[:-13], "cannot be decoded"),
        "cut in the last chunk": (whole[:-1], "cannot be decoded"),
        "empty": (b"", "cannot be decoded"),
        "long": (long, "cannot be decoded"),
        **{
            f"{width} x {height}": (
                start[:8] + chunk(b"IHDR", struct.pack(">II", width, height) + start[24:29]) + rest,
                f"{width} x {height} pixels|decompression bomb|cannot be decoded",
            )
            for width, height in sizes
        },
        "text": (b"no image at all", "cannot be decoded"),
    }
    for name, (data, message) in damaged.items():
        path = tmp_path / f"{name}.png"
        path.write_bytes(data)
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        with pytest.raises(InputError, match=message):
            decode_image(path)
        assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000, name  # KiB
    with pytest.raises(InputError, match="cannot read"):
        decode_image(tmp_path / "missing.png")


# What decoders in C print: nothing on the terminal, and a warning where no error tells it


READ = """if True:
    import logging, sys
    from pathlib import Path
    from coliags_plugin.core.libraries import separate_stderr
    from coliags_plugin.core.errors import InputError
    from coliags_plugin.core.images import decode_image
    from coliags_plugin.datamanagers.file_formats import read_exr_channel
    separate_stderr()
    logging.basicConfig(format="log: %(message)s")
    for path in map(Path, sys.argv[1:]):
        try:
            read_exr_channel(path, "Y", "") if path.suffix == ".exr" else decode_image(path)
        except InputError as error:
            print("refused:", error, file=sys.stderr)
"""


@pytest.mark.thorough
def test_damage_is_told_once_and_a_warning_where_it_is_decoded(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 255, (40, 50, 3)).astype(np.uint8)
    write_exr(tmp_path / "a.exr", {"Y": np.random.default_rng(0).random((40, 50)).astype(np.float32)})
    png, tiff, jpg = (encode_image(pixels, suffix) for suffix in (".png", ".tiff", ".jpg"))
    exr, middle = (tmp_path / "a.exr").read_bytes(), len(png) // 2
    damaged = {
        "a.png": png[:middle] + bytes([png[middle] ^ 0xFF]) + png[middle + 1 :],  # libpng: CRC error
        "a.tiff": tiff[: len(tiff) // 2],  # libtiff: seek error
        "a.exr": exr[: len(exr) // 2],  # OpenEXR: corrupt leader, and a warning on stdout
        "a.jpg": jpg[:-2] + b"0123456789" + jpg[-2:],  # libjpeg: extraneous bytes
    }
    for name, data in damaged.items():
        (tmp_path / name).write_bytes(data)
    command = [sys.executable, "-c", READ, *(str(tmp_path / name) for name in damaged)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    *refused, warning = done.stderr.splitlines()
    assert done.stdout == "" and len(refused) == 3
    for line, name in zip(refused, damaged, strict=False):
        assert line.startswith("refused: ") and str(tmp_path / name) in line
    assert warning.startswith("log: an image is read that may be damaged; its decoder says: Corrupt JPEG data: ")


def test_threads_share_it_and_the_terminal_comes_back(capfd, caplog):
    def decode(number):
        with decoder_messages():
            os.write(2, b"noise\n")
        return number

    with ThreadPoolExecutor(8) as pool:
        assert list(pool.map(decode, range(200))) == list(range(200))
    assert {record.message.rpartition(": ")[2] for record in caplog.records} == {"noise"}
    with pytest.raises(KeyError), decoder_messages():
        os.write(2, b"noise\n")
        raise KeyError
    os.write(2, b"after\n")
    assert capfd.readouterr().err == "after\n"
