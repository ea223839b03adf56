"""Posed pinhole camera."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from coliags_plugin.core.gaussians import rotation_of_vector
from coliags_plugin.core.intrinsics import NEAR_PLANE, Intrinsics
from coliags_plugin.core.tensors import constant, sent


@dataclass(frozen=True)
class Camera(Intrinsics):
    """A posed pinhole camera, OpenCV axes: x right, y down, z forward.

    Attributes:
        fx, fy, cx, cy, width, height: See :class:`Intrinsics`.
        camera_to_world: Rigid transform. Scene units (mm for C3VD). [4, 4]
        near_plane: z-depth up to which nothing is drawn, scene units: option ``near_plane`` of a method config.
    """

    camera_to_world: Float[Tensor, "4 4"]
    near_plane: float = NEAR_PLANE

    @classmethod
    def of(cls, intrinsics: Intrinsics, camera_to_world: Float[Tensor, "4 4"]) -> Camera:
        """The camera of these intrinsics at a pose."""
        k = intrinsics
        return cls(k.fx, k.fy, k.cx, k.cy, k.width, k.height, camera_to_world)

    @property
    def intrinsics(self) -> Intrinsics:
        """The camera without its pose."""
        return Intrinsics(self.fx, self.fy, self.cx, self.cy, self.width, self.height)

    @property
    def center(self) -> Float[Tensor, "3"]:
        """Optical centre in the world. [3]"""
        return self.camera_to_world[:3, 3]

    @property
    def optical_axis(self) -> Float[Tensor, "3"]:
        """Unit viewing direction in the world. [3]"""
        axis = self.camera_to_world[:3, 2]
        return axis / axis.norm()

    @property
    def world_to_camera(self) -> Float[Tensor, "4 4"]:
        """Inverse of :attr:`camera_to_world`, using that it is rigid. [4, 4]"""
        rotation = self.camera_to_world[:3, :3].T
        inverse = torch.eye(4, dtype=rotation.dtype, device=rotation.device)
        inverse[:3, :3] = rotation
        inverse[:3, 3] = -rotation @ self.center
        return inverse

    @property
    def intrinsics_matrix(self) -> Float[Tensor, "3 3"]:
        """K for pixel centres at integers + 0.5. [3, 3]"""
        matrix = ((self.fx, 0.0, self.cx), (0.0, self.fy, self.cy), (0.0, 0.0, 1.0))
        return constant(matrix, self.camera_to_world).clone()

    def rays(self) -> Float[Tensor, "H W 3"]:
        """World directions through the pixel centres, scaled to z-depth 1: the point at depth z is center + z * ray."""
        like = self.camera_to_world
        x = (torch.arange(self.width, dtype=like.dtype, device=like.device) + 0.5 - self.cx) / self.fx
        y = (torch.arange(self.height, dtype=like.dtype, device=like.device) + 0.5 - self.cy) / self.fy
        directions = torch.stack(
            [x.expand(self.height, -1), y[:, None].expand(-1, self.width), torch.ones_like(x).expand(self.height, -1)],
            dim=-1,
        )
        return directions @ self.camera_to_world[:3, :3].T

    def rays_at(self, pixels: Int[Tensor, "P 2"]) -> Float[Tensor, "P 3"]:
        """World directions through some pixel centres, given as columns and rows, scaled to z-depth 1."""
        like = self.camera_to_world
        column, row = (pixels.to(like.device, like.dtype) + 0.5).unbind(1)
        local = [(column - self.cx) / self.fx, (row - self.cy) / self.fy, torch.ones_like(row)]
        return torch.stack(local, dim=-1) @ like[:3, :3].T

    def project(self, points: Float[Tensor, "N 3"]) -> tuple[Float[Tensor, "N 2"], Float[Tensor, "N"]]:
        """Pixel positions (column, row) and z-depths of world points.

        Points at or behind the camera plane project nowhere useful: look at the depth first.
        """
        local = (points - self.center) @ self.camera_to_world[:3, :3]
        x, y, z = local.unbind(-1)
        return torch.stack([self.fx * x / z + self.cx, self.fy * y / z + self.cy], dim=-1), z

    def sees(self, points: Float[Tensor, "N 3"]) -> tuple[Float[Tensor, "N"], Bool[Tensor, "N"]]:
        """z-depths of world points, and which are in front of the camera and inside its image, occluded or not."""
        pixels, depth = self.project(points)
        return depth, self.is_inside(pixels, depth)

    def is_inside(self, pixels: Float[Tensor, "N 2"], depth: Float[Tensor, "N"]) -> Bool[Tensor, "N"]:
        """Mask of points, projected to columns and rows at z-depths, in front of the camera and inside its image."""
        inside = ((pixels >= 0) & (pixels < constant((self.width, self.height), pixels))).all(dim=-1)
        return inside & (depth > 0)

    def unproject(self, depth: Float[Tensor, "H W"]) -> Float[Tensor, "H W 3"]:
        """World position of every pixel at its z-depth (NaN where the depth is NaN). [H, W, 3]"""
        return self.center + depth[..., None] * self.rays()

    def moved(self, rotation: Float[Tensor, "3"], translation: Float[Tensor, "3"], depth: float) -> Camera:
        """The camera turned about the point on its optical axis at a z-depth, and then moved; differentiable in both.

        Args:
            rotation: Rotation vector, radians, world axes. [3]
            translation: World axes, scene units. [3]
            depth: Scene units. About its own centre, a small turn would shift the image almost as a translation does,
                and gradient descent could hardly tell the two apart.
        """
        pose = self.camera_to_world
        turn, arm = rotation_of_vector(rotation.to(pose)), depth * pose[:3, 2]
        center = pose[:3, 3] + translation.to(pose) + arm - turn @ arm
        upper = torch.cat([turn @ pose[:3, :3], center[:, None]], dim=1)
        return replace(self, camera_to_world=torch.cat([upper, pose[3:]]))

    def scaled(self, factor: float) -> Camera:
        """The camera in a world whose lengths are ``factor`` times as large."""
        pose = self.camera_to_world.clone()
        pose[:3, 3] *= factor
        return replace(self, camera_to_world=pose, near_plane=factor * self.near_plane)

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Camera:
        """Return the camera with its pose on another device or of another dtype."""
        pose = self.camera_to_world if device is None else sent(self.camera_to_world, device)
        return replace(self, camera_to_world=pose.to(dtype=dtype))
