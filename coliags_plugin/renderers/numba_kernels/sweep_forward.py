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
    exp2,
    fma,
    greater,
    lane_columns,
    lane_rows,
    load,
    load_all,
    mul,
    neg,
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
    tile_corner,
)

#: A block's vectors: transmittance, alpha, channels, and the median depth.
STATE = 16 * (3 + layout.MAX_CHANNELS)
#: Scratch of one thread: rows of a chunk, states of a tile's blocks.
SCRATCH = CHUNK * layout.ROW + layout.BLOCKS * STATE


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
    columns,
    scratch,
    lists,
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
        columns: Tiles side by side.
        scratch: Scratch. [SCRATCH for each worker]
        lists: Scratch. [2 * CHUNK for each worker]
        rgb, alpha, depth, inverse_depth, expected, normals, median_depth: Out. [H, W, 3] or [H, W]; empty where not
            wanted, but ``depth`` whenever ``expected`` is.
    """
    tiles = len(starts) - 1
    for worker in numba.prange(workers):
        rows = scratch[worker * SCRATCH : (worker + 1) * SCRATCH]
        state = rows[CHUNK * layout.ROW :]
        blocks = lists[2 * CHUNK * worker : 2 * CHUNK * worker + CHUNK]
        listed = lists[2 * CHUNK * worker + CHUNK : 2 * CHUNK * (worker + 1)]
        while True:
            place = take(counters, 0, 1)
            if place >= tiles:
                break
            tile = order[place]
            reached[tile] = _sweep_tile(
                tile, records, depths, cells, starts[tile], starts[tile + 1], channels, median, cuts, columns,
                alpha.shape[1], alpha.shape[0], rows, state, blocks, listed,
            )  # fmt: skip
            _write_tile(
                tile, columns, state, background, rgb, alpha, depth, inverse_depth, expected, normals, median_depth
            )


@part
def _sweep_tile(
    tile,
    records,
    depths,
    cells,
    first,
    last,
    channels,
    median,
    cuts,
    columns,
    width,
    height,
    rows,
    state,
    blocks,
    listed,
):  # type: ignore[no-untyped-def]
    """Sweep through one tile's entries ``first`` to ``last``; leaves its pixels in ``state``.

    Returns:
        Where it stopped.
    """
    corner_x, corner_y = tile_corner(tile, columns)
    alive = 0
    for block in range(layout.BLOCKS):
        block_x, block_y = block_corner(block)
        inside_x = at_most(lane_columns(), width - corner_x - block_x - 1)
        inside = both(inside_x, at_most(lane_rows(), height - corner_y - block_y - 1))
        at = STATE * block
        store(state, at, select(inside, 1.0, 0.0))
        for vector in range(1, STATE // 16):
            store(state, at + 16 * vector, 0.0)
        if bits(inside):
            alive |= 1 << block
    half = 0.5 * layout.TILE
    while first < last and alive:
        end = min(first + CHUNK, last)
        touched = fetch_chunk(
            first, end, alive, cells, records, depths, np.float32(corner_x + half),
            np.float32(corner_y + half), rows, blocks,
        )  # fmt: skip
        for block in range(layout.BLOCKS):
            if touched >> block & 1:
                count = 0
                for entry in range(end - first):
                    listed[count] = layout.ROW * entry
                    count += blocks[entry] >> block & 1
                if not _sweep_block(block, count, listed, rows, channels, median, cuts, state):
                    alive &= ~(1 << block)
        first = end
    return first


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
    at = STATE * block
    transmittance, alpha_sum = load(state, at), load(state, at + 16)
    sums = load_all(state, at + 32, channels)
    medians = load_all(state, at + 32 + 16 * len(channels), median)
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
    store(state, at, transmittance)
    store(state, at + 16, alpha_sum)
    store_all(state, at + 32, sums)
    store_all(state, at + 32 + 16 * len(channels), medians)
    return running


@part
def _write_tile(tile, columns, state, background, rgb, alpha, depth, inverse_depth, expected, normals, median_depth):  # type: ignore[no-untyped-def]
    """Copy a tile's pixels from its blocks to the images."""
    height, width = alpha.shape
    corner_x, corner_y = tile_corner(tile, columns)
    for row in range(corner_y, min(corner_y + layout.TILE, height)):
        for column in range(corner_x, min(corner_x + layout.TILE, width)):
            block = (row - corner_y >> 2 << 2) + (column - corner_x >> 2)
            at = STATE * block + (row - corner_y & 3) * 4 + (column - corner_x & 3) + 16
            alpha_here = state[at]
            alpha[row, column] = alpha_here
            for channel in range(3):
                at += 16
                rgb[row, column, channel] = state[at] + (np.float32(1.0) - alpha_here) * background[channel]
            if depth.size:
                at += 16
                depth[row, column] = state[at]
                if expected.size:
                    expected[row, column] = state[at] / alpha_here if alpha_here > 0 else np.float32(0.0)
            if inverse_depth.size:
                at += 16
                inverse_depth[row, column] = state[at]
            if normals.size:
                for axis in range(3):
                    at += 16
                    normals[row, column, axis] = state[at]
            if median_depth.size:
                at += 16
                median_depth[row, column] = state[at]
