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
    div,
    dot,
    exp2,
    fma,
    greater,
    lane_columns,
    lane_rows,
    lane_sums,
    less,
    load,
    load_all,
    lowest_bit,
    mul,
    neg,
    number,
    prefetch_to_write,
    quick_div,
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
    OFFSET_E,
    OFFSET_F,
    block_corner,
    fetch_chunk,
    place_in_blocks,
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
_STATE = _CHANNELS + 16 * layout.MAX_CHANNELS
#: Scratch of one thread: rows of a chunk, states of a tile's blocks.
SCRATCH = CHUNK * layout.ROW + layout.BLOCKS * _STATE
#: How many entries before its turn memory for its sums is asked for.
_AHEAD = 12


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
    width,
    height,
    scratch,
    lists,
    composited,
    has_depth,
    has_inverse_depth,
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
        records, depths, cells, starts, order, reached, composited: As the forward sweep left them.
        channels: Any tuple as long as there are channels.
        cuts: log2(alpha_min), alpha_max, transmittance_min.
        background: RGB.
        width, height: Of the image, pixels.
        scratch: Scratch. [SCRATCH for each worker]
        lists: Scratch. [CHUNK for each worker]
        has_depth, has_inverse_depth: Whether they are among the channels.
        of_rgb, of_alpha, of_depth, of_inverse_depth, of_expected, of_normals: Derivatives with respect to the images,
            flat; empty where 0.
        entry_sums: Out: see ``layout``. [16 for each entry]
    """
    tiles = len(starts) - 1
    columns = (width + layout.TILE - 1) // layout.TILE
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
                corner_x, corner_y = tile_corner(tile, columns)
                across, down = min(layout.TILE, width - corner_x), min(layout.TILE, height - corner_y)
                _clear_tile(across, down, channels, state)
                first = corner_y * width + corner_x
                for channel in range(3):
                    _copy_from_image(of_rgb, first, width, 3, channel, across, down, _CHANNELS + 16 * channel, state)
                _copy_from_image(of_alpha, first, width, 1, 0, across, down, _ALPHA, state)
                at = _CHANNELS + 48
                if has_depth:
                    _copy_from_image(of_depth, first, width, 1, 0, across, down, at, state)
                    _copy_from_image(of_expected, first, width, 1, 0, across, down, _BEHIND, state)
                    at += 16
                if has_inverse_depth:
                    _copy_from_image(of_inverse_depth, first, width, 1, 0, across, down, at, state)
                    at += 16
                for axis in range(3):
                    _copy_from_image(of_normals, first, width, 3, axis, across, down, at + 16 * axis, state)
                _prepare_tile(tile, channels, background, has_depth, composited, state)
                _sweep_tile(
                    corner_x, corner_y, across, down, records, depths, cells, starts[tile], reached[tile], channels,
                    cuts, rows, state, blocks, entry_sums,
                )  # fmt: skip
            for entry in range(reached[tile], starts[tile + 1]):
                store(entry_sums, layout.ROW * cells[layout.CELL * entry + 2], 0.0)


@part
def _clear_tile(across, down, channels, state):  # type: ignore[no-untyped-def]
    """Pixels at their places, transmittance 1 inside the image, and all derivatives 0."""
    half = 0.5 * layout.TILE - 0.5
    for block in range(layout.BLOCKS):
        block_x, block_y = block_corner(block)
        at = _STATE * block
        inside = both(less(lane_columns(), across - block_x), less(lane_rows(), down - block_y))
        store(state, at + _X, add(lane_columns(), block_x - half))
        store(state, at + _Y, add(lane_rows(), block_y - half))
        store(state, at + _TRANSMITTANCE, select(inside, 1.0, 0.0))
        store(state, at + _BEHIND, 0.0)
        store(state, at + _ALPHA, 0.0)
        store_all(state, at + _CHANNELS, repeat(0.0, channels))


@part
def _copy_from_image(image, first, width, depth, channel, across, down, vector, state):  # type: ignore[no-untyped-def]
    """Copy one channel of a flat image to one vector of a tile's blocks; from an empty one nothing.

    Args:
        image: The image.
        first: Number of the tile's first pixel.
        width: Of the image.
        depth: Channels of the image.
        channel: Which.
        across, down: Pixels of the tile that are inside the image.
        vector: Which, counted from the start of a block's state.
        state: Out: the blocks' states.
    """
    if image.size:
        for y in range(down):
            for x in range(across):
                value = number(image, (first + y * width + x) * depth + channel)
                state[vector + place_in_blocks(x, y, _STATE)] = value


@part
def _prepare_tile(tile, channels, background, has_depth, composited, state):  # type: ignore[no-untyped-def]
    """From derivatives with respect to images to those with respect to what was composited, and what all of it shows.

    The derivative with respect to depth over alpha is where the latter will be.
    """
    size = 16 * (1 + len(channels))
    for block in range(layout.BLOCKS):
        at = _STATE * block
        source = size * (layout.BLOCKS * tile + block)
        alpha, sums = load(composited, source), load_all(composited, source + 16, channels)
        of_color = load_all(state, at + _CHANNELS, (0, 0, 0))
        of_alpha = sub(load(state, at + _ALPHA), dot(of_color, broadcast_all(background, 0, (0, 0, 0)), 0.0))
        if has_depth:
            covered = greater(alpha, 0.0)
            share = select(covered, div(load(state, at + _BEHIND), alpha), 0.0)
            store(state, at + _CHANNELS + 48, add(load(state, at + _CHANNELS + 48), share))
            # Read again rather than taken from sums, which has no fourth place where nothing but colour is composited.
            depth = load(composited, source + 64)
            of_alpha = sub(of_alpha, select(covered, mul(share, div(depth, alpha)), 0.0))
        store(state, at + _ALPHA, of_alpha)
        store(state, at + _BEHIND, dot(load_all(state, at + _CHANNELS, channels), sums, mul(of_alpha, alpha)))


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
    cuts,
    rows,
    state,
    blocks,
    entry_sums,
):  # type: ignore[no-untyped-def]
    """Sweep through one tile's entries ``first`` to ``last``."""
    alive = 0
    for block in range(layout.BLOCKS):
        block_x, block_y = block_corner(block)
        if block_x < across and block_y < down:
            alive |= 1 << block
    middle_x, middle_y = np.float32(corner_x + 0.5 * layout.TILE), np.float32(corner_y + 0.5 * layout.TILE)
    while first < last:
        end = min(first + CHUNK, last)
        fetch_chunk(first, end, alive, cells, records, depths, middle_x, middle_y, rows, blocks)
        for entry in range(end - first):
            ahead = cells[layout.CELL * min(first + entry + _AHEAD, last - 1) + 2]
            prefetch_to_write(entry_sums, layout.ROW * ahead)
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
        at = _STATE * block
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
