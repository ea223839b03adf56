"""Points of fields: the initial ones and their spacing, frustum culling, and selection of rows of parameters."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor, nn

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scenes import TO_GET_DEPTH, Scene
from coliags_plugin.core.tensors import constant

#: Floor of the mean squared neighbour distance, scene units squared (docs/methods.md 2.2).
MIN_SQUARED_DISTANCE = 1e-7
#: A Gaussian of opacity one is drawn up to alpha = 1/255, at sqrt(2 ln 255) standard deviations.
DRAWN_SIGMAS = math.sqrt(2.0 * math.log(255.0))


def initial_positions(scene: Scene) -> Float[Tensor, "N 3"]:
    """Positions of the scene's initial points, scene units; refuses scenes without."""
    if len(scene.points) == 0:
        raise InputError(
            "the scene has no initial points",
            "at least one",
            f"Give the data manager points, or depth: {TO_GET_DEPTH}",
        )
    return scene.points.positions


def voxelize(points: Float[Tensor, "N 3"], size: float) -> Float[Tensor, "M 3"]:
    """One point, round(x / size) size, at the centre of every voxel that holds any; sorted (docs/methods.md 3.1)."""
    return torch.unique(torch.round(points / size), dim=0) * size


def neighbour_log_scales(points: Float[Tensor, "M 3"]) -> Float[Tensor, "M"]:
    """Log of the root mean squared distance to the three nearest neighbours (docs/methods.md 2.2, 3.1).

    With fewer than four points, those that there are; a lone point gets the floor.
    """
    neighbours = min(3, len(points) - 1)
    if neighbours == 0:
        return torch.full((len(points),), 0.5 * torch.log(torch.tensor(MIN_SQUARED_DISTANCE)).item())
    positions = points.detach().cpu().numpy()
    distances, _ = cKDTree(positions).query(positions, k=neighbours + 1, workers=-1)
    squared = torch.from_numpy(np.asarray(distances)[:, 1:]).square().mean(dim=1).clamp_min(MIN_SQUARED_DISTANCE)
    return (0.5 * squared.log()).to(points.dtype).to(points.device)


def frustum_planes(camera: Camera) -> Float[Tensor, "5 3"]:
    """Inward unit normals, world frame: of the near plane, then of the four sides, which go through the centre."""
    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
    # Each side plane goes through one image border; f and the distance of the border from the principal point are the
    # components of its normal up to length.
    sides = ((fx, 0, cx), (-fx, 0, camera.width - cx), (0, fy, cy), (0, -fy, camera.height - cy))
    local = constant(((0, 0, 1), *sides), camera.camera_to_world)
    return nn.functional.normalize(local, dim=1) @ camera.camera_to_world[:3, :3].T


def spheres_in_frustum(centers: Float[Tensor, "M 3"], radii: Float[Tensor, "M"], camera: Camera) -> Bool[Tensor, "M"]:
    """True if any part of a sphere may lie inside the viewing pyramid beyond the camera's near plane.

    Conservative: near the pyramid's edges a sphere outside may pass, none inside is refused. World frame, scene units.
    """
    distances = frustum_planes(camera) @ (centers - camera.center).T
    distances[0] -= camera.near_plane
    return distances.amin(dim=0) > -radii


def unique_rows(table: Float[Tensor, "N *D"], index: Int[Tensor, "V"]) -> Float[Tensor, "V *D"]:
    """``table.index_select(0, index)`` of an index without repetitions, with a faster backward pass.

    The gradient of each row is written once, where that of ``index_select`` is added up.
    """
    selected: Tensor = _UniqueRows.apply(table, index)  # type: ignore[no-untyped-call]
    return selected


class _UniqueRows(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, table: Tensor, index: Tensor) -> Tensor:
        ctx.save_for_backward(index)
        ctx.shape = table.shape
        return table.index_select(0, index)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        (index,) = ctx.saved_tensors
        return gradient.new_zeros(ctx.shape).index_copy_(0, index, gradient), None
