"""Costs of depths by zero-mean normalised cross-correlation, semi-global aggregation, and fusion of depth maps."""

from __future__ import annotations

import numpy as np

from coliags_plugin.core.numba_kernels import lanes as vec
from coliags_plugin.core.numba_kernels.compilation import Array, kernel, part
from coliags_plugin.core.numba_kernels.reprojection import corners, distance


@kernel
def vote(
    depth: Array,  # the frame's own z-depth; float32 [P], P a multiple of sixteen
    own_weight: Array,  # its weight; float32 [P]
    candidates: Array,  # z-depths by the neighbours; NaN where there is none; float32 [N, P]
    trusts: Array,  # their weights; float32 [N, P]
    tolerance: np.float32,  # relative difference from the median of one that agrees; the group is twice as wide
    fused: Array,  # written: z-depth; float32 [P]
    votes: Array,  # written: weight of the candidates that agree with it, its own included; float32 [P]
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
                value, weight = vec.load(depth, at), vec.load(own_weight, at)
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
            grouped = vec.at_most(distance(vec.load(values, k), centre), wide)
            inside = vec.add(inside, vec.select(grouped, vec.load(weights, k), 0.0))
        reached, middle, is_found = vec.splat(0.0), centre, vec.splat(0.0)
        for k in range(0, count, vec.WIDTH):  # the median, between two values where the weight is halved between them
            value, following = vec.load(values, k), vec.load(values, k + vec.WIDTH)
            grouped = vec.at_most(distance(value, centre), wide)
            reached = vec.add(reached, vec.select(grouped, vec.load(weights, k), 0.0))
            halved = vec.both(
                vec.at_most(distance(following, centre), wide), vec.at_most(reached, vec.mul(inside, 0.500001))
            )
            value = vec.select(halved, vec.mul(vec.add(value, following), 0.5), value)
            half = vec.both(vec.less(is_found, 1.0), vec.both(grouped, vec.at_least(reached, vec.mul(inside, 0.5))))
            middle, is_found = vec.select(half, value, middle), vec.select(half, 1.0, is_found)
        agree = away = vec.splat(0.0)
        for k in range(0, count, vec.WIDTH):
            value, weight = vec.load(values, k), vec.load(weights, k)
            difference = vec.div(distance(value, middle), middle)
            agree = vec.add(agree, vec.select(vec.at_most(difference, tolerance), weight, 0.0))
            grouped = vec.at_most(distance(value, centre), wide)
            away = vec.add(away, vec.select(grouped, vec.mul(weight, difference), 0.0))
        has_weight = vec.greater(total, 0.0)
        vec.store(fused, at, vec.select(has_weight, middle, vec.load(depth, at)))
        vec.store(votes, at, vec.select(has_weight, agree, 0.0))
        vec.store(spread, at, vec.select(has_weight, vec.div(away, inside), 1.0))


#: Numbers before and behind each row of a table: more than the radius of a window.
_MARGIN = vec.WIDTH


@part
def _framed(image: Array, radius: int, row: int) -> Array:
    """An image as a table with rows of ``row`` numbers and a border of zeros."""
    height, width = image.shape
    framed = np.zeros((height + 2 * radius, row), np.float32)
    framed[radius : radius + height, _MARGIN : _MARGIN + width] = image
    return framed.reshape(framed.size)


@part
def _masked_corners(images: Array, masks: Array) -> Array:
    """Four values of each pixel, as by :func:`corners`; the first is NaN where it is masked, or the one across is."""
    count, height, width = images.shape
    values = np.zeros(4 * images.size, np.float32)
    for n in range(count):
        start = 4 * n * height * width
        corners(images[n], values, start)
        for y in range(height - 1):
            for x in range(width - 1):
                if masks[n, y, x] == 0 or masks[n, y + 1, x + 1] == 0:
                    values[start + 4 * (y * width + x)] = np.nan
    return values


@part
def _warp(
    base: Array,
    ratio: float,
    usable: Array,
    radius: int,
    row: int,
    values: Array,
    start: int,
    shape: tuple[int, int],
    turn: Array,
    shift: Array,
    warped: Array,
    visible: Array,
) -> None:
    """Sample a neighbour's image at the surface ``base * ratio`` of the reference, bilinearly; 0 where not visible."""
    rows, columns = shape
    numbers = vec.lane_numbers()
    for y in range(len(base) // row - 2 * radius):
        cy = np.float32(y) + np.float32(0.5)
        ax = turn[0, 1] * cy + turn[0, 2]
        ay = turn[1, 1] * cy + turn[1, 2]
        az = turn[2, 1] * cy + turn[2, 2]
        for x in range(0, row - 2 * _MARGIN, vec.WIDTH):
            at = (y + radius) * row + _MARGIN + x
            cx = vec.add(numbers, np.float32(x) + np.float32(0.5))
            z = vec.mul(vec.load(base, at), ratio)
            pz = vec.fma(vec.fma(cx, turn[2, 0], az), z, shift[2])
            scale = vec.div(1.0, pz)
            u = vec.fma(vec.fma(vec.fma(cx, turn[0, 0], ax), z, shift[0]), scale, -0.5)
            v = vec.fma(vec.fma(vec.fma(cx, turn[1, 0], ay), z, shift[1]), scale, -0.5)
            in_view = vec.both(vec.greater(pz, vec.mul(z, 1e-3)), vec.greater(vec.load(usable, at), 0.0))
            in_view = vec.both(in_view, vec.both(vec.at_least(u, 0.0), vec.less(u, columns - 1)))
            in_view = vec.both(in_view, vec.both(vec.at_least(v, 0.0), vec.less(v, rows - 1)))
            if vec.bits(in_view) == 0:
                vec.store(warped, at, 0.0)
                vec.store(visible, at, 0.0)
                continue
            u, v = vec.select(in_view, u, 0.0), vec.select(in_view, v, 0.0)
            i, j = vec.floor(u), vec.floor(v)
            fx, fy = vec.sub(u, i), vec.sub(v, j)
            place = vec.fma(j, columns, i)
            corner, right, below, across = vec.gather_fours(values, start, place)
            in_view = vec.both(in_view, vec.at_least(corner, corner))
            top = vec.fma(fx, vec.sub(right, corner), corner)
            bottom = vec.fma(fx, vec.sub(across, below), below)
            vec.store(warped, at, vec.select(in_view, vec.fma(fy, vec.sub(bottom, top), top), 0.0))
            vec.store(visible, at, vec.select(in_view, 1.0, 0.0))


@part
def _correlate(
    reference: Array,
    warped: Array,
    visible: Array,
    radius: int,
    row: int,
    floor: float,
    lines: Array,
    scores: Array,
    start: int,
) -> None:
    """ZNCC of two images in square windows, of their common pixels; NaN where these are less than half of the window.

    Sums are taken along columns, then in float64 along rows: variances of dark, flat wall are small differences of
    large sums. ``floor`` is added to both variances.
    """
    least = 0.5 * (2 * radius + 1) ** 2
    width = row - 2 * _MARGIN
    for y in range(len(reference) // row - 2 * radius):
        for x in range(0, row, vec.WIDTH):
            n = sa = sb = saa = sbb = sab = vec.splat(0.0)
            for at in range(y * row + x, (y + 2 * radius + 1) * row + x, row):
                s, b = vec.load(visible, at), vec.load(warped, at)
                a = vec.mul(vec.load(reference, at), s)
                n, sa, sb = vec.add(n, s), vec.add(sa, a), vec.add(sb, b)
                saa, sbb, sab = vec.fma(a, a, saa), vec.fma(b, b, sbb), vec.fma(a, b, sab)
            for k, value in enumerate((n, sa, sb, saa, sbb, sab)):
                vec.store(lines, k * row + x, value)
        for x in range(0, width, vec.WIDTH):
            n = vec.splat(0.0)
            sa = sb = saa = sbb = sab = vec.widen(vec.splat(0.0))
            for at in range(_MARGIN + x - radius, _MARGIN + x + radius + 1):
                n = vec.add(n, vec.load(lines, at))
                sa, sb = vec.add(sa, vec.load(lines, row + at)), vec.add(sb, vec.load(lines, 2 * row + at))
                saa, sbb = vec.add(saa, vec.load(lines, 3 * row + at)), vec.add(sbb, vec.load(lines, 4 * row + at))
                sab = vec.add(sab, vec.load(lines, 5 * row + at))
            count, noise = vec.widen(n), vec.mul(vec.mul(n, n), floor)
            va = vec.larger(vec.narrow(vec.sub(vec.mul(count, saa), vec.mul(sa, sa))), 0.0)
            vb = vec.larger(vec.narrow(vec.sub(vec.mul(count, sbb), vec.mul(sb, sb))), 0.0)
            product = vec.mul(vec.add(va, noise), vec.add(vb, noise))
            score = vec.div(vec.narrow(vec.sub(vec.mul(count, sab), vec.mul(sa, sb))), vec.sqrt(product))
            vec.store(scores, start + y * width + x, vec.select(vec.less(n, least), np.nan, score))


@part
def _mean_of_best(scores: Array, count: int, size: int, at: int, counted_of: Array, lowest: Array) -> vec.Vector:
    """One minus the mean of the best of sixteen pixels' scores; 1 where too few are known.

    ``counted_of``: how many of so many count, 0 for too few. ``lowest`` is for those that do not, the least first.
    """
    for k in range(0, len(lowest), vec.WIDTH):
        vec.store(lowest, k, np.inf)
    total = scored = vec.splat(0.0)
    for n in range(count):
        score = vec.load(scores, n * size + at)
        there = vec.at_least(score, score)
        total, scored = vec.add(total, vec.select(there, score, 0.0)), vec.add(scored, vec.select(there, 1.0, 0.0))
        score = vec.select(there, score, np.inf)
        for k in range(0, len(lowest), vec.WIDTH):
            other = vec.load(lowest, k)
            vec.store(lowest, k, vec.smaller(score, other))
            score = vec.larger(score, other)
    counted = vec.gather(counted_of, 0, scored)
    for k in range(0, len(lowest), vec.WIDTH):
        left_out = vec.greater(vec.sub(scored, counted), k // vec.WIDTH)
        total = vec.sub(total, vec.select(left_out, vec.load(lowest, k), 0.0))
    cost = vec.larger(0.0, vec.sub(1.0, vec.div(total, counted)))
    return vec.select(vec.greater(counted, 0.0), cost, 1.0)


@kernel
def sweep(
    base: Array,  # z-depth of the surface that is swept; float32 [H, W]
    ratios: Array,  # factors on it; float32 [D]
    reference: Array,  # guide image (log intensity); float32 [H, W]
    usable: Array,  # 0 where the reference is masked; float32 [H, W]
    images: Array,  # guides of the neighbours, of less than 2^24 pixels; float32 [N, h, w]
    masks: Array,  # 0 where a neighbour is masked; uint8 [N, h, w]
    turns: Array,  # pixel of the reference at z-depth 1 -> homogeneous pixel of the neighbour; float32 [N, 3, 3]
    shifts: Array,  # homogeneous pixel of the reference's centre in the neighbour; float32 [N, 3]
    radius: int,  # of the windows, pixels; at most sixteen
    floor: float,  # variance of the guides' noise
    share: float,  # part of the neighbours that counts at each pixel, the best ones
    cost: Array,  # written; 0 (equal) to 2, 1 where less than a quarter of the neighbours see it; float32 [H, W, >= D]
) -> None:
    """Costs of the hypotheses ``base * ratios[d]``: one minus the mean of the best correlations with the neighbours."""
    height, width = base.shape
    count, rows, columns = images.shape
    shape = rows, columns
    wide = (width + vec.WIDTH - 1) // vec.WIDTH * vec.WIDTH
    row, size = wide + 2 * _MARGIN, height * wide
    surface, guide, counts = _framed(base, radius, row), _framed(reference, radius, row), _framed(usable, radius, row)
    values = _masked_corners(images, masks)
    warped, visible = np.zeros_like(guide), np.zeros_like(guide)
    lines = np.empty(6 * row, np.float32)
    scores = np.empty(count * size, np.float32)
    costs = np.empty(len(ratios) * size, np.float32)
    fewest = min(count, max(2, (count + 3) // 4))
    counted_of = np.zeros(count + 1, np.float32)
    left_out = 0
    for scored in range(fewest, count + 1):
        counted_of[scored] = np.ceil(share * scored)
        left_out = max(left_out, scored - int(counted_of[scored]))
    lowest = np.empty(left_out * vec.WIDTH, np.float32)
    for d in range(len(ratios)):
        for n in range(count):
            start = 4 * n * rows * columns
            _warp(surface, ratios[d], counts, radius, row, values, start, shape, turns[n], shifts[n], warped, visible)
            _correlate(guide, warped, visible, radius, row, floor, lines, scores, n * size)
        for at in range(0, size, vec.WIDTH):
            vec.store(costs, d * size + at, _mean_of_best(scores, count, size, at, counted_of, lowest))
    for d in range(len(ratios)):
        cost[:, :, d] = costs[d * size : (d + 1) * size].reshape(height, wide)[:, :width]


@part
def _path_step(
    costs: Array,
    at: int,
    count: int,
    least: float,
    jump: float,
    small: float,
    paths: Array,
    before: int,
    into: int,
    totals: Array,
) -> float:
    """One step of a path: Hirschmueller's recurrence. Returns the least cost of the path."""
    lowest = vec.splat(np.inf)
    for d in range(0, count, vec.WIDTH):
        beside = vec.smaller(vec.load(paths, before + d - 1), vec.load(paths, before + d + 1))
        value = vec.smaller(vec.smaller(vec.load(paths, before + d), least + jump), vec.add(beside, small))
        value = vec.sub(vec.add(vec.load(costs, at + d), value), least)
        vec.store(paths, into + d, value)
        vec.store(totals, at + d, vec.add(vec.load(totals, at + d), value))
        lowest = vec.smaller(lowest, value)
    return vec.least_lane(lowest)


@kernel
def aggregate(
    cost: Array, guide: Array, small: np.float32, large: np.float32, contrast: np.float32, total: Array
) -> None:
    """Sum of the path costs over eight directions.

    ``guide``: image whose edges make jumps cheaper. Penalty of a change by one hypothesis: ``small`` (P1); of any
    greater one: ``large`` (P2) divided by ``1 + contrast * |difference of the guide|``, and not less than ``small``.
    Costs are float32 [H, W, D], D a multiple of sixteen; hypotheses beyond the last one cost infinity.
    """
    height, width, count = cost.shape
    costs, totals = cost.reshape(cost.size), total.reshape(cost.size)
    totals[:] = 0.0
    # Paths to this row and to the one before, of four directions, with infinity between them; last, what all begin at.
    length = count + vec.WIDTH
    paths = np.full((8 * width + 1) * length + vec.WIDTH, np.inf, np.float32)
    start = 8 * width * length + vec.WIDTH
    paths[start : start + count] = 0.0
    lowest = np.empty(8 * width, np.float32)
    for way in (1, -1):
        for y in range(height) if way > 0 else range(height - 1, -1, -1):
            for x in range(width) if way > 0 else range(width - 1, -1, -1):
                at = (y * width + x) * count
                # Along the row, and from the row before, straight and along both diagonals.
                for k, (down, right) in enumerate(((0, way), (way, -1), (way, 0), (way, 1))):
                    above, aside = y - down, x - right
                    into = (2 * k + y % 2) * width + x
                    before, least, jump = start, np.float32(0.0), large
                    if 0 <= above < height and 0 <= aside < width:
                        edge = abs(guide[y, x] - guide[above, aside])
                        jump = max(small, large / (np.float32(1.0) + contrast * edge))
                        other = (2 * k + above % 2) * width + aside
                        before, least = other * length + vec.WIDTH, lowest[other]
                    lowest[into] = _path_step(
                        costs, at, count, least, jump, small, paths, before, into * length + vec.WIDTH, totals
                    )


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
            if 0 < best < count - 1 and costs[best + 1] < np.inf:
                bend = costs[best - 1] - np.float32(2.0) * costs[best] + costs[best + 1]
                if bend > np.float32(1e-6):
                    offset = np.float32(0.5) * (costs[best - 1] - costs[best + 1]) / bend
            index[y, x] = np.float32(best) + offset
            match[y, x] = np.float32(1.0) - cost[y, x, best]
            for d in range(max(0, best - rivals), best):
                if cost[y, x, d] == 1.0:
                    match[y, x] = 0.0
            margin[y, x] = second - costs[best] if second < np.inf else np.float32(0.0)
