"""What the neighbours' depth maps say about the depth of a pixel."""

from __future__ import annotations

import numpy as np

from coliags_plugin.core.numba_kernels.compilation import Array, kernel


@kernel
def reproject(
    depth: Array,  # first guess of z-depth; float32 [H, W]
    other: Array,  # z-depth of the neighbour; NaN where unknown; float32 [h, w]
    weight: Array,  # of its pixels; float32 [h, w]
    turn: Array,  # pixel of the reference at z-depth 1 -> homogeneous pixel of the neighbour, in its units of z; [3, 3]
    shift: Array,  # homogeneous pixel of the reference's centre in the neighbour; [3]
    back: Array,  # pixel of the neighbour at z-depth 1 -> z-depth in the reference; a row; [3]
    origin: np.float32,  # z-depth of the neighbour's centre in the reference
    steps: int,  # largest number of iterations
    tolerance: np.float32,  # relative change of depth at which they have converged
    reprojected: Array,  # written: z-depth in the reference; NaN where the rays do not meet; float32 [H, W]
    trust: Array,  # written: weight of the neighbour's pixel; float32 [H, W]
) -> None:
    """Where the rays of one camera meet the depth map of another, by fixed-point iteration from a first guess."""
    height, width = depth.shape
    rows, columns = other.shape
    for y in range(height):
        cy = np.float32(y) + np.float32(0.5)
        for x in range(width):
            cx = np.float32(x) + np.float32(0.5)
            reprojected[y, x] = np.nan
            trust[y, x] = 0.0
            z = depth[y, x]
            if not z > 0.0:
                continue
            for _ in range(steps):
                pz = (turn[2, 0] * cx + turn[2, 1] * cy + turn[2, 2]) * z + shift[2]
                if not pz > np.float32(1e-3) * z:
                    break
                u = ((turn[0, 0] * cx + turn[0, 1] * cy + turn[0, 2]) * z + shift[0]) / pz
                v = ((turn[1, 0] * cx + turn[1, 1] * cy + turn[1, 2]) * z + shift[1]) / pz
                a, b = u - np.float32(0.5), v - np.float32(0.5)
                if not (a >= 0.0 and b >= 0.0 and a < columns - 1 and b < rows - 1):
                    break
                i, j = int(a), int(b)
                fx, fy = a - np.float32(i), b - np.float32(j)
                d00, d01, d10, d11 = other[j, i], other[j, i + 1], other[j + 1, i], other[j + 1, i + 1]
                low, high = min(min(d00, d01), min(d10, d11)), max(max(d00, d01), max(d10, d11))
                if not high < np.float32(1.08) * low:  # an edge, or unknown: the nearest pixel
                    sampled = other[int(v), int(u)]
                else:
                    top, bottom = d00 + fx * (d01 - d00), d10 + fx * (d11 - d10)
                    sampled = top + fy * (bottom - top)
                if not sampled > 0.0:
                    break
                after = (back[0] * u + back[1] * v + back[2]) * sampled + origin
                if not after > 0.0:
                    break
                if abs(after - z) <= tolerance * z:
                    reprojected[y, x] = after
                    trust[y, x] = weight[int(v), int(u)]
                    break
                z = after


@kernel
def vote(
    depth: Array,  # the frame's own z-depth; float32 [H, W]
    own: Array,  # its weight; float32 [H, W]
    candidates: Array,  # z-depths by the neighbours; NaN where there is none; float32 [N, H, W]
    trusts: Array,  # their weights; float32 [N, H, W]
    tolerance: np.float32,  # relative difference from the median of one that agrees; the group is twice as wide
    fused: Array,  # written: z-depth; float32 [H, W]
    votes: Array,  # written: weight of the candidates that agree with it, its own included; float32 [H, W]
    against: Array,  # written: weight of those that do not; float32 [H, W]
    spread: Array,  # written: weighted mean relative deviation within the group; float32 [H, W]
) -> None:
    """Weighted median of the densest group of the candidates."""
    count, height, width = candidates.shape
    values = np.empty(count + 1, np.float32)
    weights = np.empty(count + 1, np.float32)
    for y in range(height):
        for x in range(width):
            n = 0
            for k in range(count + 1):
                value = depth[y, x] if k == count else candidates[k, y, x]
                weight = own[y, x] if k == count else trusts[k, y, x]
                if value > 0.0 and weight > 0.0:
                    slot = n
                    while slot > 0 and values[slot - 1] > value:
                        values[slot], weights[slot] = values[slot - 1], weights[slot - 1]
                        slot -= 1
                    values[slot], weights[slot] = value, weight
                    n += 1
            if n == 0:
                fused[y, x], votes[y, x], against[y, x], spread[y, x] = depth[y, x], 0.0, 0.0, 1.0
                continue
            # The candidate amid the densest group, by a kernel as wide as four tolerances to either side.
            most, centre, total = np.float32(-1.0), values[0], np.float32(0.0)
            for k in range(n):
                total += weights[k]
                density, wide = np.float32(0.0), np.float32(4.0) * tolerance * values[k]
                for j in range(n):
                    away = (values[j] - values[k]) / wide
                    if -1.0 < away < 1.0:
                        density += weights[j] * (np.float32(1.0) - away * away)
                if density > most:
                    most, centre = density, values[k]
            wide = np.float32(2.0) * tolerance * centre
            first, last, inside = n, 0, np.float32(0.0)
            for k in range(n):
                if abs(values[k] - centre) <= wide:
                    first, last = min(first, k), k + 1
                    inside += weights[k]
            reached, middle = np.float32(0.0), centre
            for k in range(first, last):  # the median, between two values where the weight is halved between them
                reached += weights[k]
                if reached >= np.float32(0.5) * inside:
                    middle = values[k]
                    if k + 1 < last and reached <= np.float32(0.500001) * inside:
                        middle = np.float32(0.5) * (values[k] + values[k + 1])
                    break
            agree, away = np.float32(0.0), np.float32(0.0)
            for k in range(n):
                difference = abs(values[k] - middle) / middle
                if difference <= tolerance:
                    agree += weights[k]
                if first <= k < last:
                    away += weights[k] * difference
            fused[y, x], votes[y, x], against[y, x], spread[y, x] = middle, agree, total - agree, away / inside
