"""Forward pass of compositing for surfels, tile by tile and block by block, front to back.

As ``sweep_forward``, but the ray of every pixel is intersected with every disc, so depths differ from pixel to pixel.
The formulas are those of ``docs/rendering.md``, section "Surfels".
"""

from __future__ import annotations

from coliags_plugin.core.numba_compilation import kernel, part
from coliags_plugin.renderers.numba_kernels import layout, surfel_layout
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
    larger,
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
from coliags_plugin.renderers.numba_kernels.surfel_tiles import (
    FETCHED,
    INVERSE_DEPTH,
    fetch_surfels,
    intersect,
    scaled_pixels,
)
from coliags_plugin.renderers.numba_kernels.threads import take
from coliags_plugin.renderers.numba_kernels.tiles import ALPHA, CHUNK, TRANSMITTANCE, copy_to_image, tile_sweep

# A block's vectors: transmittance, alpha, channels, sums of the measures and the median; of the reciprocal depths 1/z
# the first and the sums of differences to it and of their squares.
_CHANNELS = 32
_DEPTH = _CHANNELS + 16 * surfel_layout.MAX_CHANNELS
_INVERSE_DEPTH = _DEPTH + 16
_MEDIAN = _DEPTH + 32
_NEAREST = _DEPTH + 48
_DIFFERENCE = _DEPTH + 64
_SQUARE = _DEPTH + 80
_STATE = _DEPTH + 96
#: These take the place of others when they have done their work.
_EXPECTED = TRANSMITTANCE
_DISTORTION = _NEAREST

#: Scratch of one thread: rows of a chunk, states of a tile's blocks.
NUMBERS = CHUNK * FETCHED + layout.BLOCKS * _STATE
#: Scratch of one thread: blocks of a chunk's entries, entries of a tile's blocks, and how many.
INTEGERS = CHUNK + layout.BLOCKS * CHUNK + layout.BLOCKS


@kernel
def sweep_surfels(counters, records, remainders, bins, view, grid, channels, measures, scratch, composited, images):
    """Composite all tiles.

    Args:
        counters: Work counters for dynamic scheduling; entries 0 and 1 must be 0.
        records, remainders, bins: What projection and binning wrote; ``bins.reached`` is written here.
        view: See ``layout``.
        grid: The image and its tiles.
        channels: Any tuple as long as there are channels.
        measures: What is composited besides. [surfel_layout.Measures]
        scratch: NUMBERS and INTEGERS for each thread.
        composited: Out, for the backward sweep: alpha, channels without background, depth and inverse depth, and the
            mean and the summed squared differences of the latter, by tile and block. [16 for each block and each]
        images: Out; those that are empty are not written.
    """
    thread = take(counters, 1, 1)
    rows = scratch.numbers[thread * NUMBERS : (thread + 1) * NUMBERS]
    state, source = rows[CHUNK * FETCHED :], (records, remainders, view)
    blocks = scratch.integers[thread * INTEGERS : (thread + 1) * INTEGERS]
    while True:
        place = take(counters, 0, 1)
        if place >= grid.tiles:
            break
        tile = bins.order[place]
        bins.reached[tile] = _sweep_tile(tile, source, bins, view, grid, channels, measures, rows, state, blocks)
        _finish_tile(tile, channels, measures, view, state, composited)
        _write_tile(tile, grid, channels, measures, state, images)


