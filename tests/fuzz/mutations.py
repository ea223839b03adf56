"""Mutations of files: each is a small JSON object, so that a case can be stored and repeated.

An edit is ``{"file": NAME, "op": NAME, ...}`` with the arguments of one of :data:`EDITS`. Positions count from the
start of the file and wrap around its length, so that an edit can be applied to any file.
"""

from __future__ import annotations

import io
import json
import re
import shutil
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

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
ARRAYS = ("nan", "inf", "1e308", "1e30", "zeros", "negative", "text", "empty", "flat", "transposed", "first", "complex")
#: What images become.
IMAGES = (
    *("gray", "rgba", "16-bit", "half", "pixel", "strip", "float", "nan", "1e38", "inf", "negative", "black", "jpeg"),
)
#: What becomes of a file as a whole.
NODES = ("missing", "folder", "loop", "dangling", "empty", "unreadable")

#: Words of a text that :func:`single` replaces.
_WORDS = 40
_TOKEN = re.compile(rb'[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|"[^"\n]*"|[A-Za-z_][\w.-]*')
_TEXT = frozenset({".txt", ".xml", ".json", ".yaml", ".yml", ".obj", ".csv", ".jsonl", ".freiburg", ""})
_IMAGE = frozenset({".png", ".tiff", ".tif", ".jpg"})
_HEADERS = frozenset({".ply", ".safetensors", ".glb"})


# Edits of bytes


def _flip(data: bytes, at: int, bit: int) -> bytes:
    changed = bytearray(data)
    if changed:
        changed[at] ^= 1 << bit
    return bytes(changed)


def _write(data: bytes, at: int, hex: str) -> bytes:
    new = bytes.fromhex(hex)
    return (data[:at] + new + data[at + len(new) :])[: max(len(data), len(new))]


def _insert(data: bytes, at: int, text: str, times: int = 1) -> bytes:
    return data[:at] + (text * times).encode("utf-8", "surrogatepass") + data[at:]


def _token(data: bytes, index: int, text: str, times: int = 1) -> bytes:
    found = list(_TOKEN.finditer(data))
    if not found:
        return data
    token = found[index % len(found)]
    return data[: token.start()] + (text * times).encode("utf-8", "surrogatepass") + data[token.end() :]


