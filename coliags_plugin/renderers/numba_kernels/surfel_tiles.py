"""Fetching of a tile's surfels, for both sweeps."""

from __future__ import annotations

import numpy as np

from coliags_plugin.core.numba_compilation import inline, part
from coliags_plugin.renderers.numba_kernels import layout, surfel_layout
from coliags_plugin.renderers.numba_kernels.lanes import (
    add,
    at_most,
    both,
    broadcast,
    fma,
    greater,
    lane_columns,
    lane_rows,
    load,
    mul,
    number,
    prefetch,
    quick_div,
    select,
    store,
    sub,
)
from coliags_plugin.renderers.numba_kernels.tiles import block_corner

# A fetched row is one of ``records`` with the centre from the middle of the tile, in scaled pixels, and two more columns:
# 1 / DEPTH, and the largest q, where the disc is at the near plane.
INVERSE_DEPTH = layout.ROW
LARGEST_Q = layout.ROW + 1
FETCHED = layout.ROW + 4
#: Prefetch distance of records, entries.
_AHEAD = 32


@part
def fetch_surfels(first, last, alive, corner_x, corner_y, source, cells, rows, blocks):
    """Fetch entries ``first`` to ``last`` of a tile.

    Args:
        first, last: Among ``cells``.
        alive: Blocks with transmittance left, one bit each.
        corner_x, corner_y: First pixel of the tile.
        source: Records, remainders and view: see ``project_surfels``, ``layout`` and ``surfel_layout``.
        cells: See ``layout``.
        rows: Out. [FETCHED for each entry]
        blocks: Out: those of the alive blocks that the entry touches. [1 for each entry]
    """
    records, remainders, view = source
    scale, near = number(view, layout.VIEW_PIXEL_SCALE), number(view, layout.VIEW_NEAR)
    middle_x, middle_y = np.float32(corner_x + layout.TILE // 2), np.float32(corner_y + layout.TILE // 2)
    for entry in range(first, last):
        ahead = cells[layout.CELL * min(entry + _AHEAD, last - 1)]
        prefetch(records, layout.ROW * ahead)
        prefetch(remainders, 2 * ahead)
        index = cells[layout.CELL * entry]
        mine = cells[layout.CELL * entry + 1] & alive
        blocks[entry - first] = mine
        if mine:
            source, target = layout.ROW * index, FETCHED * (entry - first)
            store(rows, target, load(records, source))
            x = number(records, source + surfel_layout.MEAN_X) - middle_x + number(remainders, 2 * index)
            y = number(records, source + surfel_layout.MEAN_Y) - middle_y + number(remainders, 2 * index + 1)
            rows[target + surfel_layout.MEAN_X], rows[target + surfel_layout.MEAN_Y] = scale * x, scale * y
            depth = number(records, source + surfel_layout.DEPTH)
            rows[target + INVERSE_DEPTH] = np.float32(1.0) / depth
            rows[target + LARGEST_Q] = min(depth / near, np.float32(surfel_layout.LARGE))


@inline
def scaled_pixels(block, view):
    """Columns and rows of a block's pixel centres from the middle of its tile, in scaled pixels."""
    block_x, block_y = block_corner(block)
    half = 0.5 * layout.TILE - 0.5
    scale = broadcast(view, layout.VIEW_PIXEL_SCALE)
    return mul(scale, add(lane_columns(), block_x - half)), mul(scale, add(lane_rows(), block_y - half))


@inline
def intersect(rows, row, x, y):
    """Intersect the rays of pixels with the disc of a fetched row.

    Returns:
        Offset from the projected centre, scaled pixels; q, 1 / q, e and f of ``surfel_layout``; and where the ray hits the
        disc's plane beyond the near plane: elsewhere all but the offset are 0.
    """
    d_x = sub(x, broadcast(rows, row + surfel_layout.MEAN_X))
    d_y = sub(y, broadcast(rows, row + surfel_layout.MEAN_Y))
    q = fma(broadcast(rows, row + surfel_layout.Q_X), d_x, fma(broadcast(rows, row + surfel_layout.Q_Y), d_y, 1.0))
    hit = both(greater(q, 0.0), at_most(q, broadcast(rows, row + LARGEST_Q)))
    inverse_q = select(hit, quick_div(1.0, q), 0.0)
    e = fma(broadcast(rows, row + surfel_layout.U_X), d_x, mul(broadcast(rows, row + surfel_layout.U_Y), d_y))
    f = fma(broadcast(rows, row + surfel_layout.V_X), d_x, mul(broadcast(rows, row + surfel_layout.V_Y), d_y))
    return d_x, d_y, select(hit, q, 0.0), inverse_q, mul(e, inverse_q), mul(f, inverse_q), hit
