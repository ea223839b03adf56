"""TUM's RGB-D layout (docs/layouts/rgbd.md)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt16

from coliags_plugin.core.files import atomic_write
from coliags_plugin.core.images import write_image
from coliags_plugin.datamanagers.reading.files import write_camera_json
from coliags_plugin.datamanagers.units import write_unit
from coliags_plugin.geometry.lenses.models import Lens
from coliags_plugin.geometry.poses import tum
from coliags_plugin.geometry.poses.trajectory import Trajectory
from coliags_plugin.phantom.layouts.base import Layout, Part, PhantomFrame

#: Depth steps per mm: 0.002 mm each, up to 131 mm; farther is unknown, as for TUM's sensor.
DEPTH_SCALE = 500.0
#: Seconds: TUM's clock and frame rate.
_START, _RATE = 1_305_031_102.0, 30.0


class RGBDLayout(Layout):
    """Images and depth named by timestamps, groundtruth.txt, camera.json, and TUM's file lists."""

    def write_frame(self, folder: Path, frame: PhantomFrame) -> None:
        """See :class:`Layout`."""
        name = f"{_time(frame.index)}.png"
        write_image(folder / "rgb" / name, frame.color)
        write_image(folder / "depth" / name, depth_steps(frame.z_depth))

    def write_sequence(self, folder: Path, part: Part, poses: Float[np.ndarray, "N 4 4"], lens: Lens) -> None:
        """See :class:`Layout`."""
        times = [_time(index) for index in range(len(poses))]
        tum.write(folder / "groundtruth.txt", Trajectory(poses, timestamps=np.array(times, np.float64)))
        write_camera_json(folder / "camera.json", lens.pinhole, h=lens.height, w=lens.width, depth_scale=DEPTH_SCALE)
        write_unit(folder, "mm")
        for kind in ("rgb", "depth"):
            lines = ["# timestamp filename", *(f"{time} {kind}/{time}.png" for time in times)]
            atomic_write(folder / f"{kind}.txt", "\n".join(lines) + "\n")


def depth_steps(depth: Float[np.ndarray, "H W"]) -> UInt16[np.ndarray, "H W"]:
    """z-depth, mm, in 16-bit steps; 0 where unknown or out of range."""
    known = np.isfinite(depth) & (depth > 0.0)
    steps = np.maximum(np.rint(np.where(known, depth, 0.0) * DEPTH_SCALE), 1)
    return np.where(known & (steps <= 65_535), steps, 0).astype(np.uint16)


def _time(index: int) -> str:
    return f"{_START + index / _RATE:.6f}"
