"""Derivatives of compositing, tile by tile, front to back once more.

With g the derivative of the loss with respect to a pixel's composited channels, what a Gaussian of weight w and
channels c shows is w (g . c). A running difference, first the whole pixel's (g . composited), tells what everything behind it
still shows; see ``docs/rendering.md``, section "Derivatives". Nothing is kept from the forward pass but its images.
"""

from __future__ import annotations

import numba
import numpy as np

from coliags_plugin.renderers.numba_kernels import layout
from coliags_plugin.renderers.numba_kernels.compilation import inline, part, region_kernel
from coliags_plugin.renderers.numba_kernels.lanes import (
    add,
    at_least,
    bits,
    both,
    broadcast,
    broadcast_all,
    dot,
    exp2,
    fma,
    lane_columns,
    lane_rows,
    lane_sums,
    less,
    load,
    load_all,
    lowest_bit,
    mul,
    neg,
    prefetch_to_write,
    quick_div,
    repeat,
    select,
    smaller,
    splat,
    store,
    sub,
)
from coliags_plugin.renderers.numba_kernels.threads import take
from coliags_plugin.renderers.numba_kernels.tiles import (
    CHUNK,
    OFFSET_E,
    OFFSET_F,
    block_corner,
    fetch_chunk,
    tile_corner,
)

# A block's vectors: x and y of its pixels, transmittance, what is still to be shown, and the derivatives with respect
# to alpha and to each channel.
_X = 0
_Y = 16
_TRANSMITTANCE = 32
_BEHIND = 48
_ALPHA = 64
_CHANNELS = 80
STATE = _CHANNELS + 16 * layout.MAX_CHANNELS
#: Scratch of one thread: rows of a chunk, states of a tile's blocks.
SCRATCH = CHUNK * layout.ROW + layout.BLOCKS * STATE


@region_kernel
def sweep_backward(
    workers,
    counters,
    records,
    depths,
    cells,
    starts,
    order,
    reached,
    channels,
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
    of_rgb,
    of_alpha,
    of_depth,
    of_inverse_depth,
    of_expected,
    of_normals,
    entry_sums,
):  # type: ignore[no-untyped-def]
    """Sums over the pixels of each entry.

    Args:
        workers: Threads to share the work.
        counters: For sharing; entry 0 must be 0.
        records, depths, cells, starts, order, reached: As the forward sweep left them.
        channels: Any tuple as long as there are channels.
        cuts: log2(alpha_min), alpha_max, transmittance_min.
        background: RGB.
        columns: Tiles side by side.
        scratch: Scratch. [SCRATCH for each worker]
        lists: Scratch. [CHUNK for each worker]
        rgb, alpha, depth, inverse_depth, expected, normals: The images. [H, W, 3] or [H, W], or empty.
        of_rgb, of_alpha, of_depth, of_inverse_depth, of_expected, of_normals: Derivatives with respect to them; empty
            where 0.
        entry_sums: Out: see ``layout``. [16 for each entry]
    """
    tiles = len(starts) - 1
    for worker in numba.prange(workers):
        rows = scratch[worker * SCRATCH : (worker + 1) * SCRATCH]
        state = rows[CHUNK * layout.ROW :]
        blocks = lists[CHUNK * worker : CHUNK * (worker + 1)]
        while True:
            place = take(counters, 0, 1)
            if place >= tiles:
                break
            tile = order[place]
            if starts[tile] < reached[tile]:
                alive = _read_tile(
                    tile, columns, len(channels), state, background, rgb, alpha, depth, inverse_depth, expected, normals, of_rgb,
                    of_alpha, of_depth, of_inverse_depth, of_expected, of_normals,
                )  # fmt: skip
                _sweep_tile(
                    tile, alive, records, depths, cells, starts[tile], reached[tile], channels, cuts, columns, rows, state,
                    blocks, entry_sums,
                )  # fmt: skip
            for entry in range(reached[tile], starts[tile + 1]):
                store(entry_sums, layout.ROW * cells[layout.CELL * entry + 2], 0.0)


