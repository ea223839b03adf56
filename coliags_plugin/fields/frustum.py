"""Frustum culling of spheres."""

from __future__ import annotations

import math

from jaxtyping import Bool, Float
from torch import Tensor, nn

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.tensors import constant

#: A Gaussian of opacity one is drawn up to alpha = 1/255, at sqrt(2 ln 255) standard deviations.
DRAWN_SIGMAS = math.sqrt(2.0 * math.log(255.0))


def frustum_planes(camera: Camera) -> Float[Tensor, "5 3"]:
    """Inward unit normals, world frame: of the near plane, then of the four sides, which go through the centre."""
    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
    # Each side plane goes through one image border; f and the distance of the border from the principal point are the
    # components of its normal up to length.
    sides = ((fx, 0, cx), (-fx, 0, camera.width - cx), (0, fy, cy), (0, -fy, camera.height - cy))
    local = constant(((0, 0, 1), *sides), camera.camera_to_world)
    return nn.functional.normalize(local, dim=1) @ camera.camera_to_world[:3, :3].T


def spheres_in_frustum(centers: Float[Tensor, "M 3"], radii: Float[Tensor, "M"], camera: Camera) -> Bool[Tensor, "M"]:
    """Whether any part of a sphere may lie inside the viewing pyramid beyond the camera's near plane.

    Conservative: near the pyramid's edges a sphere outside may pass, none inside is refused. World frame, scene units.
    """
    distances = frustum_planes(camera) @ (centers - camera.center).T
    distances[0] -= camera.near_plane
    return distances.amin(dim=0) > -radii
