"""Compositing, tile by tile and block by block, front to back.

A block of 4 x 4 pixels is one vector, and everything a block has gathered stays in registers while its Gaussians pass.
The formulas are those of ``docs/rendering.md``, section "Compositing".
"""

from __future__ import annotations

import numba
import numpy as np

from coliags_plugin.renderers.numba_kernels import layout
from coliags_plugin.renderers.numba_kernels.compilation import part, region_kernel
from coliags_plugin.renderers.numba_kernels.lanes import (
    add,
    at_least,
    at_most,
    bits,
    both,
    broadcast,
    broadcast_all,
    div,
    exp2,
    fma,
    greater,
    lane_columns,
    lane_rows,
    less,
    load,
    load_all,
    mul,
    neg,
    number,
    repeat,
    select,
    smaller,
    splat,
    store,
    store_all,
    sub,
)
from coliags_plugin.renderers.numba_kernels.threads import take
from coliags_plugin.renderers.numba_kernels.tiles import (
    CHUNK,
    MEDIAN_DEPTH,
    OFFSET_E,
    OFFSET_F,
    block_corner,
    fetch_chunk,
    place_in_blocks,
    tile_corner,
)

# A block's vectors: transmittance, alpha, channels and, behind them, the median depth.
_TRANSMITTANCE = 0
_ALPHA = 16
_CHANNELS = 32
#: Depth over alpha takes the place of the transmittance when that has done its work.
_EXPECTED = _TRANSMITTANCE
_STATE = _CHANNELS + 16 * (layout.MAX_CHANNELS + 1)
#: Scratch of one thread: rows of a chunk, states of a tile's blocks.
SCRATCH = CHUNK * layout.ROW + layout.BLOCKS * _STATE
#: Scratch of one thread, integers: blocks of a chunk's entries, entries of a tile's blocks, and their number.
LISTS = CHUNK + layout.BLOCKS * CHUNK + layout.BLOCKS


@region_kernel
def sweep_forward(
    workers,
    counters,
    records,
    depths,
    cells,
    starts,
    order,
    reached,
    channels,
    median,
    cuts,
    background,
    width,
    height,
    scratch,
    lists,
    composited,
    rgb,
    alpha,
    depth,
    inverse_depth,
    expected,
    normals,
    median_depth,
):  # type: ignore[no-untyped-def]
    """Composite all tiles.

    Args:
        workers: Threads to share the work.
        counters: For sharing; entry 0 must be 0.
        records, depths, cells, starts: See ``layout`` and ``binning``.
        order: Tiles in the order they are begun in.
        reached: Out: end of the entries of each tile that any pixel gets to see. [tiles]
        channels: Any tuple as long as there are channels.
        median: A tuple with one element where the median depth is wanted, an empty one where it is not.
        cuts: log2(alpha_min), alpha_max, transmittance_min.
        background: RGB.
        width, height: Of the image, pixels.
        scratch: Scratch. [SCRATCH for each worker]
        lists: Scratch. [LISTS for each worker]
        composited: Out: alpha and channels without background, one vector each, by tile and block.
        rgb, alpha, depth, inverse_depth, expected, normals, median_depth: Out, flat images; empty where not wanted.
    """
    tiles = len(starts) - 1
    columns = (width + layout.TILE - 1) // layout.TILE
    for worker in numba.prange(workers):
        rows = scratch[worker * SCRATCH : (worker + 1) * SCRATCH]
        state = rows[CHUNK * layout.ROW :]
        blocks = lists[worker * LISTS : (worker + 1) * LISTS]
        listed = blocks[CHUNK:]
        counts = listed[layout.BLOCKS * CHUNK :]
        while True:
            place = take(counters, 0, 1)
            if place >= tiles:
                break
            tile = order[place]
            corner_x, corner_y = tile_corner(tile, columns)
            across, down = min(layout.TILE, width - corner_x), min(layout.TILE, height - corner_y)
            reached[tile] = _sweep_tile(
                corner_x, corner_y, across, down, records, depths, cells, starts[tile], starts[tile + 1], channels,
                median, cuts, rows, state, blocks, listed, counts,
            )  # fmt: skip
            _finish_tile(tile, channels, state, background, depth.size or expected.size, composited)
            first = corner_y * width + corner_x
            for channel in range(3):
                _copy_to_image(_CHANNELS + 16 * channel, state, across, down, first, width, 3, channel, rgb)
            _copy_to_image(_ALPHA, state, across, down, first, width, 1, 0, alpha)
            at = _CHANNELS + 48
            if depth.size or expected.size:
                _copy_to_image(at, state, across, down, first, width, 1, 0, depth)
                _copy_to_image(_EXPECTED, state, across, down, first, width, 1, 0, expected)
                at += 16
            if inverse_depth.size:
                _copy_to_image(at, state, across, down, first, width, 1, 0, inverse_depth)
                at += 16
            if normals.size:
                for axis in range(3):
                    _copy_to_image(at + 16 * axis, state, across, down, first, width, 3, axis, normals)
                at += 48
            _copy_to_image(at, state, across, down, first, width, 1, 0, median_depth)


