"""Matching costs of depth hypotheses: zero-mean normalised cross-correlation with every neighbour."""

from __future__ import annotations

import numpy as np

from coliags_plugin.core.numba_compilation import Array, kernel, part


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
        below, above = y + radius, y - radius - 1
        if below < height:
            for x in range(width):
                s = visible[below, x]
                a, b = s * reference[below, x], s * warped[below, x]
                sums[0, x] += s
                sums[1, x] += a
                sums[2, x] += b
                sums[3, x] += a * a
                sums[4, x] += b * b
                sums[5, x] += a * b
        if above >= 0:
            for x in range(width):
                s = visible[above, x]
                a, b = s * reference[above, x], s * warped[above, x]
                sums[0, x] -= s
                sums[1, x] -= a
                sums[2, x] -= b
                sums[3, x] -= a * a
                sums[4, x] -= b * b
                sums[5, x] -= a * b
        if y < 0:
            continue
        n, sa, sb, saa, sbb, sab = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for x in range(-radius, width):
            right, left = x + radius, x - radius - 1
            if right < width:
                n += sums[0, right]
                sa += sums[1, right]
                sb += sums[2, right]
                saa += sums[3, right]
                sbb += sums[4, right]
                sab += sums[5, right]
            if left >= 0:
                n -= sums[0, left]
                sa -= sums[1, left]
                sb -= sums[2, left]
                saa -= sums[3, left]
                sbb -= sums[4, left]
                sab -= sums[5, left]
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
