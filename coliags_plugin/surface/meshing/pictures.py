"""Pictures of a true and a reconstructed surface side by side, coloured by the distance between them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from coliags_plugin.core.cameras import Camera
from coliags_plugin.geometry.meshes.mesh import TriangleMesh
from coliags_plugin.geometry.meshes.truth import TrueSurface
from coliags_plugin.reporting.colormaps import (
    UNKNOWN_GREY,
    color_bar,
    colored,
    scale_places,
    side_by_side,
    stacked,
)

#: Distances of the first and the last colour, mm; the same for all surfaces, so that they are comparable.
_LIMITS = (0.0, 2.0)
#: Height of each picture, px.
HEIGHT = 320
_SURROUNDINGS = 255
#: Share of the colour that a surface seen edge-on keeps.
_AMBIENT = 0.45


def distance_colors(
    distances: Float[np.ndarray, "N"], valid: Bool[np.ndarray, "N"] | None = None
) -> UInt8[np.ndarray, "N 3"]:
    """Colours of distances on the scale of errors, 0 to 2 mm; grey where not valid."""
    colors = colored(scale_places(distances, _LIMITS, "error"), "error")
    if valid is not None:
        colors[~valid] = UNKNOWN_GREY
    return colors


def comparison_picture(mesh: TriangleMesh, truth: TrueSurface, cameras: Sequence[Camera]) -> UInt8[np.ndarray, "H W 3"]:
    """True surface, its unseen part grey, mesh and its colours, from cameras within and from two sides without."""
    views = [("inside", camera.resized(round(camera.width * HEIGHT / camera.height), HEIGHT)) for camera in cameras]
    width = max((camera.width for _, camera in views), default=HEIGHT)
    views += [("outside", camera) for camera in outside_cameras(truth.mesh.part(truth.seen), width)]

    def missed(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
        return distance_colors(mesh.rays.nearest(points)[0], truth.seen[triangles])

    def wrong(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
        return distance_colors(truth.mesh.rays.nearest(points)[0])

    def plain(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
        """Mean colours of triangles; light grey where there are none. [N, 3]"""
        if mesh.colors is None:
            return np.full((len(triangles), 3), 200, np.uint8)
        return np.asarray(mesh.colors[mesh.triangles[triangles]].mean(axis=1))

    unit = truth.unit
    rows = [
        side_by_side(
            [draw_mesh(truth.mesh, camera, missed), draw_mesh(mesh, camera, wrong), draw_mesh(mesh, camera, plain)],
            (f"{name} {number}: true, {unit} to the mesh", f"mesh, {unit} to the true surface", "mesh, colour"),
        )
        for number, (name, camera) in enumerate(views, start=1)
    ]
    bar = color_bar(_LIMITS, unit, width=max(row.shape[1] for row in rows))
    return stacked([*rows, bar])


def outside_cameras(mesh: TriangleMesh, width: int) -> list[Camera]:
    """Two cameras that see a whole mesh from outside, at right angles to its longest direction and to each other."""
    center = mesh.centers.mean(axis=0)
    longest, middle, shortest = np.linalg.svd(mesh.centers[:: max(1, len(mesh) // 5000)] - center)[2]
    radius = float(np.linalg.norm(mesh.centers - center, axis=1).max())
    focal = 0.48 * min(width, HEIGHT) / np.tan(np.radians(10.0))  # the radius is seen at 10 degrees
    cameras = []
    for forward in (shortest, middle):
        pose = torch.eye(4, dtype=torch.float64)
        down = np.cross(forward, longest)
        pose[:3, :3] = torch.from_numpy(np.stack([longest, down, forward], axis=1))
        pose[:3, 3] = torch.from_numpy(center - forward * radius / np.sin(np.radians(10.0)))
        cameras.append(Camera(focal, focal, width / 2, HEIGHT / 2, width, HEIGHT, pose))
    return cameras


def draw_mesh(
    mesh: TriangleMesh, camera: Camera, color: Callable[[np.ndarray, np.ndarray], np.ndarray]
) -> UInt8[np.ndarray, "H W 3"]:
    """A mesh as a camera sees it, lit from there, coloured by a function of the points hit and their triangles."""
    camera = camera.to("cpu", torch.float64)
    center, directions = camera.center.float().numpy(), camera.rays().reshape(-1, 3).float().numpy()
    triangles, z = mesh.rays.cast(center, directions)
    hit = triangles >= 0
    image = np.full((len(directions), 3), _SURROUNDINGS, np.uint8)
    if hit.any():
        toward = directions[hit] / np.linalg.norm(directions[hit], axis=1, keepdims=True)
        facing = np.abs((mesh.normals[triangles[hit]] * toward).sum(axis=1))
        colors = color(center + z[hit, None] * directions[hit], triangles[hit])
        image[hit] = np.rint(colors * (_AMBIENT + (1.0 - _AMBIENT) * facing)[:, None])
    return image.reshape(camera.height, camera.width, 3)
