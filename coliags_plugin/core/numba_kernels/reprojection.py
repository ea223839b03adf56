"""Intersection of the rays of a camera with the depth map of another."""

from __future__ import annotations

import numpy as np

from coliags_plugin.core.numba_kernels import lanes as vec
from coliags_plugin.core.numba_kernels.compilation import Array, inline, kernel, part


@part
def corners(image: Array, values: Array, start: int) -> None:
    """Write each pixel's value and those to the right, below and across, four numbers, from ``start`` on.

    Nothing is written for the last row and column.
    """
    height, width = image.shape
    table = values[start : start + 4 * image.size].reshape(height, width, 4)[:-1, :-1]
    table[:, :, 0], table[:, :, 1] = image[:-1, :-1], image[:-1, 1:]
    table[:, :, 2], table[:, :, 3] = image[1:, :-1], image[1:, 1:]


@kernel
def reproject(
    depth: Array,  # first guess of z-depth; float32, H W of rows of ``width`` and zeros up to a multiple of sixteen
    width: int,
    other: Array,  # z-depth of the neighbour, of less than 2^24 pixels; NaN where unknown; float32 [h, w]
    weight: Array,  # of its pixels; float32 [h, w]
    turn: Array,  # pixel of the reference at z-depth 1 -> homogeneous pixel of the neighbour, in its units of z; [3, 3]
    shift: Array,  # homogeneous pixel of the reference's centre in the neighbour; [3]
    back: Array,  # pixel of the neighbour at z-depth 1 -> z-depth in the reference; a row; [3]
    origin: np.float32,  # z-depth of the neighbour's centre in the reference
    steps: int,  # largest number of iterations
    tolerance: np.float32,  # relative change of depth at which they have converged
    reprojected: Array,  # written: z-depth in the reference; NaN where the rays do not meet; as ``depth``
    trust: Array,  # written: weight of the neighbour's pixel; as ``depth``
) -> None:
    """Intersect the rays of a camera with the depth map of another, by fixed-point iteration from a first guess."""
    rows, columns = other.shape
    values = np.zeros(4 * other.size, np.float32)
    corners(other, values, 0)
    weights = weight.reshape(weight.size)
    numbers = vec.lane_numbers()
    for at in range(0, len(depth), vec.WIDTH):
        pixel = vec.add(numbers, at)
        row = vec.floor(vec.div(vec.add(pixel, 0.5), width))
        cx, cy = vec.add(vec.fma(row, -width, pixel), 0.5), vec.add(row, 0.5)
        rx = vec.fma(cx, turn[0, 0], vec.fma(cy, turn[0, 1], turn[0, 2]))
        ry = vec.fma(cx, turn[1, 0], vec.fma(cy, turn[1, 1], turn[1, 2]))
        rz = vec.fma(cx, turn[2, 0], vec.fma(cy, turn[2, 1], turn[2, 2]))
        z = vec.load(depth, at)
        met, place = vec.splat(np.nan), vec.splat(0.0)
        going = vec.greater(z, 0.0)
        for _ in range(steps):
            pz = vec.fma(rz, z, shift[2])
            u, v = vec.div(vec.fma(rx, z, shift[0]), pz), vec.div(vec.fma(ry, z, shift[1]), pz)
            a, b = vec.sub(u, 0.5), vec.sub(v, 0.5)
            going = vec.both(going, vec.greater(pz, vec.mul(z, 1e-3)))
            going = vec.both(going, vec.both(vec.at_least(a, 0.0), vec.less(a, columns - 1)))
            going = vec.both(going, vec.both(vec.at_least(b, 0.0), vec.less(b, rows - 1)))
            if vec.bits(going) == 0:
                break
            a, b = vec.select(going, a, 0.0), vec.select(going, b, 0.0)
            i, j = vec.floor(a), vec.floor(b)
            fx, fy = vec.sub(a, i), vec.sub(b, j)
            d00, d01, d10, d11 = vec.gather_fours(values, 0, vec.fma(j, columns, i))
            low = vec.smaller(vec.smaller(d00, d01), vec.smaller(d10, d11))
            high = vec.larger(vec.larger(d00, d01), vec.larger(d10, d11))
            top, bottom = vec.fma(fx, vec.sub(d01, d00), d00), vec.fma(fx, vec.sub(d11, d10), d10)
            sampled = vec.fma(fy, vec.sub(bottom, top), top)
            # At an edge, or beside what is unknown: the nearest pixel.
            right, below = vec.at_least(fx, 0.5), vec.at_least(fy, 0.5)
            nearest = vec.select(below, vec.select(right, d11, d10), vec.select(right, d01, d00))
            smooth = vec.both(vec.less(high, vec.mul(low, 1.08)), vec.at_least(sampled, sampled))
            sampled = vec.select(smooth, sampled, nearest)
            after = vec.fma(vec.fma(u, back[0], vec.fma(v, back[1], back[2])), sampled, origin)
            going = vec.both(going, vec.both(vec.greater(sampled, 0.0), vec.greater(after, 0.0)))
            change = distance(after, z)
            there = vec.both(going, vec.at_most(change, vec.mul(z, tolerance)))
            met = vec.select(there, after, met)
            column, line = vec.add(i, vec.select(right, 1.0, 0.0)), vec.add(j, vec.select(below, 1.0, 0.0))
            place = vec.select(there, vec.fma(line, columns, column), place)
            going = vec.both(going, vec.greater(change, vec.mul(z, tolerance)))
            z = vec.select(going, after, z)
        vec.store(reprojected, at, met)
        vec.store(trust, at, vec.select(vec.at_least(met, met), vec.gather(weights, 0, place), 0.0))


@inline
def distance(a: vec.Vector, b: vec.Vector) -> vec.Vector:
    """Return the absolute difference."""
    difference = vec.sub(a, b)
    return vec.larger(difference, vec.neg(difference))
