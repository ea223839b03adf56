"""Forward pass of compositing for surfels, tile by tile and block by block, front to back.

As ``sweep_forward``, but the ray of every pixel is intersected with every disc, so depths differ from pixel to pixel.
The formulas are those of ``docs/rendering.md``, section "Surfels".
"""

from __future__ import annotations

from coliags_plugin.core.numba_kernels import lanes as vec
from coliags_plugin.core.numba_kernels.compilation import kernel, part
from coliags_plugin.core.numba_kernels.threads import pieces, take
from coliags_plugin.renderers.numba_kernels import layout, surfel_layout
from coliags_plugin.renderers.numba_kernels.surfel_tiles import (
    FETCHED,
    INVERSE_DEPTH,
    fetch_surfels,
    intersect,
    scaled_pixels,
)
from coliags_plugin.renderers.numba_kernels.tiles import ALPHA, CHUNK, TRANSMITTANCE, image_copies, tile_sweep

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
def sweep(counters, projections, bins, view, grid, channels, measures, scratch, composited, images):
    """Composite all tiles; writes ``bins.reached``, the images that are not empty, and ``composited``.

    The last is for the backward sweep, vectors by tile and block: alpha, channels without background, depth and inverse depth,
    and the mean and the summed squared differences of the latter.
    """
    thread = take(counters, 1, 1)
    rows = scratch.numbers[thread * NUMBERS : (thread + 1) * NUMBERS]
    state, source = rows[CHUNK * FETCHED :], (projections.records, projections.remainders, view)
    blocks = scratch.integers[thread * INTEGERS : (thread + 1) * INTEGERS]
    for place in pieces(counters, 0, grid.tiles):
        tile = bins.order[place]
        bins.reached[tile] = _sweep_tile(tile, source, bins, view, grid, channels, measures, rows, state, blocks)
        _finish_tile(tile, channels, measures, view, state, composited)
        _write_tile(tile, grid, channels, measures, state, images)


@part
def _sweep_block(block, count, listed, rows, channels, measures, view, state):
    """Composite the first ``count`` rows listed into one block; whether any pixel has transmittance left."""
    x, y = scaled_pixels(block, view)
    log2_alpha_min, alpha_max, transmittance_min = vec.broadcast_all(view, layout.VIEW_LOG2_ALPHA_MIN, (0, 0, 0))
    at = _STATE * block
    transmittance, alpha_sum = vec.load(state, at + TRANSMITTANCE), vec.load(state, at + ALPHA)
    sums = vec.load_all(state, at + _CHANNELS, channels)
    depths = vec.load_all(state, at + _DEPTH, measures.depth)
    inverse_depths = vec.load_all(state, at + _INVERSE_DEPTH, measures.inverse_depth)
    medians = vec.load_all(state, at + _MEDIAN, measures.median)
    nearest = vec.load_all(state, at + _NEAREST, measures.distortion)
    differences = vec.load_all(state, at + _DIFFERENCE, measures.distortion)
    squares = vec.load_all(state, at + _SQUARE, measures.distortion)
    running = 1
    for place in range(count):
        row = listed[place]
        d_x, d_y, q, inverse_q, e, f, hit = intersect(rows, row, x, y)
        squared = vec.smaller(vec.fma(e, e, vec.mul(f, f)), vec.fma(d_x, d_x, vec.mul(d_y, d_y)))
        log2_alpha = vec.sub(vec.broadcast(rows, row + surfel_layout.LOG2_OPACITY), squared)
        alpha = vec.smaller(vec.exp2(log2_alpha), alpha_max)
        alpha = vec.select(vec.both(hit, vec.at_least(log2_alpha, log2_alpha_min)), alpha, 0.0)
        behind = vec.mul(transmittance, vec.sub(1.0, alpha))
        drawn = vec.at_least(behind, transmittance_min)
        weight = vec.select(drawn, vec.mul(alpha, transmittance), 0.0)
        sums = vec.fma(weight, vec.broadcast_all(rows, row + surfel_layout.CHANNELS, channels), sums)
        z = vec.mul(vec.broadcast(rows, row + surfel_layout.DEPTH), inverse_q)
        depths = vec.fma(weight, z, depths)
        inverse_z = vec.mul(vec.broadcast(rows, row + INVERSE_DEPTH), q)
        inverse_depths = vec.fma(weight, inverse_z, inverse_depths)
        if len(measures.median) > 0:
            crosses = vec.both(vec.both(drawn, vec.greater(transmittance, 0.5)), vec.at_most(behind, 0.5))
            medians = vec.select(crosses, z, medians)
        if len(measures.distortion) > 0:
            # Squares of differences to a depth among them lose little where 1/z hardly differs; those of 1/z would.
            nearest = vec.select(vec.greater(alpha_sum, 0.0), nearest, inverse_z)
            moved = vec.sub(inverse_z, nearest)
            of_weight = vec.mul(weight, moved)
            differences, squares = vec.add(differences, of_weight), vec.fma(of_weight, moved, squares)
        alpha_sum = vec.add(alpha_sum, weight)
        # Once zero it stays zero, so compositing does not resume.
        transmittance = vec.select(drawn, behind, 0.0)
        running = vec.bits(drawn)
        if not running:
            break
    vec.store(state, at + TRANSMITTANCE, transmittance)
    vec.store(state, at + ALPHA, alpha_sum)
    vec.store_all(state, at + _CHANNELS, sums)
    vec.store_all(state, at + _DEPTH, depths)
    vec.store_all(state, at + _INVERSE_DEPTH, inverse_depths)
    vec.store_all(state, at + _MEDIAN, medians)
    vec.store_all(state, at + _NEAREST, nearest)
    vec.store_all(state, at + _DIFFERENCE, differences)
    vec.store_all(state, at + _SQUARE, squares)
    return running


