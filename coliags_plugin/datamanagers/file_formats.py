"""Reading of images, masks, depth files and ``transforms.json``; truncated files are errors."""

from __future__ import annotations

import io
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from threading import Lock
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float32, Shaped, UInt8
from typing_extensions import override

from coliags_plugin.core.arrays import read_array
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import decode_image, kind_of
from coliags_plugin.core.json_files import image_size, read_json, read_number
from coliags_plugin.core.libraries import decoder_messages
from coliags_plugin.core.scene_files import for_all, named_file, required_file
from coliags_plugin.core.text_files import unreadable
from coliags_plugin.geometry.lenses.models import FisheyeLens, Lens, OpenCVLens, PinholeLens
from coliags_plugin.geometry.poses import nerfstudio

# Images and masks


def read_gray(path: Path, bits: int, expected: str, floats: bool = False) -> Shaped[np.ndarray, "H W"]:
    """Read a one-channel image of 8 or 16 bits, as stored; ``expected`` is the kind of file, for errors.

    ``floats`` tells whether it may have real numbers instead.
    """
    image = decode_image(path)
    if floats and image.ndim == 2 and image.dtype.kind == "f":
        return image
    if image.dtype != np.dtype(f"uint{bits}") or image.ndim != 2:
        lost = image.dtype == np.uint8 and bits == 16
        raise InputError(
            f"{path} is {kind_of(image)}",
            expected,
            "Use the original file: 8 bits are too few steps of depth" if lost else "Convert it",
        )
    return image


def size_of(path: Path) -> tuple[int, int]:
    """Width and height of an image file, pixels."""
    height, width = decode_image(path).shape[:2]
    return width, height


def read_mask(path: Path, colored: bool = False) -> Bool[np.ndarray, "H W"]:
    """Read a mask of 8 or 16 bits: True where it is at least half as bright as white, and not transparent.

    Where all pixels are 0 or of one other value, that one is white, as in masks of 0 and 1. ``colored`` tells whether
    a mask of colours is taken by the brightest channel.
    """
    image = decode_image(path)
    expected = "a mask of 8 or 16 bits: one channel, or three equal ones"
    if image.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{path} is {kind_of(image)}", expected, "Convert it")
    channels = image[..., None] if image.ndim == 2 else image
    values = channels[..., :3].max(axis=2)
    if not colored and (channels[..., :3] != values[..., None]).any():
        raise InputError(f"{path} is a colour image", expected, "Convert it")
    if channels.shape[2] == 4:
        values = np.minimum(values, channels[..., 3])
    top = int(values.max())
    if ((values == 0) | (values == top)).all():
        return np.asarray(values > 0)
    white = 255 if top <= 255 else 65535
    if top <= white // 2:
        raise InputError(
            f"{path}: its values reach from {values.min()} to {top} of {white}",
            "black where pixels are ignored and white elsewhere, or 0 and one other value",
            "Write it anew, or brighter",
        )
    return np.asarray(values > white // 2)


def all_of(*masks: Bool[np.ndarray, "H W"] | None) -> Bool[np.ndarray, "H W"] | None:
    """Pixels that all of several masks of one size have; None without any mask."""
    present = [mask for mask in masks if mask is not None]
    return reduce(np.logical_and, present) if present else None


def resize_rgb(image: UInt8[np.ndarray, "H W *C"], width: int, height: int) -> UInt8[np.ndarray, "h w *C"]:
    """Resize a colour image, or one channel: area averaging to downscale, bilinear to upscale."""
    if image.shape[:2] == (height, width):
        return image
    import cv2

    shrinks = width <= image.shape[1] and height <= image.shape[0]
    method = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, (width, height), interpolation=method))


def resize_nearest(values: Shaped[np.ndarray, "H W"], width: int, height: int) -> Shaped[np.ndarray, "h w"]:
    """Resize by nearest-neighbour sampling at pixel centres."""
    rows, columns = values.shape
    if (rows, columns) == (height, width):
        return values
    row = ((np.arange(height) + 0.5) * rows / height).astype(np.int64)
    column = ((np.arange(width) + 0.5) * columns / width).astype(np.int64)
    return np.ascontiguousarray(values[row[:, None], column[None, :]])


# Depth


class DepthFormat(ABC):
    """Interface of depth file formats. The stored value 0 means unknown in all of them; undistortion fills it in."""

    @abstractmethod
    def read(self, path: Path) -> Shaped[np.ndarray, "H W"]:
        """Read the stored values of a file."""

    @abstractmethod
    def decode(
        self, stored: Shaped[np.ndarray, "H W"]
    ) -> tuple[Float32[np.ndarray, "H W"], Float32[np.ndarray, "H W"] | None]:
        """Convert stored values to z-depth, scene units, NaN where unknown; and to its lower bound where it is clipped.

        The bound is NaN at pixels that are not clipped to the format's range, and None if none is.
        """


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
    def decode(
        self, stored: Shaped[np.ndarray, "H W"]
    ) -> tuple[Float32[np.ndarray, "H W"], Float32[np.ndarray, "H W"] | None]:
        with np.errstate(over="ignore"):
            depth = (stored * self.size).astype(np.float32)
        depth[~(np.isfinite(stored) & (stored > 0))] = np.nan
        if self.far is None or not (clipped := stored == self.far).any():
            return depth, None
        depth[clipped] = np.nan
        return depth, np.where(clipped, np.float32(self.far * self.size), np.float32(np.nan))


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
    def decode(self, stored: Shaped[np.ndarray, "H W"]) -> tuple[Float32[np.ndarray, "H W"], None]:
        is_known = stored > 0.0
        return np.where(is_known, stored / np.float32(self.divisor), np.float32(np.nan)).astype(np.float32), None