@part
def _read_tile(
    tile,
    columns,
    channels,
    state,
    background,
    rgb,
    alpha,
    depth,
    inverse_depth,
    expected,
    normals,
    of_rgb,
    of_alpha,
    of_depth,
    of_inverse_depth,
    of_expected,
    of_normals,
):  # type: ignore[no-untyped-def]
    """Fill the blocks' states. Returns which blocks have pixels, one bit each."""
    zero = np.float32(0.0)
    height, width = alpha.shape
    corner_x, corner_y = tile_corner(tile, columns)
    half = 0.5 * layout.TILE - 0.5
    for block in range(layout.BLOCKS):
        block_x, block_y = block_corner(block)
        at = STATE * block
        store(state, at + _X, add(lane_columns(), block_x - half))
        store(state, at + _Y, add(lane_rows(), block_y - half))
        for vector in range(_TRANSMITTANCE, _CHANNELS + 16 * channels, 16):
            store(state, at + vector, 0.0)
    alive = 0
    for row in range(corner_y, min(corner_y + layout.TILE, height)):
        for column in range(corner_x, min(corner_x + layout.TILE, width)):
            block = (row - corner_y >> 2 << 2) + (column - corner_x >> 2)
            alive |= 1 << block
            lane = STATE * block + (row - corner_y & 3) * 4 + (column - corner_x & 3)
            state[lane + _TRANSMITTANCE] = 1.0
            alpha_here = alpha[row, column]
            by_alpha = of_alpha[row, column] if of_alpha.size else zero
            behind = zero
            at = lane + _CHANNELS
            if of_rgb.size:
                for channel in range(3):
                    given = of_rgb[row, column, channel]
                    by_alpha -= given * background[channel]
                    behind += given * (rgb[row, column, channel] - (np.float32(1.0) - alpha_here) * background[channel])
                    state[at + 16 * channel] = given
            at += 48
            if depth.size:
                given = of_depth[row, column] if of_depth.size else zero
                if of_expected.size and alpha_here > 0:
                    share = of_expected[row, column] / alpha_here
                    given += share
                    by_alpha -= share * expected[row, column]
                behind += given * depth[row, column]
                state[at] = given
                at += 16
            if inverse_depth.size:
                if of_inverse_depth.size:
                    given = of_inverse_depth[row, column]
                    behind += given * inverse_depth[row, column]
                    state[at] = given
                at += 16
            if of_normals.size:
                for axis in range(3):
                    given = of_normals[row, column, axis]
                    behind += given * normals[row, column, axis]
                    state[at + 16 * axis] = given
            state[lane + _ALPHA] = by_alpha
            state[lane + _BEHIND] = behind + by_alpha * alpha_here
    return alive


@part
def _sweep_tile(
    tile, alive, records, depths, cells, first, last, channels, cuts, columns, rows, state, blocks, entry_sums
):  # type: ignore[no-untyped-def]
    """Sweep through one tile's entries ``first`` to ``last``."""
    corner_x, corner_y = tile_corner(tile, columns)
    half = 0.5 * layout.TILE
    while first < last:
        end = min(first + CHUNK, last)
        fetch_chunk(
            first, end, alive, cells, records, depths, np.float32(corner_x + half), np.float32(corner_y + half), rows,
            blocks,
        )  # fmt: skip
        for entry in range(first, end):
            prefetch_to_write(entry_sums, layout.ROW * cells[layout.CELL * entry + 2])
        for entry in range(end - first):
            alive = _sweep_entry(
                layout.ROW * entry, blocks[entry] & alive, alive, rows, channels, cuts, state,
                layout.ROW * cells[layout.CELL * (first + entry) + 2], entry_sums,
            )  # fmt: skip
        first = end


@inline
def _sweep_entry(row, blocks, alive, rows, channels, cuts, state, target, entry_sums):  # type: ignore[no-untyped-def]
    """Add up one entry's sums over its blocks. Returns which blocks still let light through."""
    zero = splat(0.0)
    sum_v, sum_e, sum_f, sum_ee, sum_ef, sum_ff = zero, zero, zero, zero, zero, zero
    sums = repeat(0.0, channels)
    while blocks:
        block = lowest_bit(blocks)
        blocks &= blocks - 1
        at = STATE * block
        x, y = load(state, at + _X), load(state, at + _Y)
        e = fma(broadcast(rows, row + layout.U_XX), x, broadcast(rows, row + OFFSET_E))
        f = fma(broadcast(rows, row + layout.U_YY), y, broadcast(rows, row + OFFSET_F))
        f = fma(broadcast(rows, row + layout.U_YX), x, f)
        log2_alpha = fma(neg(e), e, fma(neg(f), f, broadcast(rows, row + layout.LOG2_OPACITY)))
        free_alpha = exp2(log2_alpha)
        alpha = select(at_least(log2_alpha, broadcast(cuts, 0)), smaller(free_alpha, broadcast(cuts, 1)), 0.0)
        transmittance = load(state, at + _TRANSMITTANCE)
        through = sub(1.0, alpha)
        behind = mul(transmittance, through)
        drawn = at_least(behind, broadcast(cuts, 2))
        weight = select(drawn, mul(alpha, transmittance), 0.0)
        store(state, at + _TRANSMITTANCE, select(drawn, behind, 0.0))

        given = load_all(state, at + _CHANNELS, channels)
        shown = mul(weight, dot(broadcast_all(rows, row + layout.CHANNELS, channels), given, load(state, at + _ALPHA)))
        hidden = sub(load(state, at + _BEHIND), shown)
        store(state, at + _BEHIND, hidden)
        v = sub(shown, mul(quick_div(alpha, through), hidden))
        v = select(both(drawn, less(free_alpha, broadcast(cuts, 1))), v, 0.0)
        v_e, v_f = mul(v, e), mul(v, f)
        sum_v, sum_e, sum_f = add(sum_v, v), add(sum_e, v_e), add(sum_f, v_f)
        sum_ee, sum_ef, sum_ff = fma(v_e, e, sum_ee), fma(v_e, f, sum_ef), fma(v_f, f, sum_ff)
        sums = fma(weight, given, sums)
        if not bits(drawn):
            alive &= ~(1 << block)
    store(entry_sums, target, lane_sums((sum_v, sum_e, sum_f, sum_ee, sum_ef, sum_ff) + sums))  # noqa: RUF005
    return alive
