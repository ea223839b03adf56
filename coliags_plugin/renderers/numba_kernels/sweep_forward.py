"""Forward pass of compositing, tile by tile and block by block, front to back.

A block of 4 x 4 pixels is one vector, and its accumulators stay in registers while its Gaussians are composited. The
formulas are those of ``docs/rendering.md``, section "Compositing".
"""

from __future__ import annotations

from coliags_plugin.core.numba_kernels import lanes as vec
from coliags_plugin.core.numba_kernels.compilation import kernel, part
from coliags_plugin.core.numba_kernels.threads import pieces, take
from coliags_plugin.renderers.numba_kernels import layout
from coliags_plugin.renderers.numba_kernels.tiles import (
    ALPHA,
    CHUNK,
    MEDIAN_DEPTH,
    OFFSET_E,
    OFFSET_F,
    TRANSMITTANCE,
    block_pixels,
    fetch_chunk,
    image_copies,
    tile_sweep,
)

# A block's vectors: transmittance, alpha, channels and, behind them, the median depth.
_CHANNELS = 32
_STATE = _CHANNELS + 16 * (layout.MAX_CHANNELS + 1)
#: Depth over alpha takes the place of the transmittance when that has done its work.
_EXPECTED = TRANSMITTANCE

#: Scratch of one thread: rows of a chunk, states of a tile's blocks.
NUMBERS = CHUNK * layout.ROW + layout.BLOCKS * _STATE
#: Scratch of one thread: blocks of a chunk's entries, entries of a tile's blocks, and how many.
INTEGERS = CHUNK + layout.BLOCKS * CHUNK + layout.BLOCKS


@kernel
def sweep(counters, projections, bins, view, grid, channels, extras, scratch, composited, images):
    """Composite all tiles; writes ``bins.reached``, the images that are not empty, and ``composited``.

    The last is for the backward sweep: alpha and channels without background, a vector each, by tile and block.
    """
    thread = take(counters, 1, 1)
    rows = scratch.numbers[thread * NUMBERS : (thread + 1) * NUMBERS]
    state, median = rows[CHUNK * layout.ROW :], extras.median
    blocks = scratch.integers[thread * INTEGERS : (thread + 1) * INTEGERS]
    for place in pieces(counters, 0, grid.tiles):
        tile = bins.order[place]
        bins.reached[tile] = _sweep_tile(tile, projections, bins, view, grid, channels, median, rows, state, blocks)
        _finish_tile(tile, channels, view, extras.depth, state, composited)
        _write_tile(tile, grid, extras, state, images)


@part
def _sweep_block(block, count, listed, rows, channels, median, view, state):
    """Composite the first ``count`` rows listed into one block; whether any pixel has transmittance left."""
    x, y = block_pixels(block)
    log2_alpha_min, alpha_max, transmittance_min = vec.broadcast_all(view, layout.VIEW_LOG2_ALPHA_MIN, (0, 0, 0))
    at = _STATE * block
    transmittance, alpha_sum = vec.load(state, at + TRANSMITTANCE), vec.load(state, at + ALPHA)
    sums = vec.load_all(state, at + _CHANNELS, channels)
    medians = vec.load_all(state, at + _CHANNELS + 16 * len(channels), median)
    running = 1
    for place in range(count):
        row = listed[place]
        e = vec.fma(vec.broadcast(rows, row + layout.U_XX), x, vec.broadcast(rows, row + OFFSET_E))
        f = vec.fma(vec.broadcast(rows, row + layout.U_YY), y, vec.broadcast(rows, row + OFFSET_F))
        f = vec.fma(vec.broadcast(rows, row + layout.U_YX), x, f)
        log2_alpha = vec.fma(vec.neg(e), e, vec.fma(vec.neg(f), f, vec.broadcast(rows, row + layout.LOG2_OPACITY)))
        alpha = vec.smaller(vec.exp2(log2_alpha), alpha_max)
        alpha = vec.select(vec.at_least(log2_alpha, log2_alpha_min), alpha, 0.0)
        behind = vec.mul(transmittance, vec.sub(1.0, alpha))
        drawn = vec.at_least(behind, transmittance_min)
        weight = vec.select(drawn, vec.mul(alpha, transmittance), 0.0)
        alpha_sum = vec.add(alpha_sum, weight)
        sums = vec.fma(weight, vec.broadcast_all(rows, row + layout.CHANNELS, channels), sums)
        if len(median) > 0:
            crosses = vec.both(vec.both(drawn, vec.greater(transmittance, 0.5)), vec.at_most(behind, 0.5))
            medians = vec.select(crosses, vec.broadcast_all(rows, row + MEDIAN_DEPTH, median), medians)
        # Once zero it stays zero, so compositing does not resume.
        transmittance = vec.select(drawn, behind, 0.0)
        running = vec.bits(drawn)
        if not running:
            break
    vec.store(state, at + TRANSMITTANCE, transmittance)
    vec.store(state, at + ALPHA, alpha_sum)
    vec.store_all(state, at + _CHANNELS, sums)
    vec.store_all(state, at + _CHANNELS + 16 * len(channels), medians)
    return running


_sweep_tile = tile_sweep(fetch_chunk, _sweep_block, layout.ROW, _STATE)
_copy_to_image, _ = image_copies(_STATE)


@part
def _finish_tile(tile, channels, view, has_depth, state, composited):
    """Store the blocks' sums in ``composited``; then add the background, and divide depth by alpha."""
    size = 16 * (1 + len(channels))
    background = vec.broadcast_all(view, layout.VIEW_BACKGROUND, (0, 0, 0))
    for block in range(layout.BLOCKS):
        at, target = _STATE * block, size * (layout.BLOCKS * tile + block)
        alpha = vec.load(state, at + ALPHA)
        vec.store(composited, target, alpha)
        vec.store_all(composited, target + 16, vec.load_all(state, at + _CHANNELS, channels))
        if has_depth:
            expected = vec.div(vec.load(state, at + _CHANNELS + 48), alpha)
            vec.store(state, at + _EXPECTED, vec.select(vec.greater(alpha, 0.0), expected, 0.0))
        color = vec.load_all(state, at + _CHANNELS, (0, 0, 0))
        vec.store_all(state, at + _CHANNELS, vec.fma(vec.sub(1.0, alpha), background, color))


@part
def _write_tile(tile, grid, extras, state, images):
    """Copy a tile's pixels from its blocks to the images."""
    for channel in range(3):
        _copy_to_image(_CHANNELS + 16 * channel, state, tile, grid, 3, channel, images.rgb)
    _copy_to_image(ALPHA, state, tile, grid, 1, 0, images.alpha)
    at = _CHANNELS + 48
    if extras.depth:
        _copy_to_image(at, state, tile, grid, 1, 0, images.depth)
        _copy_to_image(_EXPECTED, state, tile, grid, 1, 0, images.expected)
        at += 16
    if extras.inverse_depth:
        _copy_to_image(at, state, tile, grid, 1, 0, images.inverse_depth)
        at += 16
    if extras.normals:
        for axis in range(3):
            _copy_to_image(at + 16 * axis, state, tile, grid, 3, axis, images.normals)
        at += 48
    _copy_to_image(at, state, tile, grid, 1, 0, images.median)
