"""Text and JSON are read up to a size, long texts line by line; anything else is a message."""

from __future__ import annotations

import os

import pytest

from coliags_plugin.core.arrays import read_array, read_arrays
from coliags_plugin.core.bounds import JSON_BYTES
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import decode_image
from coliags_plugin.core.json_files import read_json
from coliags_plugin.core.ply import read_vertices
from coliags_plugin.core.text_files import read_text, text_lines, whole_text
from coliags_plugin.export.splats.cloud import read_splats
from coliags_plugin.geometry.meshes.files import read_mesh
from coliags_plugin.geometry.poses.formats import format_of


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
