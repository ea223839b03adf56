"""TUM's RGB-D layout (docs/layouts/rgbd.md)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from coliags_plugin.core.files import atomic_write
from coliags_plugin.datamanagers.reading.camera_json import write_camera_json
from coliags_plugin.datamanagers.rgbd.writer import CAMERA, write_frame
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
        write_frame(folder, f"{_time(frame.index)}.png", frame.color, frame.z_depth, DEPTH_SCALE)

    def write_sequence(self, folder: Path, part: Part, poses: Float[np.ndarray, "N 4 4"], lens: Lens) -> None:
        """See :class:`Layout`."""
        times = [_time(index) for index in range(len(poses))]
        tum.write(folder / "groundtruth.txt", Trajectory(poses, timestamps=np.array(times, np.float64)))
        write_camera_json(folder / CAMERA, lens.pinhole, h=lens.height, w=lens.width, depth_scale=DEPTH_SCALE)
        write_unit(folder, "mm")
        for kind in ("rgb", "depth"):
            lines = ["# timestamp filename", *(f"{time} {kind}/{time}.png" for time in times)]
            atomic_write(folder / f"{kind}.txt", "\n".join(lines) + "\n")


def _time(index: int) -> str:
    return f"{_START + index / _RATE:.6f}"
