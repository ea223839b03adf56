"""Projection of surfels (2D Gaussians on discs): where the ray of a pixel meets a disc, as functions of the pixel.

The formulas are written out in ``docs/rendering.md``, section "Surfels".
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.gaussians import Gaussians, rotation_matrices
from coliags_plugin.renderers.projection import facing


@dataclass(frozen=True)
class ProjectedSurfels:
    """N projected surfels.

    The ray of a pixel at offset d from ``means2d`` meets the disc's plane at u = U / W and v = V / W standard
    deviations from its centre and at z-depth D / W, where (U, V, W) = ``slopes`` d + (0, 0, D / z), z the centre's
    depth. The intersections depend on the centre's direction through ``means2d`` only. Every entry is finite; those of
    surfels not ``visible`` are meaningless.
    """

    places: Float[Tensor, "N 3"]  # centres, camera axes, scene units; a stand-in where not beyond the near plane
    tangents: Float[Tensor, "N 2 3"]  # local axes 0 and 1 in camera axes, each times its standard deviation
    normals: Float[Tensor, "N 3"]  # local axis 2 in camera axes, oriented towards the camera
    means2d: Float[Tensor, "N 2"]  # projected centres, pixels
    filter_centers: Float[Tensor, "N 2"]  # the same values, for the low-pass filter, whose gradient is none of means2d
    slopes: Float[Tensor, "N 3 2"]  # derivatives of U, V and W with respect to the pixel position
    offsets: Float[Tensor, "N"]  # D: distance of the camera from the disc's plane, with a sign, scene units
    visible: Bool[Tensor, "N"]  # whether beyond the near plane, of positive area and not seen exactly edge-on

    @property
    def depths(self) -> Float[Tensor, "N"]:
        """z-depths of the centres, scene units. [N]"""
        return self.places[:, 2]

    @property
    def intersections(self) -> Float[Tensor, "N 10"]:
        """All that the intersections depend on: ``means2d``, ``slopes``, W at the centre, and ``offsets``. [N, 10]"""
        at_center = self.offsets / self.depths
        return torch.cat([self.means2d, self.slopes.flatten(1), torch.stack([at_center, self.offsets], dim=1)], dim=1)


def project_surfels(gaussians: Gaussians, camera: Camera) -> ProjectedSurfels:
    """Project surfels; differentiable in all of them and in ``camera.camera_to_world``.

    Those whose centre has z <= the camera's near plane are not drawn. The result is of the surfels' dtype but computed
    in float64, as a disc seen nearly edge-on magnifies rounding.
    """
    dtype, double = gaussians.means.dtype, torch.float64
    camera = camera.to(gaussians.means.device, double)
    camera_axes = camera.camera_to_world[:3, :3]
    local = (gaussians.means.to(double) - camera.center) @ camera_axes
    in_front = local[:, 2] > camera.near_plane
    # A stand-in keeps 0 * inf out of the backward pass of what is not drawn.
    places = torch.where(in_front[:, None], local, local.new_tensor([0.0, 0.0, 1.0]))
    z = places[:, 2:]
    focal, principal = local.new_tensor([camera.fx, camera.fy]), local.new_tensor([camera.cx, camera.cy])
    filter_centers = (focal * places[:, :2] / z + principal).to(dtype)
    means2d = filter_centers.clone()

    rotations = camera_axes.T @ rotation_matrices(gaussians.quats_wxyz.to(double))
    first, second = rotations[:, :, 0], rotations[:, :, 1]
    sight = torch.cat([_exactly(places[:, :2], (means2d - principal) / focal * z), z], dim=-1)
    # With U and V over the scales instead of W and D times both, depths do not depend on scales even in rounding, and
    # what the filter makes of the smallest surfels gives these no gradient.
    scaled = gaussians.scales != 0
    scales = torch.where(scaled, gaussians.scales, 1.0).to(double)
    cross = torch.linalg.cross
    u, v, w = cross(second, sight) / scales[:, :1], cross(sight, first) / scales[:, 1:], cross(first, second)
    offsets = (w * sight).sum(-1)
    return ProjectedSurfels(
        places=places.to(dtype),
        tangents=(torch.stack([first, second], dim=1) * scales[:, :, None]).to(dtype),
        normals=facing(rotations[:, :, 2], local).to(dtype),
        means2d=means2d,
        filter_centers=filter_centers,
        slopes=(torch.stack([u, v, w], dim=1)[:, :, :2] / focal).to(dtype),
        offsets=offsets.to(dtype),
        visible=in_front & scaled.all(-1) & (offsets != 0),
    )


def _exactly(values: Tensor, rounded: Tensor) -> Tensor:
    """The first with the derivatives of the second, which equals it but for rounding."""
    return values.detach() + (rounded - rounded.detach())
