"""Tiny phantoms in every layout, those of tests/layouts among them, and what a scene read from one is compared with."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

import tests.layouts  # noqa: F401  (registers them)
from coliags_plugin.config.registry import datamanagers
from coliags_plugin.core.scenes import Frame, Scene
from coliags_plugin.datamanagers.recognition import find_format
from coliags_plugin.phantom.generate import generate
from coliags_plugin.phantom.settings import PhantomSettings

COARSE = {"mesh_spacing": 1.2, "texture_spacing": 0.4, "interreflection": 0.0}
TINY = COARSE | {"frames": 9, "rotation_views": 2, "supersampling": 1}


def write_phantom(folder: Path, layout: str, width: int = 64, height: int = 51, **options) -> Path:
    """A phantom in a layout; see ``TINY``."""
    generate(PhantomSettings(**{**TINY, "layout": layout, "width": width, "height": height, **options}), folder)
    return folder


def read(folder: Path, name: str, **options) -> Scene:
    """The scene in a folder, by the data manager of a name, which must be the one that recognises it."""
    assert find_format(folder) == name
    manager = datamanagers.get(name)
    return manager(manager.Settings(**options)).load(folder)


def true_poses(folder: Path) -> np.ndarray:
    """Camera-to-world of the video. [N, 4, 4]"""
    return np.load(folder / "truth" / "camera_to_world.npy")


def in_video_order(scene: Scene) -> list[Frame]:
    return sorted([*scene.train, *scene.test_sets.get("test", [])], key=lambda frame: frame.index)


def depth_gap(one: Frame, other: Frame) -> tuple[float, float]:
    """How far the depth of one frame, carried over, is from that of another.

    Returns:
        Median difference over the pixels that land on known depth, scene units; and the share of pixels that do.
    """
    points = one.camera.unproject(one.depth).reshape(-1, 3)
    points = points[torch.isfinite(points).all(dim=1)]
    pixels, depth = other.camera.project(points)
    column, row = pixels.floor().long().unbind(1)
    inside = (depth > 0) & (column >= 0) & (column < other.camera.width) & (row >= 0) & (row < other.camera.height)
    gap = (depth[inside] - other.depth[row[inside], column[inside]]).abs()
    gap = gap[torch.isfinite(gap)]
    return float(gap.median()), len(gap) / max(1, one.depth.numel())


def distance_from_wall(folder: Path, points: torch.Tensor) -> np.ndarray:
    """Distance of world points from the phantom's mesh, mm. [N]"""
    import open3d

    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(open3d.t.io.read_triangle_mesh(str(folder / "truth" / "mesh.ply")))
    return scene.compute_distance(open3d.core.Tensor(points.numpy().astype(np.float32))).numpy()
