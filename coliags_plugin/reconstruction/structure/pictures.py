"""Pictures that have no poses yet."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, UInt8

from coliags_plugin.core.errors import InputError
from coliags_plugin.poses.trajectory import natural_order

#: What a picture's file may be called, in lower case.
PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")

_FFMPEG = "make pictures with ffmpeg -i VIDEO -vf fps=10 FOLDER/%05d.png"


def pictures_of(folder: Path) -> list[Path]:
    """The pictures of a folder as people count: 2 before 10.

    Raises:
        InputError: There is no such folder, or it holds fewer than two.
    """
    if folder.is_file():
        raise InputError(f"{folder} is a file", "a folder of pictures", f"{_FFMPEG}, if it is a video")
    if not folder.is_dir():
        raise InputError(f"no folder {folder}", "a folder of pictures", "Check the path")
    found = [path for path in folder.iterdir() if path.suffix.lower() in PICTURE_SUFFIXES and path.is_file()]
    if len(found) < 2:
        raise InputError(
            f"{folder} holds {len(found)} pictures",
            f"two at least ({', '.join(PICTURE_SUFFIXES)})",
            f"Give the folder of the frames themselves; from a video, {_FFMPEG}",
        )
    return [found[index] for index in natural_order([path.name for path in found])]


def read_picture(path: Path) -> UInt8[np.ndarray, "H W 3"]:
    """A picture in RGB; whatever else it was is converted.

    Raises:
        InputError: It cannot be read.
    """
    import cv2

    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}", "a readable picture") from error
    # The pixels as they lie in the file: COLMAP's cameras know nothing of a turned display.
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    if image is None:
        raise InputError(f"{path} ({len(data)} bytes) cannot be decoded", "a whole picture", "Fetch it again")
    return np.ascontiguousarray(image[..., ::-1])


def read_mask(path: Path) -> Bool[np.ndarray, "H W"]:
    """A mask: True where the picture is not black.

    Raises:
        InputError: It cannot be read.
    """
    return np.asarray(read_picture(path).max(axis=2) > 0)


def file_names(names: Sequence[str], suffix: str) -> list[str]:
    """File names for frames that sort as the frames do; a number goes before them where their own would not."""
    plain = [name.replace("/", "-") for name in names]
    if natural_order(plain) != list(range(len(plain))) or len(set(plain)) < len(plain):
        plain = [f"{index:05d}_{name}" for index, name in enumerate(plain)]
    return [f"{name}{suffix}" for name in plain]
