"""The real frames of cecum_t1_a, undistorted into a scene: real texture and moving light, no dense depth."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch

from coliags_plugin.core.images import read_rgb
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.core.scenes import PointCloud
from coliags_plugin.geometry.lenses.models import FisheyeLens, Lens
from coliags_plugin.geometry.lenses.undistortion import Undistortion
from tests.scenes import write_c3vd_scene


def real_lens(shared_data: Path) -> FisheyeLens:
    """The lens of the 800 x 800 crops, as their frames.json gives it, pixel centres at integers."""
    data = json.loads((shared_data / "c3vd_cecum_t1_a" / "frames.json").read_text())
    bends = {name: data[name] for name in ("k1", "k2", "k3", "k4")}
    size = {"width": data["w"], "height": data["h"]}
    return FisheyeLens(**size, fx=data["fl_x"], fy=data["fl_y"], cx=data["cx"] + 0.5, cy=data["cy"] + 0.5, **bends)


def widest_pinhole(lens: Lens, width: int, height: int) -> Intrinsics:
    """The widest view of which every pixel lies in the image: as wide as the middles of the image's edges see.

    A barrel-distorted image sees further at its corners than at its edges, so the corners need no look.
    """
    k = lens.pinhole
    ends = [[0.0, k.cy], [lens.width, k.cy], [k.cx, 0.0], [k.cx, lens.height]]
    (left, _), (right, _), (_, top), (_, bottom) = lens.unproject(ends)[:, :2]
    fx, fy = width / (right - left), height / (bottom - top)
    return Intrinsics(fx, fy, -left * fx, -top * fy, width, height)


def sparse_points(shared_data: Path) -> PointCloud:
    """The ground-truth points of frames 0 and 1, coloured from their images (grey beyond the crop)."""
    positions, colors = [], []
    for index in (0, 1):
        data = np.load(shared_data / "c3vd_sparse_depth" / f"cecum_t1_a_{index:04d}.npz")
        image = read_rgb(shared_data / "c3vd_cecum_t1_a" / f"{index:04d}_color_crop800.jpg")
        column, row = np.rint(data["uv_raw1350x1080"] - (275, 140)).astype(int).T
        inside = (column >= 0) & (column < 800) & (row >= 0) & (row < 800)
        color = np.full((len(column), 3), 128, np.uint8)
        color[inside] = image[row[inside], column[inside]]
        positions.append(data["points_world_mm"])
        colors.append(color)
    return PointCloud(torch.from_numpy(np.concatenate(positions)), torch.from_numpy(np.concatenate(colors)))


def undistort_real_frames(shared_data: Path, out: Path, width: int, height: int, step: int) -> Path:
    """Write every ``step``-th real frame in the undistorted layout, with ``points3D.ply`` and without depth."""
    folder = shared_data / "c3vd_cecum_t1_a"
    frames = json.loads((folder / "frames.json").read_text())["frames"][::step]
    lens = real_lens(shared_data)
    pinhole = widest_pinhole(lens, width, height)
    undistortion = Undistortion(lens, pinhole)
    if not undistortion.valid.all():
        raise RuntimeError("the chosen pinhole sees beyond the crop")
    images = [undistortion.image(read_rgb(folder / frame["file_path"])) for frame in frames]
    camera_to_world = np.array([frame["c2w"] for frame in frames])
    write_c3vd_scene(out, images, camera_to_world, pinhole, points=sparse_points(shared_data))
    return out
