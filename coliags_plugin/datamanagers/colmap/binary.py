"""Checks the length of the binary files of a COLMAP model.

COLMAP's reader trusts every count in them: a truncated file makes it hang or crash the process (pycolmap 4.2.1), which
cannot be turned into an error message. So lengths are checked first.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

from coliags_plugin.core.errors import InputError

_POSE = 7 * 8
_SENSOR = 8


class _Cursor:
    """Position in a binary file, advanced past its records by reading only their counts."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    def skip(self, size: int) -> None:
        self.at += size
        if self.at > len(self.data):
            raise ValueError("cut short")

    def number(self, form: str) -> int:
        start = self.at
        self.skip(struct.calcsize(form))
        return int(struct.unpack_from(form, self.data, start)[0])

    def text(self) -> None:
        self.at = self.data.index(b"\0", self.at) + 1


def check_complete(folder: Path) -> None:
    """Refuse a binary model with a file that is shorter or longer than its counts require.

    Raises:
        InputError: A file is damaged; the message names it.
    """
    for name, skip_record in _FILES.items():
        path = folder / f"{name}.bin"
        if not path.is_file():
            continue
        try:
            cursor = _Cursor(path.read_bytes())
            for _ in range(cursor.number("<Q")):
                skip_record(cursor)
        except OSError as error:
            raise InputError(f"cannot read {path}: {error.strerror or error}", "a file of a COLMAP model") from error
        except ValueError as error:
            raise _damaged(path) from error
        if cursor.at != len(cursor.data):
            raise _damaged(path)


def _damaged(path: Path) -> InputError:
    size = path.stat().st_size
    return InputError(f"{path} ({size} bytes) is damaged or cut short", "a file written by COLMAP", "Copy it again")


def _camera(cursor: _Cursor) -> None:
    import pycolmap

    cursor.skip(4)
    model = cursor.number("<i")
    cursor.skip(2 * 8)
    cursor.skip(8 * len(pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId(model), 1.0, 1, 1).params))


def _image(cursor: _Cursor) -> None:
    cursor.skip(4 + _POSE + 4)
    cursor.text()
    cursor.skip(24 * cursor.number("<Q"))


def _point(cursor: _Cursor) -> None:
    cursor.skip(8 + 3 * 8 + 3 + 8)
    cursor.skip(8 * cursor.number("<Q"))


def _rig(cursor: _Cursor) -> None:
    cursor.skip(4)
    sensors = cursor.number("<I")
    if sensors:
        cursor.skip(_SENSOR)
    for _ in range(sensors - 1):
        cursor.skip(_SENSOR)
        if cursor.number("<B"):
            cursor.skip(_POSE)


def _frame(cursor: _Cursor) -> None:
    cursor.skip(4 + 4 + _POSE)
    cursor.skip((_SENSOR + 8) * cursor.number("<I"))


_FILES: dict[str, Callable[[_Cursor], None]] = {
    "cameras": _camera,
    "images": _image,
    "points3D": _point,
    "rigs": _rig,
    "frames": _frame,
}
