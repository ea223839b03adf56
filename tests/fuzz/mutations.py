"""Damage to files as strategies of hypothesis. Each edit is a small JSON object, so that a case can be stored.

An edit is ``{"file": NAME, "op": NAME, ...}`` with the arguments of one of :data:`EDITS`. Positions wrap around the
length of the file, so that an edit can be applied to any file.
"""

from __future__ import annotations

import io
import json
import re
import shutil
import struct
import zipfile
import zlib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from hypothesis import strategies as st

Edit = dict[str, Any]

#: What numbers, words and strings of text files are replaced by.
HOSTILE = (
    *("1e308", "-1e308", "1e400", "nan", "inf", "-inf", ".inf", ".nan", "NaN", "Infinity", "-1", "0", "-0.0", "1e-320"),
    *("1e38", "3.5e38", "1e20", "1e7", "1e-7", "2", "0.5", "60000", "99999999999999999999", "4294967296", "2147483648"),
    *("-9223372036854775809", "0x10", "1_000", "1,5", "\u0663", "null", "true", "[]"),
    *("{}", "[1, 2]", '""', '"nan"', '"1e400"', '"\\ud800"', '"\\u0000"', "\\"),
    *("..", "/dev/zero", "/", '"/dev/zero"', '"/etc/hostname"', '"../../../etc/hostname"', '"."', '"loop"', "*a", "&a"),
    *("!!python/object:os.system", "%s%n", "\x00", "\x1b[31m", "é", "#", "--- "),
)
#: What is repeated to replace them: text and how often.
REPEATED = (("9", 5000), ("0", 400), ("a", 5000), ("/a", 3000), ("[", 20000), ("{", 300), ("- ", 2000), ("x ", 100_000))
#: What stretches of binary files are overwritten by.
BYTES = (
    *(b"\x00", b"\xff", b"\x00" * 8, b"\xff" * 8, b"\x7f\xff\xff\xff", b"\xff\xff\xff\x7f", b"\x00\x00\x00\x80"),
    *(struct.pack("<d", value) for value in (np.nan, np.inf, 1e308, -1e308, 1e38, 1e12, -1.0, 0.0)),
    *(struct.pack("<f", value) for value in (np.nan, np.inf, 3e38, -3e38, 1e30, 1e8, -1.0, 0.0)),
    *(struct.pack("<Q", value) for value in (1 << 63, 1 << 40, 1 << 31, 1 << 20)),
)
#: What arrays of NPZ and NPY files become.
ARRAYS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    **{word: lambda array, word=word: _with_middle(array, float(word)) for word in ("nan", "inf", "1e308", "1e30")},
    "zeros": lambda array: np.zeros(array.shape),
    "negative": lambda array: np.full(array.shape, -1.0),
    "text": lambda array: np.full(array.shape, "x"),
    "complex": lambda array: np.zeros(array.shape, np.complex128),
    "empty": lambda array: array[..., :0] if array.ndim else np.zeros(0),
    "flat": lambda array: array.reshape(-1),
    "transposed": lambda array: array.T,
    "first": lambda array: np.atleast_1d(array)[0],
}
#: What images become, and in which format they are written; of none, in their own.
IMAGES: dict[str, tuple[str, Callable[[np.ndarray], np.ndarray]]] = {
    "gray": ("", lambda pixels: pixels[..., 0] if pixels.ndim == 3 else np.dstack([pixels] * 3)),
    "rgba": ("", lambda pixels: np.dstack([np.atleast_3d(pixels)[..., :1]] * 4)),
    "16-bit": ("", lambda pixels: (pixels % 256).astype(np.uint16 if pixels.dtype == np.uint8 else np.uint8)),
    "half": ("", lambda pixels: pixels[::2, ::2]),
    "pixel": ("", lambda pixels: pixels[:1, :1]),
    "strip": ("", lambda pixels: pixels[:1]),
    "black": ("", np.zeros_like),
    "jpeg": (".jpg", lambda pixels: np.clip(pixels, 0, 255).astype(np.uint8)),
    "float": (".tiff", lambda pixels: pixels.astype(np.float32)),
    "negative": (".tiff", lambda pixels: -pixels.astype(np.float32)),
    **{word: (".tiff", lambda pixels, word=word: _with_middle(pixels, float(word))) for word in ("nan", "inf", "1e38")},
}
#: What becomes of a file as a whole.
NODES = ("missing", "folder", "loop", "dangling", "empty", "unreadable")