def _header_token(data: bytes, index: int, text: str, times: int = 1) -> bytes:
    """Replace a token of the text that a binary file begins with; lengths that follow from it are made right."""
    new = (text * times).encode("utf-8", "surrogatepass")
    if data[:4] == b"glTF":
        length = min(struct.unpack_from("<I", data, 12)[0], len(data))
        header = _token(data[20 : 20 + length], index, text, times).ljust(-(-length // 4) * 4)
        header += b" " * (-len(header) % 4)
        rest = data[20 + length :]
        return struct.pack("<4sIIII", b"glTF", 2, 20 + len(header) + len(rest), len(header), 0x4E4F534A) + header + rest
    if data[:3] == b"ply":
        end = data.find(b"end_header")
        return _token(data[:end], index, text, times) + data[end:]
    if len(data) > 8 and data[8:9] == b"{":
        length = struct.unpack_from("<Q", data)[0]
        header = _token(data[8 : 8 + length], index, text, times)
        return struct.pack("<Q", len(header)) + header + data[8 + length :]
    return data[: len(data) // 2] + new + data[len(data) // 2 :]


def _line(data: bytes, index: int, how: str) -> bytes:
    lines = data.splitlines(keepends=True)
    if not lines:
        return data
    at = index % len(lines)
    if how == "drop":
        del lines[at]
    elif how == "double":
        lines.insert(at, lines[at])
    elif how == "indent":
        lines[at] = b"  " + lines[at]
    elif how == "many":
        lines[at:at] = [lines[at]] * 3000
    else:
        lines.insert(0, lines.pop(at))
    return b"".join(lines)


def _json(data: bytes, path: list[Any], text: str | None, times: int = 1) -> bytes:
    """Replace a value of a JSON file by other text, or delete it, or (``text`` = "twice") give its key twice."""
    mark = "@@here@@"
    try:
        content = json.loads(data)
        place = content
        for key in path[:-1]:
            place = place[key]
        value = place[path[-1]]
        if text is None:
            del place[path[-1]]
            return json.dumps(content).encode()
        place[path[-1]] = mark
    except (ValueError, LookupError, TypeError):
        return data
    if text == "twice":
        text = f"{json.dumps(value)}, {json.dumps(str(path[-1]))}: {json.dumps(value)}"
    return json.dumps(content).replace(json.dumps(mark), text * times).encode("utf-8", "surrogatepass")


def _yaml_bomb(data: bytes) -> bytes:
    lines = ["a0: &a0 [x, x]"] + [f"a{level}: &a{level} [*a{level - 1}, *a{level - 1}]" for level in range(1, 40)]
    return data + "\n".join(["", *lines, ""]).encode()


def _array(array: np.ndarray, how: str) -> np.ndarray:
    if how in ("nan", "inf", "1e308", "1e30", "negative", "zeros"):
        changed = array.astype(np.float64) if array.dtype.kind in "fiub" else np.zeros(array.shape)
        if changed.size:
            flat = changed.reshape(-1)
            value = {"negative": -1.0, "zeros": 0.0}.get(how)
            flat[flat.size // 2] = float(how) if value is None else value
            if how in ("negative", "zeros"):
                flat[:] = value
        return changed
    if how == "text":
        return np.full(array.shape, "x")
    if how == "complex":
        return np.zeros(array.shape, np.complex128)
    if how == "empty":
        return array[..., :0] if array.ndim else np.zeros(0)
    if how == "flat":
        return array.reshape(-1)
    return array.T if how == "transposed" else np.atleast_1d(array)[0]


def _npz(data: bytes, index: int, how: str) -> bytes:
    try:
        if data[:6] == b"\x93NUMPY":
            made = io.BytesIO()
            np.save(made, _array(np.load(io.BytesIO(data)), how))
            return made.getvalue()
        with np.load(io.BytesIO(data)) as stored:
            arrays = dict(stored)
        name = sorted(arrays)[index % len(arrays)]
        if how == "missing":
            del arrays[name]
        elif how == "renamed":
            arrays["../" + name] = arrays.pop(name)
        elif how == "bomb":
            made = io.BytesIO()
            with zipfile.ZipFile(made, "w", zipfile.ZIP_DEFLATED) as archive, archive.open(f"{name}.npy", "w") as file:
                file.write(b"\x93NUMPY\x01\x00v\x00{'descr': '|u1', 'fortran_order': False, 'shape': (720000000,), }")
                file.write(b" " * 42 + b"\n")
                for _ in range(180):
                    file.write(bytes(4_000_000))
            return made.getvalue()
        else:
            arrays[name] = _array(arrays[name], how)
    except (ValueError, OSError, zipfile.BadZipFile):
        return data
    made = io.BytesIO()
    np.savez(made, **arrays)
    return made.getvalue()


def _png_size(data: bytes, width: int, height: int) -> bytes:
    """A PNG whose header says another size, with a right checksum."""
    if data[:4] != b"\x89PNG":
        return data
    header = b"IHDR" + struct.pack(">II", width, height) + data[24:29]
    return data[:12] + header + struct.pack(">I", zlib.crc32(header)) + data[33:]


def _decoded(data: bytes) -> Any:
    """Pixels of an image; None where it is damaged."""
    import cv2
    import PIL.Image

    if data.startswith(b"\x89PNG"):
        try:  # OpenCV allocates what a damaged length says
            PIL.Image.open(io.BytesIO(data)).load()
        except Exception:
            return None
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)


#: Pixels of another kind.
_PIXELS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "gray": lambda pixels: pixels[..., 0] if pixels.ndim == 3 else np.dstack([pixels] * 3),
    "rgba": lambda pixels: np.dstack([*_channels(pixels)[:3], _channels(pixels)[0]]),
    "16-bit": lambda pixels: (
        pixels.astype(np.uint16) if pixels.dtype == np.uint8 else (pixels.astype(np.float64) % 256).astype(np.uint8)
    ),
    "half": lambda pixels: pixels[::2, ::2],
    "pixel": lambda pixels: pixels[:1, :1],
    "strip": lambda pixels: pixels[:1],
    "black": np.zeros_like,
    "jpeg": lambda pixels: np.clip(pixels, 0, 255).astype(np.uint8),
    "float": lambda pixels: pixels.astype(np.float32),
}


def _channels(pixels: np.ndarray) -> list[np.ndarray]:
    """The channels, of which one stands for three."""
    return list(np.moveaxis(pixels, 2, 0)) if pixels.ndim == 3 else [pixels] * 3


def _image(data: bytes, how: str) -> bytes:
    import cv2

    pixels = _decoded(data)
    if pixels is None:
        return data
    if how in _PIXELS:
        suffix = {"jpeg": ".jpg", "float": ".tiff"}.get(how, ".tiff" if data[:2] in (b"II", b"MM") else ".png")
        pixels = _PIXELS[how](pixels)
    else:
        suffix, pixels, middle = ".tiff", pixels.astype(np.float32), pixels.shape[0] // 2
        pixels[middle] = -pixels[middle] if how == "negative" else float(how)
    try:
        return bytes(cv2.imencode(suffix, np.ascontiguousarray(pixels))[1])
    except cv2.error:
        return data


EDITS: dict[str, Callable[..., bytes]] = {
    "flip": _flip,
    "write": _write,
    "cut": lambda data, at: data[:at],
    "drop": lambda data, at, count: data[:at] + data[at + count :],
    "double": lambda data, at, count: data[: at + count] + data[at:],
    "splice": lambda data, at, source, count: data[:at] + data[source : source + count] + data[at + count :],
    "insert": _insert,
    "token": _token,
    "header": _header_token,
    "line": _line,
    "json": _json,
    "yaml-bomb": _yaml_bomb,
    "npz": _npz,
    "png-size": _png_size,
    "image": _image,
}


def apply(folder: Path, edit: Edit) -> None:
    """Spoil a file of a folder; others may share its content by hard links."""
    path = folder / edit["file"]
    options = {key: value for key, value in edit.items() if key not in ("file", "op")}
    if edit["op"] == "node":
        _node(path, options["how"])
    elif path.is_file():
        data = path.read_bytes()
        places = len(data) + 1 if edit["op"] == "insert" else len(data) or 1
        options |= {key: options[key] % places for key in ("at", "source") if key in options}
        with suppress(Exception):  # it is of another form after the edits before
            data = EDITS[edit["op"]](data, **options)
        path.unlink()
        path.write_bytes(data)


def _node(path: Path, how: str) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
    if how == "folder":
        path.mkdir()
    elif how in ("loop", "dangling"):
        path.symlink_to(path.name if how == "loop" else "nowhere")
    elif how in ("empty", "unreadable"):
        path.write_bytes(b"")
        if how == "unreadable":
            path.chmod(0)


# Drawing


def draw(files: dict[str, int], folder: Path, random: Random) -> list[Edit]:
    """One to three edits of files of a folder.

    Args:
        files: How likely each is, by its name.
        folder: Where they are.
        random: Decides everything.
    """
    names = random.choices(list(files), list(files.values()), k=random.choice((1, 1, 1, 2, 3)))
    return [_drawn(name, (folder / name).read_bytes(), random) for name in names]


def _drawn(name: str, data: bytes, random: Random) -> Edit:
    suffix = Path(name).suffix.lower()
    if random.random() < 0.04:
        return {"file": name, "op": "node", "how": random.choice(NODES)}
    kinds: list[Callable[[bytes, Random], Edit]] = [_random_bytes]
    if suffix in _TEXT:
        kinds += [_random_text] * 4
    if suffix == ".json" or (suffix == "" and data[:1] == b"{"):
        kinds += [_random_json] * 4
    if suffix in (".yaml", ".yml") and random.random() < 0.05:
        return {"file": name, "op": "yaml-bomb"}
    if suffix in (".npz", ".npy"):
        kinds += [_random_array] * 2
    if suffix in _IMAGE:
        kinds += [_random_image]
    if suffix in _HEADERS:
        kinds += [_random_header] * 2
    return {"file": name, **random.choice(kinds)(data, random)}


def single(name: str, data: bytes) -> Iterator[Edit]:
    """Every edit of one value of a file: of JSON every key (of lists the first and the last entry), of other texts some
    words from the first to the last, of archives every array, of images every kind; and every edit of the file as such.

    Args:
        name: Of the file.
        data: Its content.
    """
    suffix, edits = Path(name).suffix.lower(), list[Edit]()
    texts = [{"text": text} for text in HOSTILE] + [{"text": text, "times": times} for text, times in REPEATED]
    with suppress(ValueError):
        if suffix == ".json" or (suffix == "" and data[:1] == b"{"):
            paths = _json_paths(json.loads(data))
            edits += [{"op": "json", "path": path, **text} for path in paths for text in (*texts, {"text": None})]
    if suffix in _TEXT and not edits:
        words = len(_TOKEN.findall(data))
        chosen = sorted({index * (words - 1) // (_WORDS - 1) for index in range(_WORDS)}) if words else []
        edits += [{"op": "token", "index": index, **text} for index in chosen for text in texts]
    if suffix in (".npz", ".npy"):
        count = len(zipfile.ZipFile(io.BytesIO(data)).namelist()) if suffix == ".npz" else 1
        edits += [{"op": "npz", "index": index, "how": how} for index in range(count) for how in (*ARRAYS, "missing")]
    if suffix in _IMAGE:
        edits += [{"op": "image", "how": how} for how in IMAGES]
    for edit in (*edits, *({"op": "node", "how": how} for how in NODES)):
        yield {"file": name, **edit}


def _json_paths(value: Any) -> list[list[Any]]:
    """Where every value of a JSON file lies; of lists of the first and the last entry."""
    if isinstance(value, dict):
        keys: list[Any] = sorted(value)
    else:
        keys = sorted({0, len(value) - 1}) if isinstance(value, list) and value else []
    return [path for key in keys for path in ([key], *([key, *rest] for rest in _json_paths(value[key])))]


def _random_bytes(data: bytes, random: Random) -> Edit:
    size = max(len(data), 1)
    # Headers are where a byte matters most.
    at = random.randrange(size) if random.random() < 0.5 else random.randrange(min(size, 400))
    count = random.choice((1, 2, 4, 8, 30, 100, 1000, 5000))
    op = random.choice(("flip", "write", "write", "write", "cut", "drop", "double", "splice"))
    if op == "write":
        new = random.choice((*BYTES, random.randbytes(4), bytes(count)))
        return {"op": op, "at": at - at % 4 if random.random() < 0.7 else at, "hex": new.hex()}
    if op == "flip":
        return {"op": op, "at": at, "bit": random.randrange(8)}
    more = {"source": random.randrange(size)} if op == "splice" else {}
    return {"op": op, "at": at, **more, **({} if op == "cut" else {"count": count})}


def _text(random: Random) -> dict[str, Any]:
    if random.random() < 0.1:
        text, times = random.choice(REPEATED)
        return {"text": text, "times": times}
    return {"text": random.choice(HOSTILE)}


def _random_text(data: bytes, random: Random) -> Edit:
    op = random.choice(("token", "token", "token", "token", "line", "insert"))
    if op == "token":
        return {"op": op, "index": random.randrange(100_000), **_text(random)}
    if op == "line":
        how = random.choice(("drop", "double", "indent", "first", "many"))
        return {"op": op, "index": random.randrange(100_000), "how": how}
    return {"op": op, "at": random.randrange(len(data) + 1), **_text(random)}


def _random_header(data: bytes, random: Random) -> Edit:
    return {"op": "header", "index": random.randrange(1000), **_text(random)}


def _random_json(data: bytes, random: Random) -> Edit:
    try:
        place, path = json.loads(data), []
    except ValueError:
        return _random_text(data, random)
    while isinstance(place, (dict, list)) and place and (not path or random.random() < 0.85):
        key = random.choice(sorted(place)) if isinstance(place, dict) else random.randrange(len(place))
        path.append(key)
        place = place[key]
    chosen = random.choice((None, "twice")) if random.random() < 0.1 else ""
    return {"op": "json", "path": path, **({"text": chosen} if chosen != "" else _text(random))}


def _random_array(data: bytes, random: Random) -> Edit:
    how = random.choice((*ARRAYS, "missing", "renamed") * 4 + ("bomb",))
    return {"op": "npz", "index": random.randrange(100), "how": how}


def _random_image(data: bytes, random: Random) -> Edit:
    if random.random() < 0.3:
        sizes = (0, 1, 65, 4000, 20_000, 60_000, 2**31 - 1)
        return {"op": "png-size", "width": random.choice(sizes), "height": random.choice(sizes)}
    return {"op": "image", "how": random.choice(IMAGES)}
