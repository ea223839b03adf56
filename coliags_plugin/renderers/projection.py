"""Projection of 3D Gaussians (EWA, to 2D Gaussians on the image plane) and of surfels (ray-disc intersections).

The formulas are written out in ``docs/rendering.md``, sections "Projection" and "Surfels".
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.gaussians import Gaussians, rotation_matrices, shortest_columns

#: Margin beyond the image, relative to half the field of view, within which the Jacobian is not clamped.
JACOBIAN_MARGIN = 0.3


@dataclass(frozen=True)
class ProjectedGaussians:
    """N projected Gaussians.

    Every entry is finite; those of Gaussians not ``in_front`` are meaningless and pass no gradient. ``whitenings`` are
    u_xx, u_yx, u_yy of the lower triangular U with U^T U the inverse of the covariance, so that the Mahalanobis
    distance of an offset d is |U d|.
    """

    means_camera: Float[Tensor, "N 3"]  # centres, camera axes, scene units
    rotations: Float[Tensor, "N 3 3"]  # local axes (columns) in camera axes
    means2d: Float[Tensor, "N 2"]  # projected centres, pixels
    depths: Float[Tensor, "N"]  # z-depths of the centres, scene units; 1 where not in_front
    covariances: Float[Tensor, "N 3"]  # xx, xy, yy of the 2D covariance with its low-pass term, square pixels
    whitenings: Float[Tensor, "N 3"]  # 1 / pixels
    in_front: Bool[Tensor, "N"]  # whether beyond the near plane


def project_gaussians(gaussians: Gaussians, camera: Camera, eps2d: float) -> ProjectedGaussians:
    """Project Gaussians; differentiable in all of them and in ``camera.camera_to_world``.

    Those whose centre has z <= the camera's near plane are not drawn; ``eps2d``, square pixels, is added to both
    diagonal terms of the 2D covariance.
    """
    camera = camera.to(gaussians.means.device, gaussians.means.dtype)
    camera_axes = camera.camera_to_world[:3, :3]
    # Subtracting the centre before rotating keeps float32 accurate far from the world's origin.
    local = (gaussians.means - camera.center) @ camera_axes
    in_front = local[:, 2] > camera.near_plane
    # A stand-in depth keeps 0 * inf out of the backward pass of what is not drawn.
    x, y, z = torch.where(in_front[:, None], local, local.new_tensor([0.0, 0.0, 1.0])).unbind(-1)
    means2d = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], dim=-1)

    rotations = camera_axes.T @ rotation_matrices(gaussians.quats_wxyz)
    # The 2D covariance is V V^T with V = J (W R S): one row of V per image axis.
    slope_x = (x / z).clamp(*slope_limits(camera.fx, camera.cx, camera.width))
    slope_y = (y / z).clamp(*slope_limits(camera.fy, camera.cy, camera.height))
    axes = rotations * gaussians.scales[:, None, :]
    row_x = (camera.fx / z)[:, None] * (axes[:, 0] - slope_x[:, None] * axes[:, 2])
    row_y = (camera.fy / z)[:, None] * (axes[:, 1] - slope_y[:, None] * axes[:, 2])
    covariances, whitenings = filtered_covariances(row_x, row_y, eps2d)
    return ProjectedGaussians(local, rotations, means2d, z, covariances, whitenings, in_front)


def filtered_covariances(
    row_x: Float[Tensor, "N 3"], row_y: Float[Tensor, "N 3"], eps2d: float
) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 3"]]:
    """Covariances V V^T + eps2d I of image points and their whitenings, without cancellation for needles.

    ``row_x`` and ``row_y`` are the rows of V in pixels, ``eps2d`` square pixels; the result is as in
    :class:`ProjectedGaussians`.
    """
    sharp_xx, sharp_yy = row_x.square().sum(-1), row_y.square().sum(-1)
    xx, xy, yy = sharp_xx + eps2d, (row_x * row_y).sum(-1), sharp_yy + eps2d
    # xx yy - xy^2 cancels for needles; this sum of squares is the same number (Cauchy-Binet) and does not.
    determinant = torch.linalg.cross(row_x, row_y).square().sum(-1) + eps2d * (sharp_xx + sharp_yy) + eps2d * eps2d
    u_xx, u_yy = xx.rsqrt(), (xx / determinant).sqrt()
    return torch.stack([xx, xy, yy], dim=-1), torch.stack([u_xx, -u_yy * xy / xx, u_yy], dim=-1)


def facing_normals(projected: ProjectedGaussians, scales: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
    """Shortest axis of each Gaussian in camera axes, oriented towards the camera. [N, 3]

    Differentiable in the rotations; the choice of axis and sign is not.
    """
    return facing(shortest_columns(projected.rotations, scales), projected.means_camera)


def facing(axes: Float[Tensor, "N 3"], sight: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
    """Axes turned around where they point away from the camera; ``sight`` leads from it to them, in the same frame."""
    away = (axes * sight).sum(-1, keepdim=True) > 0
    return torch.where(away, -axes, axes)


def slope_limits(focal: float, principal: float, size: int) -> tuple[float, float]:
    """Range of x/z (or y/z) to which the Jacobian is clamped: the image's, widened on both sides."""
    margin = JACOBIAN_MARGIN * 0.5 * size / focal
    return -principal / focal - margin, (size - principal) / focal + margin


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
