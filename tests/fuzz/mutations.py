"""Damage to files as strategies of hypothesis. Each edit is a small JSON object, so that a case can be stored.

An edit is ``{"file": NAME, "op": NAME, ...}`` with the arguments of one of :data:`EDITS`. Positions wrap around the
length of the file, so that an edit can be applied to any file. What pixels and arrays of another kind do is tested with
their readers.
"""

from __future__ import annotations

import json
import re
import shutil
import struct
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

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
#: Numbers that stretches of binary files are overwritten by, by their type.
NUMBERS = {
    "<d": (float("nan"), float("inf"), 1e308, -1e308, 1e38, 1e12, -1.0, 0.0),
    "<f": (float("nan"), float("inf"), 3e38, -3e38, 1e30, 1e8, -1.0, 0.0),
    "<Q": (1 << 63, 1 << 40, 1 << 31, 1 << 20, 0, (1 << 64) - 1),
    ">I": (0, 0x7FFFFFFF, 0xFFFFFFFF, 0x80),
}
BYTES = [struct.pack(form, value) for form, values in NUMBERS.items() for value in values]
#: What becomes of a file as a whole.
NODES = ("missing", "folder", "loop", "dangling", "empty", "unreadable")

_TOKEN = re.compile(rb'[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|"[^"\n]*"|[A-Za-z_][\w.-]*')
_TEXT = frozenset({".txt", ".xml", ".json", ".yaml", ".yml", ".obj", ".csv", ".jsonl", ".freiburg", ""})


def _encoded(text: str, times: int) -> bytes:
    return (text * times).encode("utf-8", "surrogatepass")


def _token(data: bytes, index: int, text: str, times: int = 1) -> bytes:
    tokens = list(_TOKEN.finditer(data))
    token = tokens[index % len(tokens)]
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


EDITS: dict[str, Callable[..., bytes]] = {
    "write": lambda data, at, hex: data[:at] + bytes.fromhex(hex) + data[at + len(hex) // 2 :],
    "cut": lambda data, at: data[:at],
    "splice": lambda data, at, source, count: data[:at] + data[source : source + count] + data[at + count :],
    "insert": lambda data, at, text, times=1: data[:at] + _encoded(text, times) + data[at:],
    "token": _token,
    "header": _header_token,
    "line": _line,
    "json": _json,
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
    suffix, numbers = path.suffix.lower(), st.integers(0, 99_999)
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
        op("splice", at=places, source=places, count=st.sampled_from((1, 4, 30, 1000))),
    ]
    if suffix in _TEXT:
        line = op("line", index=numbers, how=st.sampled_from(("drop", "double", "indent", "many")))
        kinds += [with_text("token", index=numbers)] * 3 + [line, with_text("insert", at=numbers)]
    with suppress(ValueError):
        paths = st.sampled_from(_json_paths(json.loads(path.read_bytes())) or [["x"]])
        kinds += [with_text("json", path=paths)] * 4 + [op("json", path=paths, text=st.none())]
    if suffix in (".ply", ".safetensors", ".glb"):
        kinds += [with_text("header", index=numbers)] * 3
    return st.one_of(kinds)


def _json_paths(value: Any) -> list[list[Any]]:
    """Paths of the values of a JSON file; of lists the first and the last entry."""
    if isinstance(value, dict):
        keys: list[Any] = sorted(value)
    else:
        keys = sorted({0, len(value) - 1}) if isinstance(value, list) and value else []
    return [path for key in keys for path in ([key], *([key, *rest] for rest in _json_paths(value[key])))]
