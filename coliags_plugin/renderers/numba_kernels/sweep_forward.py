"""Forward pass of compositing, tile by tile and block by block, front to back.

A block of 4 x 4 pixels is one vector, and its accumulators stay in registers while its Gaussians are composited. The
formulas are those of ``docs/rendering.md``, section "Compositing".
"""

from __future__ import annotations

from coliags_plugin.core.numba_compilation import kernel, part
from coliags_plugin.renderers.numba_kernels import layout
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
    load,
    load_all,
    mul,
    neg,
    select,
    smaller,
    store,
    store_all,
    sub,
)
from coliags_plugin.renderers.numba_kernels.threads import take
from coliags_plugin.renderers.numba_kernels.tiles import (
    ALPHA,
    CHUNK,
    MEDIAN_DEPTH,
    OFFSET_E,
    OFFSET_F,
    TRANSMITTANCE,
    block_corner,
    copy_to_image,
    fetch_chunk,
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
def sweep_forward(counters, projections, bins, view, grid, extras, channels, median, scratch, composited, images):
    """Composite all tiles.

    Args:
        counters: Work counters for dynamic scheduling; entries 0 and 1 must be 0.
        projections, bins: What projection and binning wrote; ``bins.reached`` is written here.
        view: See ``layout``.
        grid: The image and its tiles.
        extras: What is composited besides colour.
        channels: Any tuple as long as there are channels.
        median: A tuple with one element where the median depth is wanted, an empty one where it is not.
        scratch: NUMBERS and INTEGERS for each thread.
        composited: Out, for the backward sweep: alpha and channels without background, by tile and block.
            [16 for each block and alpha or channel]
        images: Out; those that are empty are not written.
    """
    thread = take(counters, 1, 1)
    rows = scratch.numbers[thread * NUMBERS : (thread + 1) * NUMBERS]
    state = rows[CHUNK * layout.ROW :]
    blocks = scratch.integers[thread * INTEGERS : (thread + 1) * INTEGERS]
    while True:
        place = take(counters, 0, 1)
        if place >= grid.tiles:
            break
        tile = bins.order[place]
        bins.reached[tile] = _sweep_tile(tile, projections, bins, view, grid, channels, median, rows, state, blocks)
        _finish_tile(tile, channels, view, extras.depth, state, composited)
        _write_tile(tile, grid, extras, state, images)


@part
def _sweep_block(block, count, listed, rows, channels, median, view, state):
    """Composite the first ``count`` rows listed into one block.

    Returns:
        Whether any pixel has transmittance left.
    """
    block_x, block_y = block_corner(block)
    half = 0.5 * layout.TILE - 0.5
    x, y = add(lane_columns(), block_x - half), add(lane_rows(), block_y - half)
    log2_alpha_min, alpha_max = broadcast(view, layout.VIEW_LOG2_ALPHA_MIN), broadcast(view, layout.VIEW_ALPHA_MAX)
    transmittance_min = broadcast(view, layout.VIEW_TRANSMITTANCE_MIN)
    at = _STATE * block
    transmittance, alpha_sum = load(state, at + TRANSMITTANCE), load(state, at + ALPHA)
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
        # Once zero it stays zero, so compositing does not resume.
        transmittance = select(drawn, behind, 0.0)
        running = bits(drawn)
        if not running:
            break
    store(state, at + TRANSMITTANCE, transmittance)
    store(state, at + ALPHA, alpha_sum)
    store_all(state, at + _CHANNELS, sums)
    store_all(state, at + _CHANNELS + 16 * len(channels), medians)
    return running


_sweep_tile = tile_sweep(fetch_chunk, _sweep_block, layout.ROW, _STATE)


@part
def _finish_tile(tile, channels, view, has_depth, state, composited):
    """Store the blocks' sums in ``composited``; then add the background, and divide depth by alpha."""
    size = 16 * (1 + len(channels))
    background = broadcast_all(view, layout.VIEW_BACKGROUND, (0, 0, 0))
    for block in range(layout.BLOCKS):
        at, target = _STATE * block, size * (layout.BLOCKS * tile + block)
        alpha = load(state, at + ALPHA)
        store(composited, target, alpha)
        store_all(composited, target + 16, load_all(state, at + _CHANNELS, channels))
        if has_depth:
            expected = div(load(state, at + _CHANNELS + 48), alpha)
            store(state, at + _EXPECTED, select(greater(alpha, 0.0), expected, 0.0))
        color = load_all(state, at + _CHANNELS, (0, 0, 0))
        store_all(state, at + _CHANNELS, fma(sub(1.0, alpha), background, color))


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


@part
def _copy_to_image(vector, state, tile, grid, depth, channel, image):
    copy_to_image(vector, state, _STATE, tile, grid, depth, channel, image)
