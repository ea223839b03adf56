"""Matching costs of depth hypotheses by zero-mean normalised cross-correlation, and their semi-global aggregation."""

from __future__ import annotations

import numpy as np

from coliags_plugin.core.numba_kernels.compilation import Array, kernel, part


@part
def _warp(
    base: Array, ratio: float, image: Array, usable: Array, turn: Array, shift: Array, out: Array, visible: Array
) -> None:
    """Sample a neighbour's image at the surface ``base * ratio`` of the reference, bilinearly."""
    height, width = base.shape
    rows, columns = image.shape
    for y in range(height):
        cy = np.float32(y) + np.float32(0.5)
        ax = turn[0, 1] * cy + turn[0, 2]
        ay = turn[1, 1] * cy + turn[1, 2]
        az = turn[2, 1] * cy + turn[2, 2]
        for x in range(width):
            cx = np.float32(x) + np.float32(0.5)
            z = base[y, x] * ratio
            pz = (turn[2, 0] * cx + az) * z + shift[2]
            visible[y, x] = 0.0
            out[y, x] = 0.0
            if not pz > np.float32(1e-3) * z:
                continue
            scale = np.float32(1.0) / pz
            u = ((turn[0, 0] * cx + ax) * z + shift[0]) * scale - np.float32(0.5)
            v = ((turn[1, 0] * cx + ay) * z + shift[1]) * scale - np.float32(0.5)
            if not (u >= 0.0 and v >= 0.0 and u < columns - 1 and v < rows - 1):
                continue
            i, j = int(u), int(v)
            if usable[j, i] == 0 or usable[j + 1, i + 1] == 0:
                continue
            fx, fy = u - np.float32(i), v - np.float32(j)
            top = image[j, i] + fx * (image[j, i + 1] - image[j, i])
            bottom = image[j + 1, i] + fx * (image[j + 1, i + 1] - image[j + 1, i])
            out[y, x] = top + fy * (bottom - top)
            visible[y, x] = 1.0


@part
def _correlate(
    reference: Array, warped: Array, visible: Array, radius: int, floor: float, least: float, out: Array
) -> None:
    """ZNCC of two images in square windows, of their common pixels; NaN where these are too few.

    Sums run along columns, then along rows. ``floor`` is added to both variances.
    """
    height, width = reference.shape
    sums = np.zeros((6, width))
    for y in range(-radius, height):
        for row, sign in ((y + radius, 1.0), (y - radius - 1, -1.0)):
            if 0 <= row < height:
                for x in range(width):
                    s = visible[row, x]
                    a, b = s * reference[row, x], s * warped[row, x]
                    sums[0, x] += sign * s
                    sums[1, x] += sign * a
                    sums[2, x] += sign * b
                    sums[3, x] += sign * (a * a)
                    sums[4, x] += sign * (b * b)
                    sums[5, x] += sign * (a * b)
        if y < 0:
            continue
        n, sa, sb, saa, sbb, sab = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for x in range(-radius, width):
            for column, sign in ((x + radius, 1.0), (x - radius - 1, -1.0)):
                if 0 <= column < width:
                    n += sign * sums[0, column]
                    sa += sign * sums[1, column]
                    sb += sign * sums[2, column]
                    saa += sign * sums[3, column]
                    sbb += sign * sums[4, column]
                    sab += sign * sums[5, column]
            if x < 0:
                continue
            if n < least:
                out[y, x] = np.nan
                continue
            each = 1.0 / n
            va = saa * each - sa * sa * each * each + floor
            vb = sbb * each - sb * sb * each * each + floor
            cov = sab * each - sa * sb * each * each
            out[y, x] = cov / np.sqrt(max(va, floor) * max(vb, floor))


