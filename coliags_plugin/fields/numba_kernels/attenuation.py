"""The law of attenuation of Gaussians' colours, and its derivatives, for sixteen Gaussians at a time.

Tables are flat float32 arrays in row-major order, of N >= 16 Gaussians; the last vector overlaps the one before. ``lamp`` is the
lamp's position, then the optical axis, then the smallest values that the law is computed at, as the reference distance.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from coliags_plugin.core.numba_kernels import lanes as vec
from coliags_plugin.core.numba_kernels.compilation import inline, kernel, part
from coliags_plugin.core.numba_kernels.threads import Crew, pieces
from coliags_plugin.core.tensors import tables

#: Parts of the Gaussians whose sums are kept apart, so that they do not depend on the number of threads.
SLABS = 32
# As long as the sums of a slab: derivatives with respect to nine exponents, to the lamp's position and to the optical axis.
_SUMS = (0,) * 15


def attenuated(
    colors: Float[Tensor, "N 3"],
    lamp: Float[Tensor, "3"],
    axis: Float[Tensor, "3"],
    exponents: Float[Tensor, "3 3"],
    positions: Float[Tensor, "N 3"],
    normals: Float[Tensor, "N 3"] | None,
    bounds: Float[Tensor, "2 3"],
) -> Float[Tensor, "N 3"]:
    """Colours times the law, differentiable once in the first four arguments; without normals incidence is 1.

    ``bounds`` are the smallest values that the law is computed at, then three times the reference distance.
    """
    facing = colors.new_empty(0) if normals is None else normals
    result: Tensor = _Attenuate.apply(colors, lamp, axis, exponents, positions, facing, bounds)  # type: ignore[no-untyped-call]
    return result


class _Attenuate(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, colors: Tensor, lamp: Tensor, axis: Tensor, exponents: Tensor, *others: Tensor) -> Tensor:
        positions, facing, bounds = others
        view = torch.cat([lamp.detach(), axis.detach(), bounds.flatten()])
        ctx.seen = tables(colors, positions, facing, view, exponents)
        result = torch.empty(colors.shape)
        Crew().run(attenuate, *ctx.seen, *tables(result))
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, of_result: Tensor) -> tuple[Tensor | None, ...]:
        of_colors, sums = torch.empty(of_result.shape), torch.empty(SLABS, 16)
        Crew().run(attenuate_backward, *ctx.seen, *tables(of_result, of_colors, sums))
        total = sums.sum(0)
        # Of logarithms to base 2, and of their powers, the exponents' derivatives have the factor ln 2.
        return of_colors, total[9:12], total[12:15], math.log(2.0) * total[:9].view(3, 3), None, None, None


@kernel
def attenuate(counters, colors, positions, normals, lamp, exponents, result):
    """Write colours times the law. ``normals`` may be empty; ``exponents`` are those of three channels. [3, 3]"""
    count = len(colors) // 3
    for slab in pieces(counters, 0, SLABS):
        begin, end = _part_of(slab, count)
        for first in range(begin, end, vec.WIDTH):
            at = min(first, count - vec.WIDTH)
            logs = _seen(at, positions, normals, lamp)[0]
            color = vec.load_columns(colors, 3 * at, (0, 0, 0))
            vec.store_columns(result, 3 * at, vec.mul(color, _factors(logs, exponents)))


@kernel
def attenuate_backward(counters, colors, positions, normals, lamp, exponents, gradients, of_colors, sums):
    """Write the derivatives of :func:`attenuate` with respect to colours, and the sums of each slab. [SLABS, 16]"""
    count = len(colors) // 3
    three = (0, 0, 0)
    for slab in pieces(counters, 0, SLABS):
        total = vec.repeat(0.0, _SUMS)
        begin, end = _part_of(slab, count)
        for first in range(begin, end, vec.WIDTH):
            at = min(first, count - vec.WIDTH)
            logs, ray, inverse_square, axis, depth, normal, facing, counted = _seen(at, positions, normals, lamp)
            factors = _factors(logs, exponents)
            of_result = vec.load_columns(gradients, 3 * at, three)
            of_color = vec.mul(of_result, factors)
            vec.store_columns(of_colors, 3 * at, of_color)
            # With respect to the logarithms of the channels' factors; 0 in lanes that the vector before had.
            of_log = vec.mul(of_color, vec.load_columns(colors, 3 * at, three))
            of_log = vec.mul(of_log, vec.select(vec.at_least(vec.lane_numbers(), float(first - at)), 1.0, 0.0))
            red, green, blue = of_log
            of_exponents = vec.mul(logs, red) + vec.mul(logs, green) + vec.mul(logs, blue)
            # With respect to the logarithms of distance, cosine and incidence, 0 where these are bounded.
            of_a = vec.mul(counted[0], _weighted(of_log, exponents, 0))
            of_b = vec.mul(counted[1], _weighted(of_log, exponents, 1))
            of_c = vec.mul(counted[2], _weighted(of_log, exponents, 2))
            along = vec.mul(vec.sub(of_a, vec.add(of_b, of_c)), inverse_square)
            of_depth = vec.quick_div(of_b, depth)
            of_ray = vec.fma(ray, along, vec.fma(axis, of_depth, vec.mul(normal, vec.quick_div(of_c, facing))))
            total = vec.add(total, of_exponents + vec.neg(of_ray) + vec.mul(ray, of_depth))
        vec.store(sums, slab * 16, vec.lane_sums(total))


@inline
def _seen(at, positions, normals, lamp):
    """Terms of the law for sixteen Gaussians: base-2 logarithms of relative distance, cosine and incidence first.

    Then what their derivatives need: the ray from the lamp, its inverse square, the optical axis, the ray's depth along it, the normal, the ray's depth
    along that, and 1 for each logarithm, 0 where its argument is bounded.
    """
    place, axis = vec.broadcast_all(lamp, 0, (0, 0, 0)), vec.broadcast_all(lamp, 3, (0, 0, 0))
    ray = vec.sub(vec.load_columns(positions, 3 * at, (0, 0, 0)), place)
    square = vec.larger(vec.dot(ray, ray, 0.0), 1e-18)
    distance = vec.sqrt(square)
    depth = vec.dot(ray, axis, 0.0)
    ratio, cosine = vec.div(distance, vec.broadcast(lamp, 9)), vec.div(depth, distance)
    if len(normals):
        normal = vec.load_columns(normals, 3 * at, (0, 0, 0))
        facing = vec.dot(ray, normal, 0.0)
        incidence = vec.div(vec.larger(facing, vec.neg(facing)), distance)
    else:
        normal, facing, incidence = vec.repeat(0.0, (0, 0, 0)), vec.splat(1.0), vec.splat(1.0)
    arguments = (ratio, cosine, incidence)
    least = vec.broadcast_all(lamp, 6, (0, 0, 0))
    logs = vec.log2(vec.larger(arguments, least))
    counted = (
        vec.select(vec.at_least(arguments[0], least[0]), 1.0, 0.0),
        vec.select(vec.at_least(arguments[1], least[1]), 1.0, 0.0),
        vec.select(vec.at_least(arguments[2], least[2]), 1.0, 0.0),
    )
    return logs, ray, vec.div(1.0, square), axis, depth, normal, facing, counted


@inline
def _factors(logs, exponents):
    """The law in three channels."""
    powers = (
        vec.dot(logs, vec.broadcast_all(exponents, 0, (0, 0, 0)), 0.0),
        vec.dot(logs, vec.broadcast_all(exponents, 3, (0, 0, 0)), 0.0),
        vec.dot(logs, vec.broadcast_all(exponents, 6, (0, 0, 0)), 0.0),
    )
    return vec.exp2(vec.larger(vec.smaller(powers, 126.0), -126.0))


@inline
def _weighted(of_log, exponents, column):
    """Derivative with respect to one logarithm: the sum over channels of gradient times exponent."""
    total = vec.mul(of_log[0], vec.broadcast(exponents, column))
    total = vec.fma(of_log[1], vec.broadcast(exponents, 3 + column), total)
    return vec.fma(of_log[2], vec.broadcast(exponents, 6 + column), total)


@part
def _part_of(slab, count):
    """The first Gaussian of a slab, and the end."""
    groups = -(-count // vec.WIDTH)
    size = -(-groups // SLABS) * vec.WIDTH
    return min(slab * size, count), min((slab + 1) * size, count)