@part
def _sweep_block(block, count, listed, rows, channels, measures, view, state):
    """Composite the first ``count`` rows listed into one block.

    Returns:
        Whether any pixel has transmittance left.
    """
    x, y = scaled_pixels(block, view)
    log2_alpha_min, alpha_max = broadcast(view, layout.VIEW_LOG2_ALPHA_MIN), broadcast(view, layout.VIEW_ALPHA_MAX)
    transmittance_min = broadcast(view, layout.VIEW_TRANSMITTANCE_MIN)
    at = _STATE * block
    transmittance, alpha_sum = load(state, at + TRANSMITTANCE), load(state, at + ALPHA)
    sums = load_all(state, at + _CHANNELS, channels)
    depths = load_all(state, at + _DEPTH, measures.depth)
    inverse_depths = load_all(state, at + _INVERSE_DEPTH, measures.inverse_depth)
    medians = load_all(state, at + _MEDIAN, measures.median)
    nearest = load_all(state, at + _NEAREST, measures.distortion)
    differences = load_all(state, at + _DIFFERENCE, measures.distortion)
    squares = load_all(state, at + _SQUARE, measures.distortion)
    running = 1
    for place in range(count):
        row = listed[place]
        d_x, d_y, q, inverse_q, e, f, hit = intersect(rows, row, x, y)
        squared = smaller(fma(e, e, mul(f, f)), fma(d_x, d_x, mul(d_y, d_y)))
        log2_alpha = sub(broadcast(rows, row + surfel_layout.LOG2_OPACITY), squared)
        alpha = smaller(exp2(log2_alpha), alpha_max)
        alpha = select(both(hit, at_least(log2_alpha, log2_alpha_min)), alpha, 0.0)
        behind = mul(transmittance, sub(1.0, alpha))
        drawn = at_least(behind, transmittance_min)
        weight = select(drawn, mul(alpha, transmittance), 0.0)
        sums = fma(weight, broadcast_all(rows, row + surfel_layout.CHANNELS, channels), sums)
        z = mul(broadcast(rows, row + surfel_layout.DEPTH), inverse_q)
        depths = fma(weight, z, depths)
        inverse_z = mul(broadcast(rows, row + INVERSE_DEPTH), q)
        inverse_depths = fma(weight, inverse_z, inverse_depths)
        if len(measures.median) > 0:
            crosses = both(both(drawn, greater(transmittance, 0.5)), at_most(behind, 0.5))
            medians = select(crosses, z, medians)
        if len(measures.distortion) > 0:
            # Squares of differences to a depth among them lose little where 1/z hardly differs; those of 1/z would.
            nearest = select(greater(alpha_sum, 0.0), nearest, inverse_z)
            moved = sub(inverse_z, nearest)
            of_weight = mul(weight, moved)
            differences, squares = add(differences, of_weight), fma(of_weight, moved, squares)
        alpha_sum = add(alpha_sum, weight)
        # Once zero it stays zero, so compositing does not resume.
        transmittance = select(drawn, behind, 0.0)
        running = bits(drawn)
        if not running:
            break
    store(state, at + TRANSMITTANCE, transmittance)
    store(state, at + ALPHA, alpha_sum)
    store_all(state, at + _CHANNELS, sums)
    store_all(state, at + _DEPTH, depths)
    store_all(state, at + _INVERSE_DEPTH, inverse_depths)
    store_all(state, at + _MEDIAN, medians)
    store_all(state, at + _NEAREST, nearest)
    store_all(state, at + _DIFFERENCE, differences)
    store_all(state, at + _SQUARE, squares)
    return running


_sweep_tile = tile_sweep(fetch_surfels, _sweep_block, FETCHED, _STATE)


@part
def _finish_tile(tile, channels, measures, view, state, composited):
    """Store the blocks' sums in ``composited``; then add the background, divide depth by alpha, and find the distortion."""
    width = 1 + len(channels) + len(measures.depth) + len(measures.inverse_depth) + 2 * len(measures.distortion)
    background = broadcast_all(view, layout.VIEW_BACKGROUND, (0, 0, 0))
    for block in range(layout.BLOCKS):
        at, target = _STATE * block, 16 * width * (layout.BLOCKS * tile + block)
        alpha = load(state, at + ALPHA)
        covered = greater(alpha, 0.0)
        store(composited, target, alpha)
        store_all(composited, target + 16, load_all(state, at + _CHANNELS, channels))
        target += 16 * (1 + len(channels))
        if len(measures.depth) > 0:
            depth = load(state, at + _DEPTH)
            store(composited, target, depth)
            store(state, at + _EXPECTED, select(covered, div(depth, alpha), 0.0))
            target += 16
        if len(measures.inverse_depth) > 0:
            store(composited, target, load(state, at + _INVERSE_DEPTH))
            target += 16
        if len(measures.distortion) > 0:
            difference = load(state, at + _DIFFERENCE)
            mean = select(covered, div(difference, alpha), 0.0)
            squares = larger(fma(neg(difference), mean, load(state, at + _SQUARE)), 0.0)
            store(composited, target, add(load(state, at + _NEAREST), mean))
            store(composited, target + 16, squares)
            store(state, at + _DISTORTION, mul(broadcast(view, layout.VIEW_DISTORTION), mul(alpha, squares)))
        color = load_all(state, at + _CHANNELS, (0, 0, 0))
        store_all(state, at + _CHANNELS, fma(sub(1.0, alpha), background, color))


@part
def _write_tile(tile, grid, channels, measures, state, images):
    """Copy a tile's pixels from its blocks to the images."""
    for channel in range(3):
        _copy_to_image(_CHANNELS + 16 * channel, state, tile, grid, 3, channel, images.rgb)
        if len(channels) > 3:
            _copy_to_image(_CHANNELS + 48 + 16 * channel, state, tile, grid, 3, channel, images.normals)
    for vector, image in (
        (ALPHA, images.alpha),
        (_DEPTH, images.depth),
        (_INVERSE_DEPTH, images.inverse_depth),
        (_EXPECTED, images.expected),
        (_MEDIAN, images.median),
        (_DISTORTION, images.distortion),
    ):
        _copy_to_image(vector, state, tile, grid, 1, 0, image)


@part
def _copy_to_image(vector, state, tile, grid, depth, channel, image):
    copy_to_image(vector, state, _STATE, tile, grid, depth, channel, image)
