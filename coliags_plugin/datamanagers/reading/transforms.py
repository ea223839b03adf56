"""Reading of ``transforms.json``: poses, cameras, and files that frames name."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.json_files import image_size, read_json, read_number
from coliags_plugin.core.scene_files import for_all, named_file, required_file
from coliags_plugin.geometry.lenses.models import FisheyeLens, Lens, OpenCVLens, PinholeLens
from coliags_plugin.geometry.poses import nerfstudio

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
