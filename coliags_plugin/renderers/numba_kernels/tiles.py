"""Tile handling of both sweeps: position, processing order, and fetching of its Gaussians."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from coliags_plugin.core.numba_kernels import lanes as vec
from coliags_plugin.core.numba_kernels.compilation import inline, part
from coliags_plugin.renderers.numba_kernels import layout

#: Entries of a tile fetched at a time: their rows fit into the first-level cache beside the blocks' state.
CHUNK = 128
#: Prefetch distance of records, entries.
_AHEAD = 32
#: Prefetch distance of the memory of the sums, entries.
_SUMS_AHEAD = 12

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
    """Fetch the rows of entries ``first`` to ``last`` of a tile, and the alive blocks that each touches.

    ``alive`` has one bit for each block with transmittance left; the corner is the first pixel of the tile.
    """
    records = projections.records
    middle_x, middle_y = np.float32(corner_x + layout.TILE // 2), np.float32(corner_y + layout.TILE // 2)
    for entry in range(first, last):
        vec.prefetch(records, layout.ROW * cells[layout.CELL * min(entry + _AHEAD, last - 1)])
        index = cells[layout.CELL * entry]
        mine = cells[layout.CELL * entry + 1] & alive
        blocks[entry - first] = mine
        if mine:
            source, target = layout.ROW * index, layout.ROW * (entry - first)
            vec.store(rows, target, vec.load(records, source))
            x = vec.number(records, source + layout.MEAN_X) - middle_x
            y = vec.number(records, source + layout.MEAN_Y) - middle_y
            turned = vec.number(records, source + layout.U_YX) * x + vec.number(records, source + layout.U_YY) * y
            rows[target + OFFSET_E] = -vec.number(records, source + layout.U_XX) * x
            rows[target + OFFSET_F] = -turned
            rows[target + MEDIAN_DEPTH] = vec.number(projections.depths, index)


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
def block_pixels(block):
    """Columns and rows of a block's pixel centres from the middle of its tile."""
    x, y = block_corner(block)
    half = 0.5 * layout.TILE - 0.5
    return vec.add(vec.lane_columns(), x - half), vec.add(vec.lane_rows(), y - half)


@inline
def inside(block, across, down):
    """Mask of the pixels of a block that are among the first ``across`` columns and ``down`` rows of its tile."""
    x, y = block_corner(block)
    return vec.both(vec.less(vec.lane_columns(), across - x), vec.less(vec.lane_rows(), down - y))


@inline
def place_in_blocks(x, y, stride):
    """Index of pixel (x, y) of a tile in vectors of its blocks that are ``stride`` apart."""
    return stride * (4 * (y >> 2) + (x >> 2)) + 4 * (y & 3) + (x & 3)


@part
def list_by_block(count, stride, blocks, listed, counts):
    """List the rows of a chunk that touch each block, front to back.

    Branch-free, as branches would be unpredictable, and four blocks at a time: every row is written to every list, and
    kept where the length of the list is incremented.
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

    ``fetch`` is as :func:`fetch_chunk`; ``sweep_block`` composites the rows listed into one block and returns whether any
    pixel has transmittance left. A fetched row has ``row`` numbers, a block's vectors ``size``.
    """

    @part
    def sweep_tile(tile, source, bins, view, grid, channels, own, rows, state, blocks):
        corner_x, corner_y, across, down = tile_corner(tile, grid)
        listed = blocks[CHUNK:]
        counts = listed[layout.BLOCKS * CHUNK :]
        alive = 0
        for block in range(layout.BLOCKS):
            at, pixels = size * block, inside(block, across, down)
            vec.store(state, at + TRANSMITTANCE, vec.select(pixels, 1.0, 0.0))
            for vector in range(ALPHA, size, 16):
                vec.store(state, at + vector, 0.0)
            if vec.bits(pixels):
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


def tile_sweep_backward(fetch: Callable[..., None], sweep_entry: Callable[..., int], row: int) -> Callable[..., None]:
    """Compile a backward sweep through those of one tile's entries that were reached; arguments as of :func:`tile_sweep`.

    ``sweep_entry`` accumulates one entry's sums over its blocks and returns the blocks with transmittance left.
    """

    @part
    def sweep_tile(tile, source, bins, view, grid, channels, own, rows, state, blocks, entry_sums):
        corner_x, corner_y, across, down = tile_corner(tile, grid)
        cells, further = bins.cells, layout.ROW * bins.starts[grid.tiles]
        alive = 0
        for block in range(layout.BLOCKS):
            if vec.bits(inside(block, across, down)):
                alive |= 1 << block
        first, last = bins.starts[tile], bins.reached[tile]
        while first < last:
            end = min(first + CHUNK, last)
            fetch(first, end, alive, corner_x, corner_y, source, cells, rows, blocks)
            for entry in range(first, end):
                ahead = cells[layout.CELL * min(entry + _SUMS_AHEAD, last - 1) + 2]
                vec.prefetch_to_write(entry_sums, layout.ROW * ahead)
                fetched, mine = row * (entry - first), blocks[entry - first] & alive
                number = cells[layout.CELL * entry + 2]
                target, beyond = layout.ROW * number, further + number
                alive = sweep_entry(fetched, mine, alive, rows, channels, own, view, state, target, beyond, entry_sums)
            first = end

    return sweep_tile


def image_copies(stride: int) -> tuple[Callable[..., None], Callable[..., None]]:
    """Compile what copies a vector of a tile's blocks to one of the ``depth`` channels of an image, and the opposite.

    The vectors of the blocks are ``stride`` numbers apart: a constant, for speed. Nothing is copied to or from an empty
    image.
    """

    @part
    def to_image(vector, state, tile, grid, depth, channel, image):
        if len(image):
            corner_x, corner_y, across, down = tile_corner(tile, grid)
            for y in range(down):
                first = ((corner_y + y) * grid.width + corner_x) * depth + channel
                for x in range(across):
                    image[first + x * depth] = vec.number(state, vector + place_in_blocks(x, y, stride))

    @part
    def from_image(image, depth, channel, tile, grid, vector, state):
        if len(image):
            corner_x, corner_y, across, down = tile_corner(tile, grid)
            for y in range(down):
                first = ((corner_y + y) * grid.width + corner_x) * depth + channel
                for x in range(across):
                    state[vector + place_in_blocks(x, y, stride)] = vec.number(image, first + x * depth)

    return to_image, from_image


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
