"""Backward pass of compositing, tile by tile, front to back.

With g the derivative of the loss with respect to a pixel's composited channels, what a Gaussian of weight w and
channels c shows is w (g . c). A running difference, first the whole pixel's (g . composited), tells what everything
behind it still shows; see ``docs/rendering.md``, section "Derivatives". Nothing is kept from the forward sweep but what
it composited.
"""

from __future__ import annotations

from coliags_plugin.core.numba_kernels import lanes as vec
from coliags_plugin.core.numba_kernels.compilation import inline, kernel, part
from coliags_plugin.core.numba_kernels.threads import pieces, take
from coliags_plugin.renderers.numba_kernels import layout
from coliags_plugin.renderers.numba_kernels.tiles import (
    CHUNK,
    OFFSET_E,
    OFFSET_F,
    block_pixels,
    fetch_chunk,
    image_copies,
    inside,
    tile_corner,
    tile_sweep_backward,
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
NUMBERS = CHUNK * layout.ROW + layout.BLOCKS * _STATE
#: Scratch of one thread: blocks of a chunk's entries.
INTEGERS = CHUNK


@kernel
def sweep(counters, projections, bins, view, grid, channels, extras, scratch, composited, of_images, entry_sums):
    """Write the gradient sums over the pixels of each entry: see ``layout``. Empty ``of_images`` are 0."""
    thread = take(counters, 1, 1)
    rows = scratch.numbers[thread * NUMBERS : (thread + 1) * NUMBERS]
    state = rows[CHUNK * layout.ROW :]
    blocks = scratch.integers[thread * INTEGERS : (thread + 1) * INTEGERS]
    for place in pieces(counters, 0, grid.tiles):
        tile = bins.order[place]
        if bins.starts[tile] < bins.reached[tile]:
            _read_tile(tile, grid, extras, channels, of_images, state)
            _prepare_tile(tile, channels, view, extras.depth, composited, state)
            _sweep_tile(tile, projections, bins, view, grid, channels, (), rows, state, blocks, entry_sums)
        for entry in range(bins.reached[tile], bins.starts[tile + 1]):
            vec.store(entry_sums, layout.ROW * bins.cells[layout.CELL * entry + 2], 0.0)


@part
def _read_tile(tile, grid, extras, channels, of_images, state):
    """Fill the states of a tile's blocks; the derivative with respect to depth over alpha goes to ``_BEHIND``."""
    _, _, across, down = tile_corner(tile, grid)
    for block in range(layout.BLOCKS):
        at = _STATE * block
        x, y = block_pixels(block)
        vec.store(state, at + _X, x)
        vec.store(state, at + _Y, y)
        vec.store(state, at + _TRANSMITTANCE, vec.select(inside(block, across, down), 1.0, 0.0))
        vec.store(state, at + _BEHIND, 0.0)
        vec.store(state, at + _ALPHA, 0.0)
        vec.store_all(state, at + _CHANNELS, vec.repeat(0.0, channels))
    for channel in range(3):
        _copy_from_image(of_images.rgb, 3, channel, tile, grid, _CHANNELS + 16 * channel, state)
    _copy_from_image(of_images.alpha, 1, 0, tile, grid, _ALPHA, state)
    at = _CHANNELS + 48
    if extras.depth:
        _copy_from_image(of_images.depth, 1, 0, tile, grid, at, state)
        _copy_from_image(of_images.expected, 1, 0, tile, grid, _BEHIND, state)
        at += 16
    if extras.inverse_depth:
        _copy_from_image(of_images.inverse_depth, 1, 0, tile, grid, at, state)
        at += 16
    for axis in range(3):
        _copy_from_image(of_images.normals, 3, axis, tile, grid, at + 16 * axis, state)


@part
def _prepare_tile(tile, channels, view, has_depth, composited, state):
    """Turn derivatives with respect to images into those with respect to sums, and initialise the running difference."""
    size = 16 * (1 + len(channels))
    background = vec.broadcast_all(view, layout.VIEW_BACKGROUND, (0, 0, 0))
    for block in range(layout.BLOCKS):
        at, source = _STATE * block, size * (layout.BLOCKS * tile + block)
        alpha, sums = vec.load(composited, source), vec.load_all(composited, source + 16, channels)
        shaded = vec.dot(vec.load_all(state, at + _CHANNELS, (0, 0, 0)), background, 0.0)
        of_alpha = vec.sub(vec.load(state, at + _ALPHA), shaded)
        if has_depth:
            covered = vec.greater(alpha, 0.0)
            share = vec.select(covered, vec.div(vec.load(state, at + _BEHIND), alpha), 0.0)
            vec.store(state, at + _CHANNELS + 48, vec.add(vec.load(state, at + _CHANNELS + 48), share))
            depth = vec.load(composited, source + 64)
            of_alpha = vec.sub(of_alpha, vec.select(covered, vec.mul(share, vec.div(depth, alpha)), 0.0))
        vec.store(state, at + _ALPHA, of_alpha)
        given = vec.load_all(state, at + _CHANNELS, channels)
        vec.store(state, at + _BEHIND, vec.dot(given, sums, vec.mul(of_alpha, alpha)))


@inline
def _sweep_entry(row, blocks, alive, rows, channels, _own, view, state, target, _further, entry_sums):
    """Accumulate one entry's sums over its blocks; returns the blocks with transmittance left, one bit each.

    Broadcasting the row's numbers again for each block costs nothing, for the processor does it as it reads them; kept
    in registers they would crowd out the sums.
    """
    zero = vec.splat(0.0)
    sum_v, sum_e, sum_f, sum_ee, sum_ef, sum_ff = zero, zero, zero, zero, zero, zero
    sums = vec.repeat(0.0, channels)
    while blocks:
        block = vec.lowest_bit(blocks)
        blocks &= blocks - 1
        at = _STATE * block
        x, y = vec.load(state, at + _X), vec.load(state, at + _Y)
        e = vec.fma(vec.broadcast(rows, row + layout.U_XX), x, vec.broadcast(rows, row + OFFSET_E))
        f = vec.fma(vec.broadcast(rows, row + layout.U_YY), y, vec.broadcast(rows, row + OFFSET_F))
        f = vec.fma(vec.broadcast(rows, row + layout.U_YX), x, f)
        log2_alpha = vec.fma(vec.neg(e), e, vec.fma(vec.neg(f), f, vec.broadcast(rows, row + layout.LOG2_OPACITY)))
        free_alpha = vec.exp2(log2_alpha)
        alpha = vec.smaller(free_alpha, vec.broadcast(view, layout.VIEW_ALPHA_MAX))
        alpha = vec.select(vec.at_least(log2_alpha, vec.broadcast(view, layout.VIEW_LOG2_ALPHA_MIN)), alpha, 0.0)
        transmittance = vec.load(state, at + _TRANSMITTANCE)
        through = vec.sub(1.0, alpha)
        behind = vec.mul(transmittance, through)
        drawn = vec.at_least(behind, vec.broadcast(view, layout.VIEW_TRANSMITTANCE_MIN))
        weight = vec.select(drawn, vec.mul(alpha, transmittance), 0.0)
        vec.store(state, at + _TRANSMITTANCE, vec.select(drawn, behind, 0.0))

        given = vec.load_all(state, at + _CHANNELS, channels)
        own = vec.broadcast_all(rows, row + layout.CHANNELS, channels)
        shown = vec.mul(weight, vec.dot(own, given, vec.load(state, at + _ALPHA)))
        hidden = vec.sub(vec.load(state, at + _BEHIND), shown)
        vec.store(state, at + _BEHIND, hidden)
        v = vec.sub(shown, vec.mul(vec.quick_div(alpha, through), hidden))
        v = vec.select(vec.both(drawn, vec.less(free_alpha, vec.broadcast(view, layout.VIEW_ALPHA_MAX))), v, 0.0)
        v_e, v_f = vec.mul(v, e), vec.mul(v, f)
        sum_v, sum_e, sum_f = vec.add(sum_v, v), vec.add(sum_e, v_e), vec.add(sum_f, v_f)
        sum_ee, sum_ef, sum_ff = vec.fma(v_e, e, sum_ee), vec.fma(v_e, f, sum_ef), vec.fma(v_f, f, sum_ff)
        sums = vec.fma(weight, given, sums)
        if not vec.bits(drawn):
            alive &= ~(1 << block)
    vec.store(entry_sums, target, vec.lane_sums((sum_v, sum_e, sum_f, sum_ee, sum_ef, sum_ff) + sums))
    return alive


_sweep_tile = tile_sweep_backward(fetch_chunk, _sweep_entry, layout.ROW)
_, _copy_from_image = image_copies(_STATE)