def read_exr_channel(path: Path, channel: str, do: str) -> Float32[np.ndarray, "H W"]:
    """Read a channel of an EXR file by its full name, from any part; what to ``do`` without it is for the error."""
    import OpenEXR

    required_file(path, "an OpenEXR file")
    try:
        with (
            _ALONE,
            redirect_stdout(io.StringIO()),  # OpenEXR prints warnings
            decoder_messages(),
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


# transforms.json

PixelCenters = Literal["half", "integer"]

#: nerfstudio's camera models and their distortion parameters; others must be 0 or absent.
_MODELS: Mapping[str, tuple[str, ...]] = {
    "OPENCV": ("k1", "k2", "k3", "p1", "p2"),
    "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
    "PINHOLE": (),
    "SIMPLE_PINHOLE": (),
}
_DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")


class Transforms:
    """Content of a ``transforms.json``, frames in natural order of their names; InputError if it is invalid.

    ``outside`` tells whether it may name files outside of its folder.
    """

    def __init__(self, path: Path, outside: bool = False) -> None:
        self.path, self._outside = path, outside
        self.trajectory = nerfstudio.read(path)
        self.names = self.trajectory.names_or_numbers()
        self.content: dict[str, Any] = read_json(path, "a transforms.json")
        frames = {frame["file_path"]: frame for frame in self.content["frames"]}
        self.frames: list[dict[str, Any]] = [frames[name] for name in self.names]

    def named(self, name: str) -> Path:
        """The path of a file that is named in it; it need not exist."""
        return named_file(self.path.parent, name, str(self.path), self._outside)

    def files(self, key: str, for_every: bool) -> Sequence[Path | None]:
        """The files that frames name under a key; if one does, all must where they are ``for_every`` frame."""
        paths: dict[str, Path | None] = {}
        for name, frame in zip(self.names, self.frames, strict=True):
            expected = f"the file of {key} of frame {name} in {self.path}"
            paths[name] = None if frame.get(key) is None else required_file(self.named(str(frame[key])), expected)
        return for_all(paths, self.path, f"a {key}") if for_every else list(paths.values())

    def lenses(self, pixel_centers: PixelCenters, stored_size: Callable[[], tuple[int, int]]) -> list[Lens]:
        """The cameras of all frames; arguments as for :func:`camera_of`."""
        return [
            camera_of({**self.content, **frame}, f"{self.path}, frame {name}", pixel_centers, stored_size)
            for name, frame in zip(self.names, self.frames, strict=True)
        ]


def camera_of(
    values: Mapping[str, Any], where: str, pixel_centers: PixelCenters, stored_size: Callable[[], tuple[int, int]]
) -> Lens:
    """The camera of one frame: a :class:`PinholeLens` where its images need no undistortion.

    ``values`` are the keys of the file, overlaid with those of the frame; ``where`` names the frame in messages.
    ``stored_size`` returns width and height of the image; it is called only if the file has no size.
    """
    model = values.get("camera_model") or ("OPENCV_FISHEYE" if values.get("is_fisheye") else "OPENCV")
    if not isinstance(model, str) or model not in _MODELS:
        raise InputError(f"{where}: camera_model is {model}", f"one of {', '.join(_MODELS)}")
    width, height = image_size(values, where) if "w" in values or "h" in values else stored_size()
    fx, fy = _focal_lengths(values, where, width, height)
    # The default principal point is the image centre in either convention.
    shift = 0.0 if pixel_centers == "half" else 0.5
    cx = read_number(values, "cx", where) + shift if "cx" in values else 0.5 * width
    cy = read_number(values, "cy", where) + shift if "cy" in values else 0.5 * height
    if min(fx, fy, width, height) <= 0.0:
        raise InputError(f"{where}: fl_x {fx:g}, fl_y {fy:g}, w {width}, h {height}", "numbers above 0")
    terms = {key: read_number(values, key, where) for key in _DISTORTION if values.get(key)}
    if wrong := sorted(set(terms) - set(_MODELS[model])):
        meaning = "nerfstudio and OpenCV mean different things by k4" if wrong == ["k4"] else "it has no such term"
        raise InputError(
            f"{where}: {model} with {wrong[0]} = {terms[wrong[0]]:g}; {meaning}",
            f"{', '.join(_MODELS[model]) or 'no distortion'} alone",
            "Undistort the images, or correct camera_model",
        )
    if model == "OPENCV_FISHEYE":
        k1, k2, k3, k4 = (terms.get(key, 0.0) for key in _MODELS[model])
        return FisheyeLens(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, k1=k1, k2=k2, k3=k3, k4=k4)
    if not terms:
        return PinholeLens(fx, fy, cx, cy, width, height)
    k1, k2, k3, p1, p2 = (terms.get(key, 0.0) for key in _MODELS[model])
    return OpenCVLens(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, k1=k1, k2=k2, p1=p1, p2=p2, k3=k3)


def _focal_lengths(values: Mapping[str, Any], where: str, width: int, height: int) -> tuple[float, float]:
    """Horizontal and vertical focal length, pixels; equal if only one is given."""
    lengths: dict[str, float] = {}
    for axis, pixels in (("x", width), ("y", height)):
        if f"fl_{axis}" in values:
            lengths[axis] = read_number(values, f"fl_{axis}", where)
        elif f"camera_angle_{axis}" in values:
            expected = "radians, above 0 and below pi"
            angle = read_number(values, f"camera_angle_{axis}", where, expected, above=0.0, below=math.pi)
            lengths[axis] = 0.5 * pixels / math.tan(0.5 * angle)
    if not lengths:
        raise InputError(f"{where}: neither fl_x nor camera_angle_x", "one of the two", "Add it")
    return lengths.get("x", lengths.get("y", 0.0)), lengths.get("y", lengths.get("x", 0.0))