_TOKEN = re.compile(rb'[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|"[^"\n]*"|[A-Za-z_][\w.-]*')
_TEXT = frozenset({".txt", ".xml", ".json", ".yaml", ".yml", ".obj", ".csv", ".jsonl", ".freiburg", ""})


def _with_middle(array: np.ndarray, value: float) -> np.ndarray:
    changed = np.array(array, np.float32 if array.ndim > 1 and abs(value) < 1e39 else np.float64)
    changed.reshape(-1)[changed.size // 2 : changed.size // 2 + 1] = value
    return changed


def _encoded(text: str, times: int) -> bytes:
    return (text * times).encode("utf-8", "surrogatepass")


def _token(data: bytes, index: int, text: str, times: int = 1) -> bytes:
    found = list(_TOKEN.finditer(data))
    token = found[index % len(found)]
    return data[: token.start()] + _encoded(text, times) + data[token.end() :]


def _header_token(data: bytes, index: int, text: str, times: int = 1) -> bytes:
    """Replace a token of the text that a binary file begins with; lengths that follow from it are made right."""
    if data[:4] == b"glTF":
        length = struct.unpack_from("<I", data, 12)[0]
        header = _token(data[20 : 20 + length], index, text, times)
        header += b" " * (-len(header) % 4)
        rest = data[20 + length :]
        return struct.pack("<4sIIII", b"glTF", 2, 20 + len(header) + len(rest), len(header), 0x4E4F534A) + header + rest
    if data[:3] == b"ply":
        end = data.find(b"end_header")
        return _token(data[:end], index, text, times) + data[end:]
    length = struct.unpack_from("<Q", data)[0]  # safetensors
    header = _token(data[8 : 8 + length], index, text, times)
    return struct.pack("<Q", len(header)) + header + data[8 + length :]


def _line(data: bytes, index: int, how: str) -> bytes:
    lines = data.splitlines(keepends=True)
    at = index % len(lines)
    line = lines[at]
    lines[at : at + 1] = {"drop": [], "double": [line] * 2, "indent": [b"  " + line], "many": [line] * 3000}[how]
    return b"".join(lines)


def _json(data: bytes, path: list[Any], text: str | None, times: int = 1) -> bytes:
    """Replace a value of a JSON file by other text, or delete it."""
    place = content = json.loads(data)
    for key in path[:-1]:
        place = place[key]
    if text is None:
        del place[path[-1]]
        return json.dumps(content).encode()
    place[path[-1]] = mark = "@@here@@"
    return json.dumps(content).replace(json.dumps(mark), text * times).encode("utf-8", "surrogatepass")


def _npz(data: bytes, index: int, how: str) -> bytes:
    made = io.BytesIO()
    if data[:6] == b"\x93NUMPY":
        np.save(made, ARRAYS[how](np.load(io.BytesIO(data))))
        return made.getvalue()
    arrays = dict(np.load(io.BytesIO(data)))
    name = sorted(arrays)[index % len(arrays)]
    if how == "bomb":
        with zipfile.ZipFile(made, "w", zipfile.ZIP_DEFLATED) as archive, archive.open(f"{name}.npy", "w") as file:
            header = {"descr": "|u1", "fortran_order": False, "shape": (720_000_000,)}
            np.lib.format.write_array_header_1_0(file, header)
            for _ in range(180):
                file.write(bytes(4_000_000))
        return made.getvalue()
    array = arrays.pop(name)
    if how != "missing":
        arrays["../" + name if how == "renamed" else name] = array if how == "renamed" else ARRAYS[how](array)
    np.savez(made, **arrays)
    return made.getvalue()


def _png_size(data: bytes, width: int, height: int) -> bytes:
    """A PNG whose header says another size, with a right checksum."""
    if data[:4] != b"\x89PNG":
        return data
    header = b"IHDR" + struct.pack(">II", width, height) + data[24:29]
    return data[:12] + header + struct.pack(">I", zlib.crc32(header)) + data[33:]


def _image(data: bytes, how: str) -> bytes:
    suffix, change = IMAGES[how]
    pixels = change(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED))
    own = ".png" if data.startswith(b"\x89PNG") else ".tiff"
    return bytes(cv2.imencode(suffix or own, np.ascontiguousarray(pixels))[1])


