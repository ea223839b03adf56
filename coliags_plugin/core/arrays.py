"""Reading NPZ and NPY files of unknown origin, without pickle; dilation and erosion of masks."""

from __future__ import annotations

import tokenize
import zipfile
import zlib
from collections.abc import Collection
from pathlib import Path
from threading import Lock

import numpy as np
from jaxtyping import Bool

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.text_files import unreadable

#: NumPy reads headers as Python literals, and CPython 3.11 fails now and then ("AST constructor recursion depth
#: mismatch") where two threads do so at once.
_HEADERS = Lock()
#: What an archive may always expand to, bytes.
_SMALL = 64 << 20
#: How many times its size a larger one may. Depth and points compress to a half or a tenth.
_RATIO = 50
#: What NumPy and zipfile raise on damaged files.
_DAMAGED = (
    OSError,
    ValueError,
    EOFError,
    KeyError,
    TypeError,
    NotImplementedError,
    RuntimeError,
    SyntaxError,
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
)


def read_arrays(
    path: Path, expected: str, needed: Collection[str] = (), optional: Collection[str] | None = ()
) -> dict[str, np.ndarray]:
    """Read arrays of an NPZ file by name: those needed, and of the optional ones (None: all) what is there.

    Refused are damaged files, other than plain arrays, and what expands to far more than its size.
    """
    try:
        packed = path.stat().st_size
        with zipfile.ZipFile(path) as archive:
            unpacked = sum(entry.file_size for entry in archive.infolist())
        if unpacked > max(_SMALL, _RATIO * packed):
            raise InputError(f"{path} has {packed:,} bytes and expands to {unpacked:,}", expected, "It is no such data")
        with _HEADERS, np.load(path, allow_pickle=False) as archive:
            names = archive.files if optional is None else {*needed, *optional}
            arrays = {name: archive[name] for name in archive.files if name in names}
    except _DAMAGED as error:
        raise unreadable(path, f"cannot read {path}: {error}", expected) from error
    for name, array in arrays.items():
        if not isinstance(array, np.ndarray):  # an entry of the archive that is no array
            raise InputError(f"{path} holds '{name}', which is no array", expected)
    missing = [name for name in needed if name not in arrays]
    if missing:
        raise InputError(f"{path} lacks {', '.join(missing)}", expected)
    return arrays


def read_array(path: Path, expected: str) -> np.ndarray:
    """Read the array of an NPY file."""
    try:
        # Mapped first: numpy would reserve what the header says, whatever follows.
        with _HEADERS:
            mapped = np.load(path, mmap_mode="r", allow_pickle=False)
        return np.array(mapped)
    except _DAMAGED as error:
        raise unreadable(path, f"cannot read {path}: {error}", expected, "Write it again") from error


def dilated(mask: Bool[np.ndarray, "H W"], reach: int) -> Bool[np.ndarray, "H W"]:
    """The mask with all pixels within ``reach`` rows and columns of it. [H, W]"""
    from skimage.morphology import dilation

    return np.asarray(dilation(mask.astype(np.uint8), _square(reach), mode="ignore")).astype(bool)


def eroded(mask: Bool[np.ndarray, "H W"], reach: int) -> Bool[np.ndarray, "H W"]:
    """The mask without the pixels within ``reach`` rows and columns of its complement. [H, W]"""
    from skimage.morphology import erosion

    return np.asarray(erosion(mask.astype(np.uint8), _square(reach), mode="ignore")).astype(bool)


def _square(reach: int) -> tuple[tuple[np.ndarray, int], ...]:
    """The square footprint as a column and a row, which together cost far less."""
    from skimage.morphology import footprint_rectangle

    footprint: tuple[tuple[np.ndarray, int], ...] = footprint_rectangle(
        (2 * reach + 1, 2 * reach + 1), decomposition="separable"
    )
    return footprint
