"""Frustum culling of spheres."""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from coliags_plugin.core.cameras import Camera

#: A Gaussian of opacity one is drawn up to alpha = 1/255, at sqrt(2 ln 255) standard deviations.
DRAWN_SIGMAS = math.sqrt(2.0 * math.log(255.0))


def spheres_in_frustum(centers: Float[Tensor, "M 3"], radii: Float[Tensor, "M"], camera: Camera) -> Bool[Tensor, "M"]:
    """Whether any part of a sphere may lie inside the viewing pyramid beyond the camera's near plane.

    Conservative: near the pyramid's edges a sphere outside may pass, none inside is refused. World frame, scene units.
    """
    x, y, z = ((centers - camera.center) @ camera.camera_to_world[:3, :3]).unbind(-1)
    inside = z + radii > camera.near_plane
    # Each side plane goes through the camera and one image border; its inward normal is (f, distance of the border
    # from the principal point) up to length.
    sides = (
        (x, camera.fx, camera.cx),
        (-x, camera.fx, camera.width - camera.cx),
        (y, camera.fy, camera.cy),
        (-y, camera.fy, camera.height - camera.cy),
    )
    for across, focal, border in sides:
        inside &= (focal * across + border * z) / math.hypot(focal, border) > -radii
    return torch.as_tensor(inside)
