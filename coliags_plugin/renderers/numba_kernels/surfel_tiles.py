"""Fetching of a tile's surfels, for both sweeps."""

from __future__ import annotations

import numpy as np

from coliags_plugin.core.numba_kernels import lanes as vec
from coliags_plugin.core.numba_kernels.compilation import inline, part
from coliags_plugin.renderers.numba_kernels import layout, surfel_layout
from coliags_plugin.renderers.numba_kernels.tiles import block_pixels

# A fetched row is one of ``records`` with the centre from the middle of the tile, in scaled pixels, and two more columns:
# 1 / DEPTH, and the largest q, where the disc is at the near plane.
INVERSE_DEPTH = layout.ROW
LARGEST_Q = layout.ROW + 1
FETCHED = layout.ROW + 4
#: Prefetch distance of records, entries.
_AHEAD = 32


@part
def fetch_surfels(first, last, alive, corner_x, corner_y, source, cells, rows, blocks):
    """As ``tiles.fetch_chunk``; ``source`` are records, remainders and view."""
    records, remainders, view = source
    scale, near = vec.number(view, layout.VIEW_PIXEL_SCALE), vec.number(view, layout.VIEW_NEAR)
    middle_x, middle_y = np.float32(corner_x + layout.TILE // 2), np.float32(corner_y + layout.TILE // 2)
    for entry in range(first, last):
        ahead = cells[layout.CELL * min(entry + _AHEAD, last - 1)]
        vec.prefetch(records, layout.ROW * ahead)
        vec.prefetch(remainders, 2 * ahead)
        index = cells[layout.CELL * entry]
        mine = cells[layout.CELL * entry + 1] & alive
        blocks[entry - first] = mine
        if mine:
            source, target = layout.ROW * index, FETCHED * (entry - first)
            vec.store(rows, target, vec.load(records, source))
            x = vec.number(records, source + surfel_layout.MEAN_X) - middle_x + vec.number(remainders, 2 * index)
            y = vec.number(records, source + surfel_layout.MEAN_Y) - middle_y + vec.number(remainders, 2 * index + 1)
            rows[target + surfel_layout.MEAN_X], rows[target + surfel_layout.MEAN_Y] = scale * x, scale * y
            depth = vec.number(records, source + surfel_layout.DEPTH)
            rows[target + INVERSE_DEPTH] = np.float32(1.0) / depth
            rows[target + LARGEST_Q] = min(depth / near, np.float32(surfel_layout.LARGE))


@inline
def scaled_pixels(block, view):
    """Columns and rows of a block's pixel centres from the middle of its tile, in scaled pixels."""
    return vec.mul(vec.broadcast(view, layout.VIEW_PIXEL_SCALE), block_pixels(block))


@inline
def intersect(rows, row, x, y):
    """Intersect the rays of pixels with the disc of a fetched row.

    Returns the offset from the projected centre, scaled pixels; q, 1 / q, e and f of ``surfel_layout``; and where the ray
    hits the disc's plane beyond the near plane: elsewhere all but the offset are 0.
    """
    u_x, u_y, v_x, v_y, q_x, q_y = vec.broadcast_all(rows, row + surfel_layout.U_X, (0,) * 6)
    d_x = vec.sub(x, vec.broadcast(rows, row + surfel_layout.MEAN_X))
    d_y = vec.sub(y, vec.broadcast(rows, row + surfel_layout.MEAN_Y))
    q = vec.fma(q_x, d_x, vec.fma(q_y, d_y, 1.0))
    hit = vec.both(vec.greater(q, 0.0), vec.at_most(q, vec.broadcast(rows, row + LARGEST_Q)))
    inverse_q = vec.select(hit, vec.quick_div(1.0, q), 0.0)
    e, f = vec.fma(u_x, d_x, vec.mul(u_y, d_y)), vec.fma(v_x, d_x, vec.mul(v_y, d_y))
    return d_x, d_y, vec.select(hit, q, 0.0), inverse_q, vec.mul(e, inverse_q), vec.mul(f, inverse_q), hit
