"""A simulated sequence of EndoMapper (docs/layouts/endomapper.md)."""

from __future__ import annotations

import numpy as np

from coliags_plugin.core.files import atomic_write
from coliags_plugin.core.images import write_image, write_mask
from coliags_plugin.core.scene_files import write_unit
from coliags_plugin.geometry.lenses.models import FisheyeLens
from coliags_plugin.geometry.lenses.vicalib import TYPE
from coliags_plugin.geometry.poses import tum
from coliags_plugin.geometry.poses.trajectory import Trajectory
from coliags_plugin.phantom.layouts import DEPTH_SCALE, Layout, depth_steps

CALIBRATION = "calibration.xml"
#: Like a colonoscope's: 150 degrees of view across the frame.
_LENS = FisheyeLens(width=1440, height=1080, fx=720.0, fy=720.0, cx=730.0, cy=550.0, k1=-0.14, k2=0.0, k3=0.0, k4=0.0)
#: Largest angle from the optical axis that is lit, degrees.
_LIT = 75.0


class EndoMapperLayout(Layout):
    """Fisheye images, depth and masks named by number, trajectory.txt and calibration.xml."""

    name = "endomapper"
    default_size = (1440, 1080)

    def lens(self, width, height):
        """A wide Kannala-Brandt lens, and the circle of its image."""
        lens = _LENS.resized(width, height)
        column, row = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        rays = lens.unproject(np.stack([column.ravel(), row.ravel()], axis=1))
        lit = np.linalg.norm(rays, axis=1) <= 1.0 / np.cos(np.radians(_LIT))
        return lens, lit.reshape(height, width)

    def write_frame(self, folder, frame):
        height, width = frame.z_depth.shape
        _, lit = self.lens(width, height)
        name = f"{frame.index:04d}.png"
        write_image(folder / "rgb" / name, frame.color)
        write_image(folder / "depth" / name, depth_steps(frame.z_depth, DEPTH_SCALE, 0))
        write_mask(folder / "mask" / name, lit)

    def write_sequence(self, folder, part, poses, lens):
        tum.write(folder / "trajectory.txt", Trajectory(poses, timestamps=np.arange(len(poses), dtype=np.float64)))
        atomic_write(folder / CALIBRATION, calibration_text(lens, DEPTH_SCALE))
        write_unit(folder, "mm")


def calibration_text(lens, depth_scale=None):
    """A calibration file of Vicalib: pixel centres at integers, and perhaps depth steps per scene unit."""
    k = lens.pinhole
    params = (k.fx, k.fy, k.cx - 0.5, k.cy - 0.5, lens.k1, lens.k2, lens.k3, lens.k4)
    scale = "" if depth_scale is None else f"      <depth_scale> {depth_scale!r} </depth_scale>\n"
    return (
        "<rig>\n  <camera>\n"
        f'    <camera_model name="" index="0" serialno="0" type="{TYPE}" version="8">\n'
        f"      <width> {lens.width} </width>\n      <height> {lens.height} </height>\n"
        f"      <params> [ {'; '.join(map(repr, params))} ] </params>\n{scale}"
        "    </camera_model>\n  </camera>\n</rig>\n"
    )
