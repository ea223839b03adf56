"""Real spherical harmonics to degree 3, in the order and with the signs of 3D Gaussian Splatting."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

MAX_DEGREE = 3
#: Y_0, by which a colour becomes a coefficient of degree 0.
Y0 = 0.5 / math.sqrt(math.pi)

# Squares of the factors times pi, with the factors' signs, of degrees 1 to 3.
_SQUARES = (
    *(-3 / 4, 3 / 4, -3 / 4),
    *(15 / 4, -15 / 4, 5 / 16, -15 / 4, 15 / 16),
    *(-35 / 32, 105 / 4, -21 / 32, 7 / 16, -21 / 32, 105 / 16, -35 / 32),
)
#: Factors of the polynomials in :func:`basis`.
FACTORS = tuple(math.copysign(math.sqrt(abs(square) / math.pi), square) for square in _SQUARES)


def basis(directions: Float[Tensor, "N 3"], degree: int) -> Float[Tensor, "N B"]:
    """Values of the first (degree + 1)^2 functions at unit vectors, for degrees from 0 to 3.

    Degree by degree, order m from -degree to degree; odd powers of x and y carry the Condon-Shortley sign, as in 3DGS.
    """
    if not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"degree {degree}: expected 0 to {MAX_DEGREE}")
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    polynomials = [y, z, x]
    if degree >= 2:
        polynomials += [x * y, y * z, 3.0 * zz - 1.0, x * z, xx - yy]
    if degree >= 3:
        polynomials += [
            y * (3.0 * xx - yy),
            x * y * z,
            y * (5.0 * zz - 1.0),
            z * (5.0 * zz - 3.0),
            x * (5.0 * zz - 1.0),
            z * (xx - yy),
            x * (xx - 3.0 * yy),
        ]
    count = (degree + 1) ** 2 - 1
    values = [factor * polynomial for factor, polynomial in zip(FACTORS[:count], polynomials, strict=False)]
    return torch.stack([torch.full_like(x, Y0), *values], dim=-1)


def colors(coefficients: Float[Tensor, "N B 3"], directions: Float[Tensor, "N 3"], degree: int) -> Float[Tensor, "N 3"]:
    """Colours seen along unit vectors from the camera, up to a degree (docs/methods.md 7.1).

    max(0, sum of coefficients times basis + 0.5); coefficients of higher degrees do not count.
    """
    values = basis(directions, degree)
    return ((values[..., None] * coefficients[:, : values.shape[1]]).sum(1) + 0.5).clamp_min(0.0)
