"""Writing frames in C3VD's undistorted layout, for tests and for data that come from elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8, UInt16

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_folder, write_json
from coliags_plugin.core.scenes import PointCloud
from coliags_plugin.datamanagers.reading.depth_formats import C3VD_DEPTH
from coliags_plugin.lenses.models import Pinhole


def write_c3vd_scene(
    folder: Path,
    images: Sequence[UInt8[np.ndarray, "H W 3"]],
    camera_to_world: Float[np.ndarray, "N 4 4"],
    pinhole: Pinhole,
    *,
    depths: Sequence[Float[np.ndarray, "H W"]] | None = None,
    points: PointCloud | None = None,
    overwrite: bool = False,
) -> None:
    """Write a scene that the ``c3vd`` data manager reads (docs/layouts/c3vd.md 3).

    Args:
        folder: The folder to make.
        images: RGB, all of one size. N of [H, W, 3]
        camera_to_world: Rigid, OpenCV axes, mm. [N, 4, 4]
        pinhole: Intrinsics, pixels, centres at integers.
        depths: z-depth, mm, NaN where unknown; 100 mm and more cannot be told from unknown. N of [H, W]
        points: Initial points, world frame, mm; written to ``points3D.ply``.
        overwrite: Replace what is there.

    Raises:
        InputError: The numbers of images, poses and depths differ, or the folder exists or cannot be written.
    """
    if not len(images) == len(camera_to_world) == (len(images) if depths is None else len(depths)):
        raise InputError(
            f"{len(images)} images, {len(camera_to_world)} poses and {'no' if depths is None else len(depths)} depths",
            "as many of each, or no depths",
        )
    height, width = images[0].shape[:2]
    with atomic_folder(folder, overwrite) as scratch:
        (scratch / "images").mkdir()
        for index, image in enumerate(images):
            _write_png(scratch / "images" / f"{index:04d}_color.png", image[..., ::-1])
        if depths is not None:
            (scratch / "depths").mkdir()
            for index, depth in enumerate(depths):
                _write_png(scratch / "depths" / f"{index:04d}_depth.png", depth_steps(depth))
        # Sixteen numbers a line, column by column, as the current release has them.
        columns = np.asarray(camera_to_world, np.float64).transpose(0, 2, 1).reshape(-1, 16)
        lines = [",".join(repr(float(number)) for number in line) for line in columns]
        (scratch / "camera_pose.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
        write_json(scratch / "camera.json", {**pinhole._asdict(), "w": width, "h": height})
        if points is not None:
            _write_ply(scratch / "points3D.ply", points)


def depth_steps(depth: Float[np.ndarray, "H W"]) -> UInt16[np.ndarray, "H W"]:
    """z-depth, mm, as C3VD stores it: 16 bit, 0 where unknown, 65535 from 100 mm on. [H, W]"""
    known = np.isfinite(depth) & (depth > 0.0)
    steps = np.rint(np.where(known, depth, 0.0) / C3VD_DEPTH.size)
    return np.where(known, np.clip(steps, 1, C3VD_DEPTH.far), 0).astype(np.uint16)


def _write_png(path: Path, pixels: np.ndarray) -> None:
    import cv2

    path.write_bytes(cv2.imencode(".png", pixels)[1].tobytes())


def _write_ply(path: Path, points: PointCloud) -> None:
    fields = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
    if points.colors is not None:
        fields += [("red", "u1"), ("green", "u1"), ("blue", "u1")]
    vertices = np.empty(len(points), fields)
    for axis, name in enumerate("xyz"):
        vertices[name] = points.positions[:, axis].numpy()
    if points.colors is not None:
        for channel, name in enumerate(("red", "green", "blue")):
            vertices[name] = points.colors[:, channel].numpy()
    properties = "".join(f"property {'uchar' if kind == 'u1' else 'float'} {name}\n" for name, kind in fields)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{properties}end_header\n"
    path.write_bytes(header.encode() + vertices.tobytes())
