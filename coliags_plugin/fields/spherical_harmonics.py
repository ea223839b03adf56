"""Real spherical harmonics to degree 3, in the order and with the signs of 3D Gaussian Splatting."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

MAX_DEGREE = 3
#: Y_0, by which a colour becomes a coefficient of degree 0.
Y0 = 0.5 / math.sqrt(math.pi)

_Y1 = math.sqrt(3.0 / (4.0 * math.pi))
_Y2 = tuple(math.sqrt(value / math.pi) for value in (15.0 / 4.0, 15.0 / 4.0, 5.0 / 16.0, 15.0 / 4.0, 15.0 / 16.0))
_Y3 = tuple(
    math.sqrt(value / math.pi)
    for value in (35.0 / 32.0, 105.0 / 4.0, 21.0 / 32.0, 7.0 / 16.0, 21.0 / 32.0, 105.0 / 16.0, 35.0 / 32.0)
)


def basis(directions: Float[Tensor, "N 3"], degree: int) -> Float[Tensor, "N B"]:
    """Values of the first (degree + 1)^2 functions at unit vectors, for degrees from 0 to 3.

    Degree by degree, order m from -degree to degree; odd powers of x and y carry the Condon-Shortley sign, as in 3DGS.
    """
    if not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"degree {degree}: expected 0 to {MAX_DEGREE}")
    x, y, z = directions.unbind(-1)
    values = [torch.full_like(x, Y0)]
    if degree >= 1:
        values += [-_Y1 * y, _Y1 * z, -_Y1 * x]
    if degree >= 2:
        a, b, c, d, e = _Y2
        values += [a * x * y, -b * y * z, c * (3.0 * z * z - 1.0), -d * x * z, e * (x * x - y * y)]
    if degree >= 3:
        a, b, c, d, e, f, g = _Y3
        values += [
            -a * y * (3.0 * x * x - y * y),
            b * x * y * z,
            -c * y * (5.0 * z * z - 1.0),
            d * z * (5.0 * z * z - 3.0),
            -e * x * (5.0 * z * z - 1.0),
            f * z * (x * x - y * y),
            -g * x * (x * x - 3.0 * y * y),
        ]
    return torch.stack(values, dim=-1)


def colors(coefficients: Float[Tensor, "N B 3"], directions: Float[Tensor, "N 3"], degree: int) -> Float[Tensor, "N 3"]:
    """Colours seen along unit vectors from the camera, up to a degree (docs/methods.md 7.1).

    max(0, sum of coefficients times basis + 0.5); coefficients of higher degrees do not count.
    """
    values = basis(directions, degree)
    return ((values[..., None] * coefficients[:, : values.shape[1]]).sum(1) + 0.5).clamp_min(0.0)