@kernel
def sweep(
    base: Array,  # z-depth of the surface that is swept; float32 [H, W]
    ratios: Array,  # factors on it; float32 [D]
    reference: Array,  # guide image (log intensity); float32 [H, W]
    usable: Array,  # 0 where the reference is masked; float32 [H, W]
    images: Array,  # guides of the neighbours; float32 [N, h, w]
    masks: Array,  # 0 where a neighbour is masked; uint8 [N, h, w]
    turns: Array,  # pixel of the reference at z-depth 1 -> homogeneous pixel of the neighbour; float32 [N, 3, 3]
    shifts: Array,  # homogeneous pixel of the reference's centre in the neighbour; float32 [N, 3]
    radius: int,  # of the windows, pixels
    floor: float,  # variance of the guides' noise
    share: float,  # part of the neighbours that counts at each pixel, the best ones
    cost: Array,  # written; 0 (equal) to 2, 1 where less than a quarter of the neighbours see it; float32 [H, W, D]
) -> None:
    """Costs of the hypotheses ``base * ratios[d]``: one minus the mean of the best correlations with the neighbours."""
    height, width = base.shape
    count = images.shape[0]
    warped = np.empty((height, width), np.float32)
    visible = np.empty((height, width), np.float32)
    scores = np.empty((count, height, width), np.float32)
    best = np.empty(count, np.float32)
    least = 0.5 * (2 * radius + 1) ** 2
    fewest = min(count, max(2, (count + 3) // 4))
    for d in range(len(ratios)):
        for n in range(count):
            _warp(base, ratios[d], images[n], masks[n], turns[n], shifts[n], warped, visible)
            for y in range(height):
                for x in range(width):
                    visible[y, x] *= usable[y, x]
            _correlate(reference, warped, visible, radius, floor, least, scores[n])
        for y in range(height):
            for x in range(width):
                valid = 0
                for n in range(count):
                    value = scores[n, y, x]
                    if not value == value:
                        continue
                    rank = valid
                    while rank > 0 and best[rank - 1] < value:
                        best[rank] = best[rank - 1]
                        rank -= 1
                    best[rank] = value
                    valid += 1
                taken = int(np.ceil(share * valid))
                if valid < fewest:
                    cost[y, x, d] = 1.0
                    continue
                total = np.float32(0.0)
                for rank in range(taken):
                    total += best[rank]
                cost[y, x, d] = max(np.float32(0.0), np.float32(1.0) - total / np.float32(taken))


@part
def _path_step(cost: Array, before: Array, least: float, jump: float, small: float, into: Array, total: Array) -> float:
    """One step of a path: Hirschmueller's recurrence. Returns the least value of ``into``."""
    count = len(cost)
    lowest = np.float32(np.inf)
    for d in range(count):
        value = min(before[d], least + jump)
        if d > 0:
            value = min(value, before[d - 1] + small)
        if d + 1 < count:
            value = min(value, before[d + 1] + small)
        value = cost[d] + value - least
        into[d] = value
        total[d] += value
        lowest = min(lowest, value)
    return lowest


@kernel
def aggregate(
    cost: Array, guide: Array, small: np.float32, large: np.float32, contrast: np.float32, total: Array
) -> None:
    """Sum of the path costs over eight directions.

    ``guide``: image whose edges make jumps cheaper. Penalty of a change by one hypothesis: ``small`` (P1); of any
    greater one: ``large`` (P2) divided by ``1 + contrast * |difference of the guide|``, and not less than ``small``.
    Costs are float32 [H, W, D].
    """
    height, width, count = cost.shape
    total[:] = 0.0
    # Of the path before, by rows: this one and the one before it.
    paths = np.empty((2, width, count), np.float32)
    lowest = np.empty((2, width), np.float32)
    start = np.zeros(count, np.float32)
    for way in (1, -1):
        rows = range(height) if way > 0 else range(height - 1, -1, -1)
        columns = range(width) if way > 0 else range(width - 1, -1, -1)
        # Along the row, and from the row before, straight and along both diagonals.
        for down, right in ((0, way), (way, -1), (way, 0), (way, 1)):
            for y in rows:
                for x in columns:
                    above, aside = y - down, x - right
                    into, sums = paths[y % 2, x], total[y, x]
                    if 0 <= above < height and 0 <= aside < width:
                        edge = abs(guide[y, x] - guide[above, aside])
                        jump = max(small, large / (np.float32(1.0) + contrast * edge))
                        before, least = paths[above % 2, aside], lowest[above % 2, aside]
                        lowest[y % 2, x] = _path_step(cost[y, x], before, least, jump, small, into, sums)
                    else:
                        lowest[y % 2, x] = _path_step(cost[y, x], start, np.float32(0.0), large, small, into, sums)


@kernel
def pick(total: Array, cost: Array, rivals: int, index: Array, match: Array, margin: Array) -> None:
    """The hypothesis of the least aggregated cost, to a part of a step by a parabola.

    ``rivals``: how many hypotheses before the best one must have been compared, where there are as many: at the rim of
    an image, what is near leaves the neighbours' views, and what is left wins for want of rivals. Written, float32
    [H, W]: ``index``, the fractional position; ``match``, the correlation at it before aggregation, -1 to 1, 0 without
    its rivals; ``margin``, by how much the aggregated cost of any hypothesis more than two steps away is greater, of
    those with a cost other than exactly 1, which says that nothing was compared.
    """
    height, width, count = total.shape
    for y in range(height):
        for x in range(width):
            costs = total[y, x]
            best = 0
            for d in range(1, count):
                if costs[d] < costs[best]:
                    best = d
            second = np.float32(np.inf)
            for d in range(count):
                if abs(d - best) > 2 and cost[y, x, d] != 1.0:
                    second = min(second, costs[d])
            offset = np.float32(0.0)
            if 0 < best < count - 1:
                bend = costs[best - 1] - np.float32(2.0) * costs[best] + costs[best + 1]
                if bend > np.float32(1e-6):
                    offset = np.float32(0.5) * (costs[best - 1] - costs[best + 1]) / bend
            index[y, x] = np.float32(best) + offset
            match[y, x] = np.float32(1.0) - cost[y, x, best]
            for d in range(max(0, best - rivals), best):
                if cost[y, x, d] == 1.0:
                    match[y, x] = 0.0
            margin[y, x] = second - costs[best] if second < np.inf else np.float32(0.0)
