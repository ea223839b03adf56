"""What a folder layout has to say for a phantom to be written in it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from jaxtyping import Bool, Float, UInt8

from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.lenses.models import Lens
from coliags_plugin.lenses.pinhole import PinholeLens
from coliags_plugin.phantom.trajectory import every_8th

#: ``video``: the sequence itself. ``rotation``: the test views at its places, turned away from it.
Part = Literal["video", "rotation"]

#: Intrinsics of C3VD's undistorted frames (docs/phantom.md 3); the calibration counts from integers, hence + 0.5.
_C3VD_PINHOLE = Intrinsics(200.8769, 200.4713, 167.3190 + 0.5, 136.9333 + 0.5, 338, 270)


@dataclass(frozen=True)
class PhantomFrame:
    """One frame of a phantom.

    Attributes:
        part: What the frame belongs to.
        index: Within its part, counted from 0.
        color: RGB. [H, W, 3]
        z_depth: mm; 0 where there is no wall. [H, W]
        normals: Unit, camera axes, towards the camera; 0 where there is no wall. [H, W, 3]
    """

    part: Part
    index: int
    color: UInt8[np.ndarray, "H W 3"]
    z_depth: Float[np.ndarray, "H W"]
    normals: Float[np.ndarray, "H W 3"]


@dataclass(frozen=True)
class WallPoints:
    """Points of the wall that training frames see, as structure from motion would have found them.

    Attributes:
        positions: World, mm. [N, 3]
        colors: RGB as a training frame photographed them. [N, 3]
        seen_in: Which of the points a frame of the sequence sees, by the frame's index. [N]
    """

    positions: Float[np.ndarray, "N 3"]
    colors: UInt8[np.ndarray, "N 3"]
    seen_in: Callable[[int], Bool[np.ndarray, "N"]]


class Layout(ABC):
    """How one phantom lies in a folder.

    A folder is written in this order: every frame of the video, every rotation view, then :meth:`write_sequence` for
    the video and for the rotation views, then :meth:`write_points`. ``phantom.json`` and ``truth/`` are not the
    layout's: they are the same beside every layout.
    """

    #: Width and height, pixels, where none are asked for.
    default_size: ClassVar[tuple[int, int]] = (338, 270)
    #: Whether there is a place for rotation views; where there is none, none are taken.
    has_rotation: ClassVar[bool] = False
    #: Whether there is a place for initial points; where there is none, none are drawn.
    has_points: ClassVar[bool] = False
    #: Whether the mesh and its coverage belong to the layout, as ``coverage_mesh.obj``.
    has_coverage_mesh: ClassVar[bool] = False

    def lens(self, width: int, height: int) -> tuple[Lens, Bool[np.ndarray, "H W"]]:
        """The lens of frames of this size, and which of their pixels are lit. The mask is [H, W].

        Unless a layout says otherwise: C3VD's undistorted camera, scaled by width; its principal point keeps its
        distance from the middle. All of its pixels are lit.
        """
        k = _C3VD_PINHOLE
        scale = width / k.width
        cx = 0.5 * width + (k.cx - 0.5 * k.width) * scale
        cy = 0.5 * height + (k.cy - 0.5 * k.height) * scale
        return PinholeLens(k.fx * scale, k.fy * scale, cx, cy, width, height), np.ones((height, width), bool)

    def is_test(self, index: int) -> bool:
        """Whether a frame of the video is held out by the split that goes with the layout.

        0, 8, 16, ... unless a layout says otherwise. Points, rotation views and the masks of what training frames saw
        go by it.
        """
        return every_8th(index)

    @abstractmethod
    def write_frame(self, folder: Path, frame: PhantomFrame) -> None:
        """Write one frame.

        Args:
            folder: Of the phantom.
            frame: What was taken.
        """

    @abstractmethod
    def write_sequence(self, folder: Path, part: Part, poses: Sequence[Float[np.ndarray, "4 4"]], lens: Lens) -> None:
        """Write what belongs to all frames of a part: poses and, where the layout has one, the camera.

        Args:
            folder: Of the phantom.
            part: What the frames belong to.
            poses: Camera-to-world, OpenCV axes, mm. Each [4, 4]
            lens: Of all of them, from :meth:`lens`.
        """

    def write_points(
        self, folder: Path, points: WallPoints, poses: Sequence[Float[np.ndarray, "4 4"]], lens: Lens
    ) -> None:
        """Write initial points; called where :attr:`has_points`. ``poses`` are those of the video."""
        raise NotImplementedError(f"{type(self).__name__} has no place for points")

    def seen_mask(self, folder: Path, part: Part, index: int) -> Path:
        """Where the mask goes that says what training frames saw of a test frame."""
        return folder / ("truth" if part == "video" else part) / "seen" / f"{index:04d}_seen.png"


def pinhole_of(lens: Lens) -> Intrinsics:
    """Intrinsics of frames that are a pinhole's.

    Raises:
        TypeError: They are taken through another lens.
    """
    if not isinstance(lens, PinholeLens):
        raise TypeError(f"{type(lens).__name__} is no pinhole, and the layout holds a pinhole camera")
    return lens.pinhole


def place(folder: Path, part: Part) -> Path:
    """The folder of a part where rotation views lie in ``rotation/`` in the layout of the sequence itself."""
    return folder if part == "video" else folder / part
