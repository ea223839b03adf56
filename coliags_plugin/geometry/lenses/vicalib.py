"""Vicalib's calibration files, XML with a Kannala-Brandt lens, as the EndoMapper dataset has them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from coliags_plugin.core import bounds
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.text_files import read_text, whole_text
from coliags_plugin.geometry.lenses.models import FisheyeLens

SUFFIX = ".xml"
#: Name of the camera model: focal lengths, principal point and four terms of Kannala-Brandt.
TYPE = "calibu_fu_fv_u0_v0_kb4"
_EXPECTED = f'a <camera_model type="{TYPE}"> with width, height and eight params'
_CENTER = 0.5  # the files count pixel centres at integers (docs/layouts/endomapper.md 2)


@dataclass(frozen=True)
class Calibration:
    """Contents of a calibration file."""

    path: Path
    lens: FisheyeLens  # at the calibrated size
    depth_scale: float | None = None  # depth steps per scene unit, in scenes with depth; None: not given


def read_calibration(path: Path) -> Calibration:
    """Read a calibration file.

    Raises:
        InputError: It is missing or no such file, or has another camera model, or several cameras.
    """
    text = read_text(path, _EXPECTED)
    if "<!DOCTYPE" in text:
        raise InputError(f"{path} has a document type", _EXPECTED, "Remove the line <!DOCTYPE ...>")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise InputError(f"{path} is not XML: {error}", _EXPECTED, "Restore the whole file") from error
    calibrations = {_read_model(path, model) for model in root.iter("camera_model")}
    if len(calibrations) != 1:
        raise InputError(
            f"{path} has {len(calibrations)} different cameras", _EXPECTED, "Leave the one of the recording"
        )
    return calibrations.pop()


def find_calibration(folder: Path) -> Calibration | None:
    """The calibration in a folder, whose calibration files must agree; None where there is no such file."""
    calibrations = [read_calibration(path) for path in calibration_files(folder)]
    other = next((calibration for calibration in calibrations if calibration.lens != calibrations[0].lens), None)
    if other is not None:
        raise InputError(
            f"{calibrations[0].path} and {other.path.name} have different cameras",
            "the calibration of the endoscope that filmed",
            "Move the others away",
        )
    return calibrations[0] if calibrations else None


def calibration_files(folder: Path) -> list[Path]:
    """XML files of a folder that hold a camera model, by name; whether it can be read is not checked."""
    candidates = sorted(folder.iterdir()) if folder.is_dir() else []
    return [path for path in candidates if path.suffix.lower() == SUFFIX and _mentions_camera(path)]


def _mentions_camera(path: Path) -> bool:
    try:
        return path.is_file() and "<camera_model" in whole_text(path)
    except (OSError, ValueError):
        return False


def _read_model(path: Path, model: ElementTree.Element) -> Calibration:
    if model.get("type") != TYPE:
        raise InputError(
            f"{path}: the camera model {model.get('type')!r}",
            TYPE,
            "Give another lens by `camera` and `params` (docs/poses.md 9.1)",
        )
    size = [_numbers(path, model, tag, 1)[0] for tag in ("width", "height")]
    if not all(number == int(number) and 0 < number <= bounds.IMAGE_SIDE for number in size):
        raise InputError(f"{path}: an image of {size[0]:g} x {size[1]:g}", "whole pixels above 0")
    width, height = map(int, size)
    fx, fy, cx, cy, k1, k2, k3, k4 = _numbers(path, model, "params", 8)
    if min(fx, fy) <= 0.0 or not (0.0 < cx < width and 0.0 < cy < height):
        raise InputError(
            f"{path}: focal lengths {fx:g}, {fy:g} and the principal point ({cx:g}, {cy:g})",
            f"focal lengths above 0, and a point in the image of {width} x {height}",
        )
    scale = None if model.find("depth_scale") is None else _numbers(path, model, "depth_scale", 1)[0]
    if scale is not None and scale <= 0.0:
        raise InputError(f"{path}: depth_scale {scale:g}", "a number above 0: depth steps per scene unit")
    cx, cy = cx + _CENTER, cy + _CENTER
    lens = FisheyeLens(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, k1=k1, k2=k2, k3=k3, k4=k4)
    return Calibration(path, lens, scale)


def _numbers(path: Path, model: ElementTree.Element, tag: str, count: int) -> list[float]:
    """The numbers of an element, ``[ a; b; ... ]``."""
    text = (model.findtext(tag) or "").strip()
    try:
        numbers = [float(word) for word in text.strip("[]").replace(";", " ").split()]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise InputError(f"{path}: {tag} '{text[:100]}'", f"{count} finite number{'s' if count > 1 else ''}")
    return numbers