EDITS: dict[str, Callable[..., bytes]] = {
    "write": lambda data, at, hex: data[:at] + bytes.fromhex(hex) + data[at + len(hex) // 2 :],
    "cut": lambda data, at: data[:at],
    "drop": lambda data, at, count: data[:at] + data[at + count :],
    "splice": lambda data, at, source, count: data[:at] + data[source : source + count] + data[at + count :],
    "insert": lambda data, at, text, times=1: data[:at] + _encoded(text, times) + data[at:],
    "token": _token,
    "header": _header_token,
    "line": _line,
    "json": _json,
    "npz": _npz,
    "png-size": _png_size,
    "image": _image,
}


def apply(folder: Path, edit: Edit) -> None:
    """Damage a file of a folder; others may share its content by hard links."""
    path = folder / edit["file"]
    options = {key: value for key, value in edit.items() if key not in ("file", "op")}
    if edit["op"] == "node":
        _replace(path, options["how"])
    elif path.is_file():
        data = path.read_bytes()
        options |= {key: options[key] % (len(data) or 1) for key in ("at", "source") if key in options}
        with suppress(Exception):  # it is of another form after the edits before
            data = EDITS[edit["op"]](data, **options)
        path.unlink()
        path.write_bytes(data)


def _replace(path: Path, how: str) -> None:
    shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
    if how == "folder":
        path.mkdir()
    elif how in ("loop", "dangling"):
        path.symlink_to(path.name if how == "loop" else "nowhere")
    elif how in ("empty", "unreadable"):
        path.write_bytes(b"")
        path.chmod(0 if how == "unreadable" else 0o600)


def edits(folder: Path, patterns: tuple[str, ...]) -> st.SearchStrategy[list[Edit]]:
    """One to three edits of files of a folder; every pattern is as likely as another."""
    groups = [sorted(path for path in folder.glob(pattern) if path.is_file()) for pattern in patterns]
    file = st.sampled_from([group for group in groups if group]).flatmap(st.sampled_from)
    return st.lists(file.flatmap(lambda path: _edit(str(path.relative_to(folder)), path)), min_size=1, max_size=3)


def _edit(name: str, path: Path) -> st.SearchStrategy[Edit]:
    """An edit of a file, of the kinds that its format has."""
    suffix = path.suffix.lower()
    numbers, counts = st.integers(0, 99_999), st.sampled_from((1, 2, 4, 8, 30, 100, 1000, 5000))
    places = numbers | st.integers(0, 400)  # headers are where a byte matters most
    texts = st.fixed_dictionaries({"text": st.sampled_from(HOSTILE)}) | st.sampled_from(
        [{"text": text, "times": times} for text, times in REPEATED]
    )

    def op(which: str, **options: st.SearchStrategy[Any]) -> st.SearchStrategy[Edit]:
        return st.fixed_dictionaries({"file": st.just(name), "op": st.just(which), **options})

    def with_text(which: str, **options: st.SearchStrategy[Any]) -> st.SearchStrategy[Edit]:
        return st.tuples(op(which, **options), texts).map(lambda parts: {**parts[0], **parts[1]})

    words = st.sampled_from(BYTES) | st.binary(min_size=1, max_size=4)
    kinds = [
        op("node", how=st.sampled_from(NODES)),
        op("write", at=places, hex=words.map(bytes.hex)) | op("cut", at=places),
        op("drop", at=places, count=counts) | op("splice", at=places, source=places, count=counts),
    ]
    if suffix in _TEXT:
        line = op("line", index=numbers, how=st.sampled_from(("drop", "double", "indent", "many")))
        kinds += [with_text("token", index=numbers)] * 3 + [line, with_text("insert", at=numbers)]
    with suppress(ValueError):
        paths = st.sampled_from(_json_paths(json.loads(path.read_bytes())) or [["x"]])
        kinds += [with_text("json", path=paths)] * 4 + [op("json", path=paths, text=st.none())]
    if suffix in (".npz", ".npy"):
        kinds += [op("npz", index=numbers, how=st.sampled_from([*ARRAYS, "missing", "renamed", "bomb"]))] * 3
    if suffix in (".png", ".tiff", ".tif", ".jpg"):
        sides = st.sampled_from((0, 1, 65, 4000, 20_000, 60_000, 2**31 - 1))
        kinds += [op("image", how=st.sampled_from(list(IMAGES))), op("png-size", width=sides, height=sides)]
    if suffix in (".ply", ".safetensors", ".glb"):
        kinds += [with_text("header", index=numbers)] * 3
    return st.one_of(kinds)


def _json_paths(value: Any) -> list[list[Any]]:
    """Where every value of a JSON file lies; of lists the first and the last entry."""
    if isinstance(value, dict):
        keys: list[Any] = sorted(value)
    else:
        keys = sorted({0, len(value) - 1}) if isinstance(value, list) and value else []
    return [path for key in keys for path in ([key], *([key, *rest] for rest in _json_paths(value[key])))]