@part
def _sweep_tile(
    corner_x,
    corner_y,
    across,
    down,
    records,
    depths,
    cells,
    first,
    last,
    channels,
    median,
    cuts,
    rows,
    state,
    blocks,
    listed,
    counts,
):  # type: ignore[no-untyped-def]
    """Sweep through one tile's entries ``first`` to ``last``; leaves its pixels in ``state``.

    Returns:
        Where it stopped.
    """
    alive = 0
    for block in range(layout.BLOCKS):
        block_x, block_y = block_corner(block)
        inside = both(less(lane_columns(), across - block_x), less(lane_rows(), down - block_y))
        at = _STATE * block
        store(state, at + _TRANSMITTANCE, select(inside, 1.0, 0.0))
        store(state, at + _ALPHA, 0.0)
        store_all(state, at + _CHANNELS, repeat(0.0, channels))
        store_all(state, at + _CHANNELS + 16 * len(channels), repeat(0.0, median))
        if bits(inside):
            alive |= 1 << block
    middle_x, middle_y = np.float32(corner_x + 0.5 * layout.TILE), np.float32(corner_y + 0.5 * layout.TILE)
    while first < last and alive:
        end = min(first + CHUNK, last)
        fetch_chunk(first, end, alive, cells, records, depths, middle_x, middle_y, rows, blocks)
        _list_by_block(end - first, blocks, listed, counts)
        for block in range(layout.BLOCKS):
            if counts[block] and not _sweep_block(
                block, counts[block], listed[CHUNK * block :], rows, channels, median, cuts, state
            ):
                alive &= ~(1 << block)
        first = end
    return first


@part
def _list_by_block(count, blocks, listed, counts):  # type: ignore[no-untyped-def]
    """Which rows of a chunk touch each block, front to back.

    Without a branch, for none could be foreseen, and four blocks at a time: every row is written to every list, and
    stays there where the list grows.

    Args:
        count: Entries of the chunk.
        blocks: The blocks that each touches.
        listed: Out: places of rows. [CHUNK for each block]
        counts: Out: how many. [blocks]
    """
    for block in range(0, layout.BLOCKS, 4):
        a, b, c, d = CHUNK * block, CHUNK * (block + 1), CHUNK * (block + 2), CHUNK * (block + 3)
        for entry in range(count):
            row, touched = layout.ROW * entry, blocks[entry] >> block
            listed[a], listed[b], listed[c], listed[d] = row, row, row, row
            a += touched & 1
            b += touched >> 1 & 1
            c += touched >> 2 & 1
            d += touched >> 3 & 1
        counts[block], counts[block + 1] = a - CHUNK * block, b - CHUNK * (block + 1)
        counts[block + 2], counts[block + 3] = c - CHUNK * (block + 2), d - CHUNK * (block + 3)


