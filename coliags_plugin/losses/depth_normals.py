"""Normals of the surface that a depth map describes."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.masked import zero_outside


def depth_normals(
    depth: Float[Tensor, "H W"], camera: Camera, known: Bool[Tensor, "H W"] | None = None
) -> Float[Tensor, "H W 3"]:
    """Unit normals in camera axes, facing the camera: cross products of central differences of unprojected pixels.

    0 at the border, and where a neighbour above, below, to the left or to the right is unknown. Differentiable in the
    depth; values at unknown pixels have no influence, not even NaN.

    Args:
        depth: z-depth, scene units. [H, W]
        camera: Whose pixels these are.
        known: Where the depth is usable; None: everywhere. [H, W]
    """
    height, width = depth.shape
    if height < 3 or width < 3:
        return depth.new_zeros(height, width, 3)
    # Without a pose, points are in camera axes.
    local = replace(camera, camera_to_world=torch.eye(4, dtype=depth.dtype, device=depth.device))
    points = local.unproject(zero_outside(depth, known))
    down = points[2:, 1:-1] - points[:-2, 1:-1]
    right = points[1:-1, 2:] - points[1:-1, :-2]
    normals = torch.nn.functional.normalize(torch.linalg.cross(down, right), dim=-1)
    if known is not None:
        normals = zero_outside(normals, known[2:, 1:-1] & known[:-2, 1:-1] & known[1:-1, 2:] & known[1:-1, :-2])
    return torch.nn.functional.pad(normals, (0, 0, 1, 1, 1, 1))
