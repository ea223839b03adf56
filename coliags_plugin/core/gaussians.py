"""Gaussians of one view, the input of splatting renderers; rotations as quaternions and matrices."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class Gaussians:
    """3D Gaussians (or surfels) of one view, in the world frame and scene units.

    Attributes:
        means: Centres. [N, 3]
        quats_wxyz: Rotations, need not be normalised. [N, 4]
        scales: Standard deviations along the local axes; two for surfels. [N, 3] or [N, 2]
        opacities: In (0, 1]. [N]
        colors: RGB in [0, 1]. [N, 3]
        source_index: Which slot of the field each Gaussian comes from (the anchor field: anchor * children + child).
            [N]
        visible_sources: Field elements evaluated for this view, those that yielded no Gaussian included
            (the anchor field: anchors in the frustum). [V]
        features: Named channels that are composited like the colours, over 0; each comes out under its own name. [N, C]
    """

    means: Float[Tensor, "N 3"]
    quats_wxyz: Float[Tensor, "N 4"]
    scales: Float[Tensor, "N S"]
    opacities: Float[Tensor, "N"]
    colors: Float[Tensor, "N 3"]
    source_index: Int[Tensor, "N"]
    visible_sources: Int[Tensor, "V"]
    features: Mapping[str, Float[Tensor, "N C"]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.means)


def rotation_matrices(quats_wxyz: Float[Tensor, "N 4"]) -> Float[Tensor, "N 3 3"]:
    """Rotation matrices of quaternions of any length; the zero quaternion is the identity. [N, 3, 3]"""
    w, x, y, z = torch.nn.functional.normalize(quats_wxyz, dim=-1).unbind(-1)
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(rows, dim=-1).view(-1, 3, 3)


def rotation_of_vector(vector: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """The rotation of a rotation vector (axis times angle, radians), smooth about zero. [3, 3]"""
    x, y, z = vector.unbind()
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).view(3, 3)
    # Rodrigues' formula, for which no device is waited for: the sinc is smooth, and the norm has gradient 0 at zero.
    turns = vector.double().norm() / math.tau
    once, half = torch.sinc(2.0 * turns).to(vector.dtype), torch.sinc(turns).to(vector.dtype)
    return torch.eye(3, dtype=vector.dtype, device=vector.device) + once * cross + 0.5 * half.square() * cross @ cross


def shortest_axes(quats_wxyz: Float[Tensor, "N 4"], scales: Float[Tensor, "N S"]) -> Float[Tensor, "N 3"]:
    """Local axis of the smallest scale (or logarithm of one) of each Gaussian, in the frame its rotation leads to.

    The third axis where there are two scales. Differentiable in the quaternions; the choice of the axis is not.
    """
    if scales.shape[1] == 2:
        return third_axes(quats_wxyz)
    return shortest_columns(rotation_matrices(quats_wxyz), scales)


def shortest_columns(rotations: Float[Tensor, "N 3 3"], scales: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
    """Column of each rotation matrix that belongs to the smallest of three scales, or of their logarithms.

    The choice is not differentiable.
    """
    return rotations.gather(2, scales.argmin(1)[:, None, None].expand(-1, 3, 1)).squeeze(2)


def third_axes(quats_wxyz: Float[Tensor, "N 4"]) -> Float[Tensor, "N 3"]:
    """Third columns of :func:`rotation_matrices`. [N, 3]"""
    w, x, y, z = torch.nn.functional.normalize(quats_wxyz, dim=-1).unbind(-1)
    return torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], dim=-1)
