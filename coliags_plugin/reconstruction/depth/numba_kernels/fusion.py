"""What the neighbours' depth maps say about the depth of a pixel."""

from __future__ import annotations

import numpy as np

from coliags_plugin.core.numba_kernels import lanes as vec
from coliags_plugin.core.numba_kernels.compilation import Array, inline, kernel
from coliags_plugin.reconstruction.depth.numba_kernels.corners import corners


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
    """Where the rays of one camera meet the depth map of another, by fixed-point iteration from a first guess."""
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
            change = _distance(after, z)
            there = vec.both(going, vec.at_most(change, vec.mul(z, tolerance)))
            met = vec.select(there, after, met)
            column, line = vec.add(i, vec.select(right, 1.0, 0.0)), vec.add(j, vec.select(below, 1.0, 0.0))
            place = vec.select(there, vec.fma(line, columns, column), place)
            going = vec.both(going, vec.greater(change, vec.mul(z, tolerance)))
            z = vec.select(going, after, z)
        vec.store(reprojected, at, met)
        vec.store(trust, at, vec.select(vec.at_least(met, met), vec.gather(weights, 0, place), 0.0))


@kernel
def vote(
    depth: Array,  # the frame's own z-depth; float32 [P], P a multiple of sixteen
    own: Array,  # its weight; float32 [P]
    candidates: Array,  # z-depths by the neighbours; NaN where there is none; float32 [N, P]
    trusts: Array,  # their weights; float32 [N, P]
    tolerance: np.float32,  # relative difference from the median of one that agrees; the group is twice as wide
    fused: Array,  # written: z-depth; float32 [P]
    votes: Array,  # written: weight of the candidates that agree with it, its own included; float32 [P]
    against: Array,  # written: weight of those that do not; float32 [P]
    spread: Array,  # written: weighted mean relative deviation within the group; float32 [P]
) -> None:
    """Weighted median of the densest group of the candidates."""
    count = (len(candidates) + 1) * vec.WIDTH
    # Sixteen pixels' candidates, ascending, and one more.
    values = np.full(count + vec.WIDTH, np.inf, np.float32)
    weights = np.zeros(count + vec.WIDTH, np.float32)
    for at in range(0, len(depth), vec.WIDTH):
        total = vec.splat(0.0)
        for n in range(len(candidates) + 1):
            if n < len(candidates):
                value, weight = vec.load(candidates[n], at), vec.load(trusts[n], at)
            else:
                value, weight = vec.load(depth, at), vec.load(own, at)
            counts = vec.both(vec.greater(value, 0.0), vec.greater(weight, 0.0))
            value, weight = vec.select(counts, value, np.inf), vec.select(counts, weight, 0.0)
            for k in range(0, n * vec.WIDTH, vec.WIDTH):
                other, of_other = vec.load(values, k), vec.load(weights, k)
                later = vec.greater(other, value)
                vec.store(values, k, vec.select(later, value, other))
                vec.store(weights, k, vec.select(later, weight, of_other))
                value, weight = vec.select(later, other, value), vec.select(later, of_other, weight)
            vec.store(values, n * vec.WIDTH, value)
            vec.store(weights, n * vec.WIDTH, weight)
        # The candidate amid the densest group, by a kernel as wide as four tolerances to either side.
        most, centre = vec.splat(-1.0), vec.splat(1.0)
        for k in range(0, count, vec.WIDTH):
            value, density = vec.load(values, k), vec.splat(0.0)
            total = vec.add(total, vec.load(weights, k))
            wide = vec.mul(value, np.float32(4.0) * tolerance)
            for j in range(0, count, vec.WIDTH):
                away = vec.div(vec.sub(vec.load(values, j), value), wide)
                near = vec.both(vec.greater(away, -1.0), vec.less(away, 1.0))
                share = vec.mul(vec.load(weights, j), vec.sub(1.0, vec.mul(away, away)))
                density = vec.add(density, vec.select(near, share, 0.0))
            denser = vec.greater(density, most)
            most, centre = vec.select(denser, density, most), vec.select(denser, value, centre)
        wide, inside = vec.mul(centre, np.float32(2.0) * tolerance), vec.splat(0.0)
        for k in range(0, count, vec.WIDTH):
            grouped = vec.at_most(_distance(vec.load(values, k), centre), wide)
            inside = vec.add(inside, vec.select(grouped, vec.load(weights, k), 0.0))
        reached, middle, found = vec.splat(0.0), centre, vec.splat(0.0)
        for k in range(0, count, vec.WIDTH):  # the median, between two values where the weight is halved between them
            value, following = vec.load(values, k), vec.load(values, k + vec.WIDTH)
            grouped = vec.at_most(_distance(value, centre), wide)
            reached = vec.add(reached, vec.select(grouped, vec.load(weights, k), 0.0))
            halved = vec.both(
                vec.at_most(_distance(following, centre), wide), vec.at_most(reached, vec.mul(inside, 0.500001))
            )
            value = vec.select(halved, vec.mul(vec.add(value, following), 0.5), value)
            half = vec.both(vec.less(found, 1.0), vec.both(grouped, vec.at_least(reached, vec.mul(inside, 0.5))))
            middle, found = vec.select(half, value, middle), vec.select(half, 1.0, found)
        agree = away = vec.splat(0.0)
        for k in range(0, count, vec.WIDTH):
            value, weight = vec.load(values, k), vec.load(weights, k)
            difference = vec.div(_distance(value, middle), middle)
            agree = vec.add(agree, vec.select(vec.at_most(difference, tolerance), weight, 0.0))
            grouped = vec.at_most(_distance(value, centre), wide)
            away = vec.add(away, vec.select(grouped, vec.mul(weight, difference), 0.0))
        known = vec.greater(total, 0.0)
        vec.store(fused, at, vec.select(known, middle, vec.load(depth, at)))
        vec.store(votes, at, vec.select(known, agree, 0.0))
        vec.store(against, at, vec.select(known, vec.sub(total, agree), 0.0))
        vec.store(spread, at, vec.select(known, vec.div(away, inside), 1.0))


@inline
def _distance(a: vec.Vector, b: vec.Vector) -> vec.Vector:
    difference = vec.sub(a, b)
    return vec.larger(difference, vec.neg(difference))
