"""Writes C3VDv2's layout (docs/layouts/c3vd-v2.md 1); its poses are in C3VD's format."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from coliags_plugin.core.files import atomic_write
from coliags_plugin.core.images import write_image
from coliags_plugin.datamanagers.c3vd.writer import depth_steps, normal_steps
from coliags_plugin.datamanagers.c3vd_v2.files import INTRINSICS
from coliags_plugin.datamanagers.c3vd_v2.lens import ORDER
from coliags_plugin.geometry.lenses.models import OmnidirectionalLens


def write_frame(
    folder: Path,
    index: int,
    image: UInt8[np.ndarray, "H W 3"],
    z_depth: Float[np.ndarray, "H W"],
    normals: Float[np.ndarray, "H W 3"],
) -> None:
    """Write a frame; arguments as for :func:`coliags_plugin.datamanagers.c3vd.writer.write_raw_frame`."""
    write_image(folder / "rgb" / f"{index:04d}.png", image)
    write_image(folder / "depth" / f"{index:04d}_depth.tiff", depth_steps(z_depth))
    write_image(folder / "normals" / f"{index:04d}_normals.tiff", normal_steps(normals))


def write_lens(folder: Path, lens: OmnidirectionalLens) -> None:
    """Write the calibration as named numbers to ``camera_intrinsics.txt``, pixel centres at integers."""
    values = {"a1": 0.0, **vars(lens), "cx": lens.cx - 0.5, "cy": lens.cy - 0.5}
    atomic_write(folder / INTRINSICS, "".join(f"{name} = {values[name]!r}\n" for name in ORDER))
