"""Formats of depth files: images, arrays and OpenEXR."""

from __future__ import annotations

import io
from abc import ABC, abstractmethod
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from threading import Lock

import numpy as np
from jaxtyping import Float32, Shaped
from typing_extensions import override

from coliags_plugin.core.arrays import read_array
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scene_files import required_file
from coliags_plugin.core.text_files import unreadable
from coliags_plugin.datamanagers.reading.images import read_gray


class DepthFormat(ABC):
    """Interface of depth file formats. The stored value 0 means unknown in all of them; undistortion fills it in."""

    @abstractmethod
    def read(self, path: Path) -> Shaped[np.ndarray, "H W"]:
        """Read the stored values of a file."""

    @abstractmethod
    def z_depth(self, stored: Shaped[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"]:
        """Convert stored values to z-depth, scene units; NaN where unknown."""

    def clipped_at(self, stored: Shaped[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"] | None:
        """Lower bound of z-depth at pixels clipped to the format's range, NaN elsewhere; None if none is clipped."""
        return None


@dataclass(frozen=True)
class ScaledDepth(DepthFormat):
    """Numbers proportional to z-depth, unknown where they are not finite and positive.

    Images of one channel of whole steps; without ``bits``, of 16 bits or real numbers, or ``.npy`` arrays [H, W] or
    [H, W, 1].
    """

    size: float  # scene units per step
    bits: int | None = None  # 8 or 16
    far: int | None = None  # stored value of depths clipped to the range; None where there is none

    @override
    def read(self, path: Path) -> Shaped[np.ndarray, "H W"]:
        if self.bits is not None or path.suffix.lower() != ".npy":
            bits, kind = self.bits or 16, "" if self.bits else ", or one of real numbers"
            return read_gray(path, bits, f"a one-channel {bits}-bit depth image{kind}", floats=self.bits is None)
        expected = "an .npy array [H, W] of real numbers"
        array = read_array(path, expected)
        if array.ndim == 3 and array.shape[2] == 1:
            array = array[..., 0]
        if array.ndim != 2 or not array.size or array.dtype.kind not in "fiu":
            raise InputError(f"{path} is an array {list(array.shape)} of {array.dtype}", expected)
        return np.asarray(array)

    @override
    def z_depth(self, stored: Shaped[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"]:
        with np.errstate(over="ignore"):
            depth = (stored * self.size).astype(np.float32)
        depth[~(np.isfinite(stored) & (stored > 0))] = np.nan
        if self.far is not None:
            depth[stored == self.far] = np.nan
        return depth

    @override
    def clipped_at(self, stored: Shaped[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"] | None:
        if self.far is None or not (clipped := stored == self.far).any():
            return None
        return np.where(clipped, np.float32(self.far * self.size), np.float32(np.nan))


#: C3VD's format: 16 bits for 100 mm, clipped beyond.
C3VD_DEPTH = ScaledDepth(100.0 / 65535.0, 16, 65535)


def scaled_depth(path: Path, size: float) -> ScaledDepth:
    """Format of a depth file, PNG, TIFF or .npy, whose stored unit is ``size`` scene units."""
    if path.suffix.lower() in (".npz", ".exr"):
        raise InputError(f"{path}: depth in {path.suffix}", "16-bit PNG or TIFF, TIFF of floats, or .npy", "Convert it")
    return ScaledDepth(size)


@dataclass(frozen=True)
class InverseDepth(ScaledDepth):
    """16-bit inverse depth of 3DGS: z-depth is size / (scale * value / 65536 + offset), unknown where not positive."""

    scale: float = 1.0
    offset: float = 0.0

    @override
    def read(self, path: Path) -> Shaped[np.ndarray, "H W"]:
        """Read z-depth in units of the model, float32, 0 where it is unknown. [H, W]"""
        stored = read_gray(path, 16, "a one-channel 16-bit depth image")
        with np.errstate(over="ignore"):
            inverse = self.scale * (stored / 65536.0) + self.offset
            # The sky, thousands of times as far as the rest, is at no distance.
            is_known = (inverse > max(0.0, 1e-4 * float(inverse.max()))) & (self.scale > 0.0)
            return np.where(is_known, 1.0 / np.where(is_known, inverse, 1.0), 0.0).astype(np.float32)


#: Stored EXR depth from this value on is background; Blender writes 1e10.
BACKGROUND = 1e6
#: EXR files are read one at a time, as what OpenEXR prints is diverted for all threads.
_ALONE = Lock()


@dataclass(frozen=True)
class ExrDepth(DepthFormat):
    """A channel proportional to z-depth; unknown where not finite, not positive or at least :data:`BACKGROUND`."""

    channel: str
    divisor: float = 1.0  # from stored values to scene units

    @override
    def read(self, path: Path) -> Shaped[np.ndarray, "H W"]:
        stored = read_exr_channel(path, self.channel, "Choose the one of depth: `datamanager.depth_channel=NAME`")
        is_known = np.isfinite(stored) & (stored > 0.0) & (stored < BACKGROUND)
        return np.where(is_known, stored, np.float32(0.0))

    @override
    def z_depth(self, stored: Shaped[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"]:
        return np.where(stored > 0.0, stored / np.float32(self.divisor), np.float32(np.nan)).astype(np.float32)


def read_exr_channel(path: Path, channel: str, do: str) -> Float32[np.ndarray, "H W"]:
    """Read a channel of an EXR file by its full name, from any part; what to ``do`` without it is for the error."""
    import OpenEXR

    required_file(path, "an OpenEXR file")
    try:
        with (
            _ALONE,
            redirect_stdout(io.StringIO()),  # OpenEXR prints warnings
            OpenEXR.File(str(path), separate_channels=True) as file,
        ):
            # OpenEXR returns no parts for a damaged file.
            channels = {name: stored.pixels for part in file.parts for name, stored in part.channels.items()}
            if not channels:
                raise ValueError("no channels")
    except (OSError, RuntimeError, ValueError) as error:
        raise unreadable(
            path,
            f"{path} ({path.stat().st_size} bytes) cannot be decoded",
            "a complete OpenEXR file",
            "It is damaged or cut short: fetch it again",
        ) from error
    if channel not in channels:
        raise InputError(f"{path} has the channels {', '.join(sorted(channels))}", f"a channel {channel}", do)
    return np.asarray(channels[channel]).astype(np.float32)
