"""Surfaces of known shape and cameras inside them."""

from __future__ import annotations

import numpy as np

from coliags_plugin.geometry.lenses.models import PinholeLens
from coliags_plugin.geometry.meshes.mesh import TriangleMesh
from coliags_plugin.phantom.colon import grid_triangles
from coliags_plugin.surface.coverage.visibility import CoverageView


def pinhole(width: int = 64, height: int = 48, focal: float = 40.0) -> PinholeLens:
    return PinholeLens(focal, focal, 0.5 * width, 0.5 * height, width, height)


def view_at(center, forward=(0.0, 0.0, 1.0), lens=None, name="frame", grey=None, mask=None) -> CoverageView:
    """A camera whose images have -y (or, looking along y, z) upwards; with an even image of a grey value if given."""
    forward = np.asarray(forward, float) / np.linalg.norm(forward)
    down = np.array([0.0, 1.0, 0.0]) if abs(forward[1]) < 0.9 else np.array([0.0, 0.0, 1.0])
    down = down - (down @ forward) * forward
    down /= np.linalg.norm(down)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([np.cross(down, forward), down, forward], axis=1)
    pose[:3, 3] = center
    lens = lens or pinhole()
    image = None if grey is None else np.full((lens.height, lens.width, 3), grey, np.uint8)
    return CoverageView(name, pose, lens, mask, None if image is None else lambda: image)


def grid_mesh(points: np.ndarray, around: bool = False) -> TriangleMesh:
    """The mesh of an R x C grid of points, whose columns close a ring if ``around``."""
    return TriangleMesh(points.reshape(-1, 3), grid_triangles(*points.shape[:2], wraps=around).astype(np.int64))


def tube(radius=10.0, start=-20.0, end=80.0, spacing=1.0, columns=72) -> TriangleMesh:
    """An open cylinder about the z axis that faces inwards. ``radius`` may be a function of (z, angle)."""
    z = np.arange(start, end + 0.5 * spacing, spacing)
    angle = np.arange(columns) * (2.0 * np.pi / columns)
    size = radius(z[:, None], angle[None]) if callable(radius) else np.full((len(z), columns), float(radius))
    points = np.stack([size * np.cos(angle), size * np.sin(angle), np.broadcast_to(z[:, None], size.shape)], axis=-1)
    return grid_mesh(points, around=True)


def plane(z: float, half: float, spacing: float = 0.5) -> TriangleMesh:
    """A square about the z axis that faces -z."""
    side = np.arange(-half, half + 0.5 * spacing, spacing)
    y, x = np.meshgrid(side, side, indexing="ij")
    return grid_mesh(np.stack([x, y, np.full_like(x, z)], axis=-1))


def joined(*meshes: TriangleMesh) -> TriangleMesh:
    offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    triangles = [mesh.triangles + offset for mesh, offset in zip(meshes, offsets, strict=False)]
    return TriangleMesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(triangles))


def sphere(radius: float, rows: int = 90, columns: int = 180) -> TriangleMesh:
    """A sphere about the origin that faces inwards."""
    polar, angle = np.linspace(0.0, np.pi, rows), np.arange(columns) * (2.0 * np.pi / columns)
    ring = np.sin(polar)[:, None]
    height = np.broadcast_to(np.cos(polar)[:, None], (rows, columns))
    return grid_mesh(radius * np.stack([ring * np.cos(angle), -ring * np.sin(angle), height], axis=-1), around=True)
