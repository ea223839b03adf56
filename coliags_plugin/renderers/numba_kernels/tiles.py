"""Tile handling of both sweeps: position, processing order, and fetching of its Gaussians."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from coliags_plugin.core.numba_compilation import inline, part
from coliags_plugin.renderers.numba_kernels import layout
from coliags_plugin.renderers.numba_kernels.lanes import (
    bits,
    both,
    lane_columns,
    lane_rows,
    less,
    load,
    number,
    prefetch,
    select,
    store,
)

#: Entries of a tile fetched at a time: their rows fit into the first-level cache beside the blocks' state.
CHUNK = 128
#: Prefetch distance of records, entries.
_AHEAD = 32

# The first vectors of a block in the forward sweeps.
TRANSMITTANCE = 0
ALPHA = 16

# A fetched row is one of ``records`` with other columns where that holds the centre and a slope: with (x, y) counted
# from the middle of the tile e = U_XX x + OFFSET_E and f = U_YX x + U_YY y + OFFSET_F.
OFFSET_E = layout.MEAN_X
OFFSET_F = layout.MEAN_Y
MEDIAN_DEPTH = layout.SLOPE_UPRIGHT


@part
def fetch_chunk(first, last, alive, corner_x, corner_y, projections, cells, rows, blocks):
    """Fetch entries ``first`` to ``last`` of a tile.

    Args:
        first, last: Among ``cells``.
        alive: Blocks with transmittance left, one bit each.
        corner_x, corner_y: First pixel of the tile.
        projections, cells: See ``layout``.
        rows: Out. [16 for each entry]
        blocks: Out: those of the alive blocks that the entry touches. [1 for each entry]
    """
    records = projections.records
    middle_x, middle_y = np.float32(corner_x + layout.TILE // 2), np.float32(corner_y + layout.TILE // 2)
    for entry in range(first, last):
        prefetch(records, layout.ROW * cells[layout.CELL * min(entry + _AHEAD, last - 1)])
        index = cells[layout.CELL * entry]
        mine = cells[layout.CELL * entry + 1] & alive
        blocks[entry - first] = mine
        if mine:
            source, target = layout.ROW * index, layout.ROW * (entry - first)
            store(rows, target, load(records, source))
            x = number(records, source + layout.MEAN_X) - middle_x
            y = number(records, source + layout.MEAN_Y) - middle_y
            turned = number(records, source + layout.U_YX) * x + number(records, source + layout.U_YY) * y
            rows[target + OFFSET_E] = -number(records, source + layout.U_XX) * x
            rows[target + OFFSET_F] = -turned
            rows[target + MEDIAN_DEPTH] = number(projections.depths, index)


@inline
def tile_corner(tile, grid):
    """Column and row of a tile's first pixel, and how many of its columns and rows are inside the image."""
    x, y = layout.TILE * (tile % grid.columns), layout.TILE * (tile // grid.columns)
    return x, y, min(layout.TILE, grid.width - x), min(layout.TILE, grid.height - y)


@inline
def block_corner(block):
    """Column and row of a block's first pixel within its tile."""
    return layout.BLOCK * (block & 3), layout.BLOCK * (block >> 2)


@inline
def inside(block, across, down):
    """Which pixels of a block are among the first ``across`` columns and ``down`` rows of its tile."""
    x, y = block_corner(block)
    return both(less(lane_columns(), across - x), less(lane_rows(), down - y))


@inline
def place_in_blocks(x, y, stride):
    """Where pixel (x, y) of a tile is in vectors of its blocks that are ``stride`` apart."""
    return stride * (4 * (y >> 2) + (x >> 2)) + 4 * (y & 3) + (x & 3)


@part
def list_by_block(count, stride, blocks, listed, counts):
    """List the rows of a chunk that touch each block, front to back.

    Branch-free, as branches would be unpredictable, and four blocks at a time: every row is written to every list, and
    kept where the length of the list is incremented.

    Args:
        count: Entries of the chunk.
        stride: Numbers of a fetched row.
        blocks: The blocks that each touches.
        listed: Out: places of rows. [CHUNK for each block]
        counts: Out: how many. [blocks]
    """
    for block in range(0, layout.BLOCKS, 4):
        a, b, c, d = CHUNK * block, CHUNK * (block + 1), CHUNK * (block + 2), CHUNK * (block + 3)
        for entry in range(count):
            row, touched = stride * entry, blocks[entry] >> block
            listed[a], listed[b], listed[c], listed[d] = row, row, row, row
            a += touched & 1
            b += touched >> 1 & 1
            c += touched >> 2 & 1
            d += touched >> 3 & 1
        counts[block], counts[block + 1] = a - CHUNK * block, b - CHUNK * (block + 1)
        counts[block + 2], counts[block + 3] = c - CHUNK * (block + 2), d - CHUNK * (block + 3)


def tile_sweep(fetch: Callable[..., None], sweep_block: Callable[..., int], row: int, size: int) -> Callable[..., int]:
    """Compile a forward sweep through one tile's entries; it leaves the pixels in ``state``, and returns where it stopped.

    Args:
        fetch: As :func:`fetch_chunk`.
        sweep_block: Composites the rows listed into one block; returns whether any pixel has transmittance left.
        row: Numbers of a fetched row.
        size: Numbers of a block's vectors.
    """

    @part
    def sweep_tile(tile, source, bins, view, grid, channels, own, rows, state, blocks):
        corner_x, corner_y, across, down = tile_corner(tile, grid)
        listed = blocks[CHUNK:]
        counts = listed[layout.BLOCKS * CHUNK :]
        alive = 0
        for block in range(layout.BLOCKS):
            at, pixels = size * block, inside(block, across, down)
            store(state, at + TRANSMITTANCE, select(pixels, 1.0, 0.0))
            for vector in range(ALPHA, size, 16):
                store(state, at + vector, 0.0)
            if bits(pixels):
                alive |= 1 << block
        first, last = bins.starts[tile], bins.starts[tile + 1]
        while first < last and alive:
            end = min(first + CHUNK, last)
            fetch(first, end, alive, corner_x, corner_y, source, bins.cells, rows, blocks)
            list_by_block(end - first, row, blocks, listed, counts)
            for block in range(layout.BLOCKS):
                count = counts[block]
                if count and not sweep_block(block, count, listed[CHUNK * block :], rows, channels, own, view, state):
                    alive &= ~(1 << block)
            first = end
        return first

    return sweep_tile


@inline
def copy_to_image(vector, state, stride, tile, grid, depth, channel, image):
    """Copy one vector of a tile's blocks to one of the ``depth`` channels of an image; to an empty one nothing.

    The vectors of the blocks are ``stride`` numbers apart: a constant where this is inlined, for speed.
    """
    if len(image):
        corner_x, corner_y, across, down = tile_corner(tile, grid)
        for y in range(down):
            first = ((corner_y + y) * grid.width + corner_x) * depth + channel
            for x in range(across):
                image[first + x * depth] = number(state, vector + place_in_blocks(x, y, stride))


@inline
def copy_from_image(image, depth, channel, tile, grid, vector, state, stride):
    """The opposite of :func:`copy_to_image`; from an empty image nothing is copied."""
    if len(image):
        corner_x, corner_y, across, down = tile_corner(tile, grid)
        for y in range(down):
            first = ((corner_y + y) * grid.width + corner_x) * depth + channel
            for x in range(across):
                state[vector + place_in_blocks(x, y, stride)] = number(image, first + x * depth)


@part
def order_tiles(starts, order):
    """Order tiles by decreasing length of their lists, to balance the threads.

    Sorted approximately, by the bit length of the number of entries.
    """
    place = 0
    for digits in range(32, -1, -1):
        for tile in range(len(starts) - 1):
            count = starts[tile + 1] - starts[tile]
            if count >> digits == 1 or (count == 0 and digits == 0):
                order[place] = tile
                place += 1
