"""Whether the binary files of a COLMAP model are whole.

COLMAP's own reader believes every count in them: a file cut short makes it run away or take the whole process down
(pycolmap 4.2.1), which could not be turned into a message. So lengths are checked before it is let in.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

from coliags_plugin.core.errors import InputError

_POSE = 7 * 8
_SENSOR = 8


class _Walk:
    """Goes through a file without looking at more than its counts."""

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


def check_whole(folder: Path) -> None:
    """Refuse a binary model with a file that is cut short or longer than it says.

    Raises:
        InputError: Naming the file.
    """
    for name, walk_one in _FILES.items():
        path = folder / f"{name}.bin"
        if not path.is_file():
            continue
        try:
            walk = _Walk(path.read_bytes())
            for _ in range(walk.number("<Q")):
                walk_one(walk)
        except OSError as error:
            raise InputError(f"cannot read {path}: {error.strerror or error}", "a file of a COLMAP model") from error
        except ValueError as error:
            raise _damaged(path) from error
        if walk.at != len(walk.data):
            raise _damaged(path)


def _damaged(path: Path) -> InputError:
    size = path.stat().st_size
    return InputError(f"{path} ({size} bytes) is damaged or cut short", "a file written by COLMAP", "Copy it again")


def _camera(walk: _Walk) -> None:
    import pycolmap

    walk.skip(4)
    model = walk.number("<i")
    walk.skip(2 * 8)
    walk.skip(8 * len(pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId(model), 1.0, 1, 1).params))


def _image(walk: _Walk) -> None:
    walk.skip(4 + _POSE + 4)
    walk.text()
    walk.skip(24 * walk.number("<Q"))


def _point(walk: _Walk) -> None:
    walk.skip(8 + 3 * 8 + 3 + 8)
    walk.skip(8 * walk.number("<Q"))


def _rig(walk: _Walk) -> None:
    walk.skip(4)
    sensors = walk.number("<I")
    if sensors:
        walk.skip(_SENSOR)
    for _ in range(sensors - 1):
        walk.skip(_SENSOR)
        if walk.number("<B"):
            walk.skip(_POSE)


def _frame(walk: _Walk) -> None:
    walk.skip(4 + 4 + _POSE)
    walk.skip((_SENSOR + 8) * walk.number("<I"))


_FILES: dict[str, Callable[[_Walk], None]] = {
    "cameras": _camera,
    "images": _image,
    "points3D": _point,
    "rigs": _rig,
    "frames": _frame,
}