@part
def _sweep_block(block, count, listed, rows, channels, median, cuts, state):  # type: ignore[no-untyped-def]
    """Composite the first ``count`` rows listed into one block.

    Returns:
        Whether any pixel still lets light through.
    """
    block_x, block_y = block_corner(block)
    half = 0.5 * layout.TILE - 0.5
    x, y = add(lane_columns(), block_x - half), add(lane_rows(), block_y - half)
    log2_alpha_min, alpha_max, transmittance_min = splat(cuts[0]), splat(cuts[1]), splat(cuts[2])
    at = _STATE * block
    transmittance, alpha_sum = load(state, at + _TRANSMITTANCE), load(state, at + _ALPHA)
    sums = load_all(state, at + _CHANNELS, channels)
    medians = load_all(state, at + _CHANNELS + 16 * len(channels), median)
    running = 1
    for place in range(count):
        row = listed[place]
        e = fma(broadcast(rows, row + layout.U_XX), x, broadcast(rows, row + OFFSET_E))
        f = fma(broadcast(rows, row + layout.U_YY), y, broadcast(rows, row + OFFSET_F))
        f = fma(broadcast(rows, row + layout.U_YX), x, f)
        log2_alpha = fma(neg(e), e, fma(neg(f), f, broadcast(rows, row + layout.LOG2_OPACITY)))
        alpha = smaller(exp2(log2_alpha), alpha_max)
        alpha = select(at_least(log2_alpha, log2_alpha_min), alpha, 0.0)
        behind = mul(transmittance, sub(1.0, alpha))
        drawn = at_least(behind, transmittance_min)
        weight = select(drawn, mul(alpha, transmittance), 0.0)
        alpha_sum = add(alpha_sum, weight)
        sums = fma(weight, broadcast_all(rows, row + layout.CHANNELS, channels), sums)
        if len(median) > 0:
            crosses = both(both(drawn, greater(transmittance, 0.5)), at_most(behind, 0.5))
            medians = select(crosses, broadcast_all(rows, row + MEDIAN_DEPTH, median), medians)
        # Once zero it stays so: the stop is for good.
        transmittance = select(drawn, behind, 0.0)
        running = bits(drawn)
        if not running:
            break
    store(state, at + _TRANSMITTANCE, transmittance)
    store(state, at + _ALPHA, alpha_sum)
    store_all(state, at + _CHANNELS, sums)
    store_all(state, at + _CHANNELS + 16 * len(channels), medians)
    return running


@part
def _finish_tile(tile, channels, state, background, has_depth, composited):  # type: ignore[no-untyped-def]
    """Keep what the blocks have gathered in ``composited``; then add the background, and divide depth by alpha."""
    size = 16 * (1 + len(channels))
    for block in range(layout.BLOCKS):
        at = _STATE * block
        alpha = load(state, at + _ALPHA)
        target = size * (layout.BLOCKS * tile + block)
        store(composited, target, alpha)
        store_all(composited, target + 16, load_all(state, at + _CHANNELS, channels))
        if has_depth:
            expected = div(load(state, at + _CHANNELS + 48), alpha)
            store(state, at + _EXPECTED, select(greater(alpha, 0.0), expected, 0.0))
        color = load_all(state, at + _CHANNELS, (0, 0, 0))
        behind = broadcast_all(background, 0, (0, 0, 0))
        store_all(state, at + _CHANNELS, fma(sub(1.0, alpha), behind, color))


@part
def _copy_to_image(vector, state, across, down, first, width, depth, channel, image):  # type: ignore[no-untyped-def]
    """Copy one vector of a tile's blocks to one channel of a flat image; to an empty one nothing.

    Args:
        vector: Which, counted from the start of a block's state.
        state: The blocks' states.
        across, down: Pixels of the tile that are inside the image.
        first: Number of the tile's first pixel.
        width: Of the image.
        depth: Channels of the image.
        channel: Which.
        image: Out.
    """
    if image.size:
        for y in range(down):
            for x in range(across):
                image[(first + y * width + x) * depth + channel] = number(state, vector + place_in_blocks(x, y, _STATE))
