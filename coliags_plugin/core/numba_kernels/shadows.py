"""Shadow map of places seen from a lamp, and the share of its light that reaches each.

Tables are flat float32 arrays in row-major order; ``view`` is fx, fy, cx, cy and the constants of ``core.shadows``.
"""

from __future__ import annotations

import numpy as np

from coliags_plugin.core.numba_kernels.compilation import inline, kernel, part
from coliags_plugin.core.numba_kernels.threads import pieces


@kernel
def draw_and_compare(counters, seen, opacities, sizes, view, border, surface, shares):
    """Write the lit share of every place, on one thread; ``surface`` is the map, [H + 2 border, W + 2 border]."""
    for _ in pieces(counters, 0, 1):
        _draw(seen, opacities, sizes, view, border, surface)
        _compare(seen, view, border, surface, shares)


@part
def _draw(seen, opacities, sizes, view, border, surface):
    rows, columns = surface.shape
    surface[:] = np.inf
    weights, weighted = np.zeros_like(surface), np.zeros_like(surface)
    for again in range(2):
        for i in range(len(sizes)):
            depth = seen[3 * i + 2]
            if not (depth > 0.0 and opacities[i] > view[4]):
                continue
            row, column = _cell(seen, i, view, border)
            reach = min(view[0] * sizes[i] / depth, view[8])
            top, bottom = _range(row, reach, rows)
            left, right = _range(column, reach, columns)
            for y in range(top, bottom + 1):
                for x in range(left, right + 1):
                    if again == 0:
                        surface[y, x] = min(surface[y, x], depth)
                    elif depth < view[5] * surface[y, x]:
                        weights[y, x] += opacities[i]
                        weighted[y, x] += opacities[i] * depth
    for y in range(rows):
        for x in range(columns):
            if weights[y, x] > 0.0:
                surface[y, x] = weighted[y, x] / weights[y, x]


@part
def _compare(seen, view, border, surface, shares):
    rows, columns = surface.shape
    start, end = view[6], view[7]
    for i in range(len(shares)):
        shares[i] = 1.0
        depth = seen[3 * i + 2]
        if not depth > 0.0:
            continue
        row, column = _cell(seen, i, view, border)
        y, x = np.floor(row), np.floor(column)
        if not (0 <= y < rows - 1 and 0 <= x < columns - 1):
            continue
        down, across = row - y, column - x
        lit = np.float32(0.0)
        for j in range(2):
            for k in range(2):
                share = (down if j else 1 - down) * (across if k else 1 - across)
                behind = depth / surface[int(y) + j, int(x) + k] - 1
                lit += share * min(max((end - behind) / (end - start), np.float32(0.0)), np.float32(1.0))
        shares[i] = lit


@inline
def _cell(seen, i, view, border):
    """Row and column of a place, of which cell centres are integers."""
    depth = seen[3 * i + 2]
    row = view[1] * seen[3 * i + 1] / depth + (view[3] + border - np.float32(0.5))
    return row, view[0] * seen[3 * i] / depth + (view[2] + border - np.float32(0.5))


@inline
def _range(centre, reach, cells):
    """First and last of the map's cells within a reach of a centre, or the nearest cell; first > last: none."""
    first, last = np.ceil(centre - reach), np.floor(centre + reach)
    if last < first:
        first = last = np.rint(centre)
    if not (last >= 0.0 and first < cells):  # also where they are not numbers, or too large for integers
        return 0, -1
    return int(max(first, 0.0)), int(min(last, cells - 1.0))
