"""Base class of phantom layouts."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from jaxtyping import Bool, Float, UInt8

from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.geometry.lenses.models import Lens, PinholeLens
from coliags_plugin.phantom.trajectory import every_8th

#: ``video``: the sequence itself. ``rotation``: the rotated test views at its positions.
Part = Literal["video", "rotation"]

#: Intrinsics of C3VD's undistorted frames (docs/phantom.md 3); the calibration counts from integers, hence + 0.5.
_C3VD_PINHOLE = Intrinsics(200.8769, 200.4713, 167.3190 + 0.5, 136.9333 + 0.5, 338, 270)


@dataclass(frozen=True)
class PhantomFrame:
    """One frame of a phantom."""

    part: Part
    index: int  # within its part, from 0
    color: UInt8[np.ndarray, "H W 3"]  # RGB
    z_depth: Float[np.ndarray, "H W"]  # mm; 0 where there is no wall


@dataclass(frozen=True)
class WallPoints:
    """Points of the wall that training frames see, as a stand-in for structure-from-motion points."""

    positions: Float[np.ndarray, "N 3"]  # world, mm
    colors: UInt8[np.ndarray, "N 3"]  # RGB from a training frame
    seen_in: Callable[[int], Bool[np.ndarray, "N"]]  # those that a frame of the sequence sees, by its index


class Layout(ABC):
    """Interface of a folder layout that a phantom is written in: the files of a data format (docs/layouts).

    A folder is written in this order: every frame of the video, every rotation view, then :meth:`write_sequence` for
    the video and for the rotation views, then :meth:`write_points`. ``phantom.json`` and ``truth/`` are the same in
    every layout and not written by it.
    """

    #: Default width and height, pixels.
    default_size: ClassVar[tuple[int, int]] = (338, 270)
    #: Whether the layout supports rotation views; otherwise none are rendered.
    has_rotation: ClassVar[bool] = False
    #: Whether the layout supports initial points.
    has_points: ClassVar[bool] = False

    def lens(self, width: int, height: int) -> tuple[Lens, Bool[np.ndarray, "H W"]]:
        """The lens of frames of this size, and the mask of lit pixels [H, W].

        Default: C3VD's undistorted camera, scaled by width, its principal point at the same distance from the middle;
        all pixels are lit.
        """
        k = _C3VD_PINHOLE
        scale = width / k.width
        cx = 0.5 * width + (k.cx - 0.5 * k.width) * scale
        cy = 0.5 * height + (k.cy - 0.5 * k.height) * scale
        return PinholeLens(k.fx * scale, k.fy * scale, cx, cy, width, height), np.ones((height, width), bool)

    def is_test(self, index: int) -> bool:
        """Return whether a frame of the video is held out by the layout's split; default: 0, 8, 16, ...

        Points, rotation views and seen masks depend on it.
        """
        return every_8th(index)

    @abstractmethod
    def write_frame(self, folder: Path, frame: PhantomFrame) -> None:
        """Write one frame into the folder of the phantom."""

    @abstractmethod
    def write_sequence(self, folder: Path, part: Part, poses: Float[np.ndarray, "N 4 4"], lens: Lens) -> None:
        """Write the poses (camera-to-world, OpenCV axes, mm) of a part and, if in the layout, its lens, the camera."""

    def write_points(self, folder: Path, points: WallPoints, poses: Float[np.ndarray, "N 4 4"], lens: Lens) -> None:
        """Write initial points; called if :attr:`has_points`. ``poses`` are those of the video."""
        raise NotImplementedError(f"{type(self).__name__} does not support points")

    def seen_mask(self, folder: Path, part: Part, index: int) -> Path:
        """Path of the seen mask of a test frame."""
        return folder / ("truth" if part == "video" else part) / "seen" / f"{index:04d}_seen.png"


def part_folder(folder: Path, part: Part) -> Path:
    """Folder of a part, for layouts with rotation views in ``rotation/``."""
    return folder if part == "video" else folder / part