_sweep_tile = tile_sweep(fetch_surfels, _sweep_block, FETCHED, _STATE)
_copy_to_image, _ = image_copies(_STATE)


@part
def _finish_tile(tile, channels, measures, view, state, composited):
    """Store the blocks' sums in ``composited``; then add the background, divide depth by alpha, and find the distortion."""
    width = 1 + len(channels) + len(measures.depth) + len(measures.inverse_depth) + 2 * len(measures.distortion)
    background = vec.broadcast_all(view, layout.VIEW_BACKGROUND, (0, 0, 0))
    for block in range(layout.BLOCKS):
        at, target = _STATE * block, 16 * width * (layout.BLOCKS * tile + block)
        alpha = vec.load(state, at + ALPHA)
        covered = vec.greater(alpha, 0.0)
        vec.store(composited, target, alpha)
        vec.store_all(composited, target + 16, vec.load_all(state, at + _CHANNELS, channels))
        target += 16 * (1 + len(channels))
        if len(measures.depth) > 0:
            depth = vec.load(state, at + _DEPTH)
            vec.store(composited, target, depth)
            vec.store(state, at + _EXPECTED, vec.select(covered, vec.div(depth, alpha), 0.0))
            target += 16
        if len(measures.inverse_depth) > 0:
            vec.store(composited, target, vec.load(state, at + _INVERSE_DEPTH))
            target += 16
        if len(measures.distortion) > 0:
            difference = vec.load(state, at + _DIFFERENCE)
            mean = vec.select(covered, vec.div(difference, alpha), 0.0)
            squares = vec.larger(vec.fma(vec.neg(difference), mean, vec.load(state, at + _SQUARE)), 0.0)
            vec.store(composited, target, vec.add(vec.load(state, at + _NEAREST), mean))
            vec.store(composited, target + 16, squares)
            distortion = vec.mul(vec.broadcast(view, layout.VIEW_DISTORTION), vec.mul(alpha, squares))
            vec.store(state, at + _DISTORTION, distortion)
        color = vec.load_all(state, at + _CHANNELS, (0, 0, 0))
        vec.store_all(state, at + _CHANNELS, vec.fma(vec.sub(1.0, alpha), background, color))


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
