"""Backward pass of compositing for surfels, tile by tile, front to back.

As ``sweep_backward``: a running difference tells what everything behind a surfel still shows. The sums are those of
``surfel_layout``: where the disc counts, the derivatives with respect to the intersection of ray and disc.
"""

from __future__ import annotations

import math

from coliags_plugin.core.numba_kernels import lanes as vec
from coliags_plugin.core.numba_kernels.compilation import inline, kernel, part
from coliags_plugin.core.numba_kernels.threads import pieces, take
from coliags_plugin.renderers.numba_kernels import layout, surfel_layout
from coliags_plugin.renderers.numba_kernels.surfel_tiles import (
    FETCHED,
    INVERSE_DEPTH,
    fetch_surfels,
    intersect,
    scaled_pixels,
)
from coliags_plugin.renderers.numba_kernels.tiles import CHUNK, image_copies, inside, tile_corner, tile_sweep_backward

# A block's vectors: x and y of its pixels, transmittance, what is still to be shown, and the derivatives with respect to
# alpha, each channel, the sums of the measures and the median depth; of the distortion the mean of 1/z, and what
# squared differences to it and all weights are multiplied by.
_X = 0
_Y = 16
_TRANSMITTANCE = 32
_BEHIND = 48
_ALPHA = 64
_CHANNELS = 80
_DEPTH = _CHANNELS + 16 * surfel_layout.MAX_CHANNELS
_INVERSE_DEPTH = _DEPTH + 16
_MEDIAN = _DEPTH + 32
_MEAN = _DEPTH + 48
_OF_SQUARE = _DEPTH + 64
_OF_WEIGHT = _DEPTH + 80
_STATE = _DEPTH + 96

#: Scratch of one thread: rows of a chunk, states of a tile's blocks.
NUMBERS = CHUNK * FETCHED + layout.BLOCKS * _STATE
#: Scratch of one thread: blocks of a chunk's entries.
INTEGERS = CHUNK
#: Derivative of ln(alpha) with respect to the logarithm of a factor on (e, f), over e^2 + f^2.
_PER_SQUARE = -2.0 * math.log(2.0)


@kernel
def sweep(counters, projections, bins, view, grid, channels, measures, scratch, composited, of_images, entry_sums):
    """Write the gradient sums over the pixels of each entry: see ``surfel_layout``. Empty ``of_images`` are 0."""
    thread = take(counters, 1, 1)
    rows = scratch.numbers[thread * NUMBERS : (thread + 1) * NUMBERS]
    state, source = rows[CHUNK * FETCHED :], (projections.records, projections.remainders, view)
    blocks = scratch.integers[thread * INTEGERS : (thread + 1) * INTEGERS]
    further = layout.ROW * bins.starts[grid.tiles]
    for place in pieces(counters, 0, grid.tiles):
        tile = bins.order[place]
        if bins.starts[tile] < bins.reached[tile]:
            _read_tile(tile, grid, view, channels, of_images, state)
            _prepare_tile(tile, channels, measures, view, composited, state)
            _sweep_tile(tile, source, bins, view, grid, channels, measures, rows, state, blocks, entry_sums)
        for entry in range(bins.reached[tile], bins.starts[tile + 1]):
            number = bins.cells[layout.CELL * entry + 2]
            vec.store(entry_sums, layout.ROW * number, 0.0)
            if len(channels) > surfel_layout.ROW_CHANNELS:
                entry_sums[further + number] = 0.0


@part
def _read_tile(tile, grid, view, channels, of_images, state):
    """Fill the states of a tile's blocks.

    The derivative with respect to depth over alpha goes to ``_BEHIND``, that with respect to the distortion to
    ``_OF_SQUARE``.
    """
    _, _, across, down = tile_corner(tile, grid)
    for block in range(layout.BLOCKS):
        at = _STATE * block
        x, y = scaled_pixels(block, view)
        vec.store(state, at + _X, x)
        vec.store(state, at + _Y, y)
        vec.store(state, at + _TRANSMITTANCE, vec.select(inside(block, across, down), 1.0, 0.0))
        for vector in range(_BEHIND, _STATE, 16):
            vec.store(state, at + vector, 0.0)
    for channel in range(3):
        _copy_from_image(of_images.rgb, 3, channel, tile, grid, _CHANNELS + 16 * channel, state)
        if len(channels) > 3:
            _copy_from_image(of_images.normals, 3, channel, tile, grid, _CHANNELS + 48 + 16 * channel, state)
    for image, vector in (
        (of_images.alpha, _ALPHA),
        (of_images.depth, _DEPTH),
        (of_images.inverse_depth, _INVERSE_DEPTH),
        (of_images.expected, _BEHIND),
        (of_images.median, _MEDIAN),
        (of_images.distortion, _OF_SQUARE),
    ):
        _copy_from_image(image, 1, 0, tile, grid, vector, state)


@part
def _prepare_tile(tile, channels, measures, view, composited, state):
    """Turn derivatives with respect to images into those with respect to sums, and initialise the running difference."""
    width = 1 + len(channels) + len(measures.depth) + len(measures.inverse_depth) + 2 * len(measures.distortion)
    background = vec.broadcast_all(view, layout.VIEW_BACKGROUND, (0, 0, 0))
    for block in range(layout.BLOCKS):
        at, source = _STATE * block, 16 * width * (layout.BLOCKS * tile + block)
        alpha, sums = vec.load(composited, source), vec.load_all(composited, source + 16, channels)
        shaded = vec.dot(vec.load_all(state, at + _CHANNELS, (0, 0, 0)), background, 0.0)
        of_alpha = vec.sub(vec.load(state, at + _ALPHA), shaded)
        behind = vec.dot(vec.load_all(state, at + _CHANNELS, channels), sums, 0.0)
        source += 16 * (1 + len(channels))
        if len(measures.depth) > 0:
            covered, depth = vec.greater(alpha, 0.0), vec.load(composited, source)
            share = vec.select(covered, vec.div(vec.load(state, at + _BEHIND), alpha), 0.0)
            of_depth = vec.add(vec.load(state, at + _DEPTH), share)
            of_alpha = vec.sub(of_alpha, vec.select(covered, vec.mul(share, vec.div(depth, alpha)), 0.0))
            vec.store(state, at + _DEPTH, of_depth)
            behind = vec.fma(of_depth, depth, behind)
            source += 16
        if len(measures.inverse_depth) > 0:
            behind = vec.fma(vec.load(state, at + _INVERSE_DEPTH), vec.load(composited, source), behind)
            source += 16
        if len(measures.distortion) > 0:
            # The distortion is alpha times the squares, and twice that is the sum of weights times its derivatives.
            squares, given = vec.load(composited, source + 16), vec.load(state, at + _OF_SQUARE)
            given = vec.mul(given, vec.broadcast(view, layout.VIEW_DISTORTION))
            of_square, of_weight = vec.mul(given, alpha), vec.mul(given, squares)
            vec.store(state, at + _MEAN, vec.load(composited, source))
            vec.store(state, at + _OF_SQUARE, of_square)
            vec.store(state, at + _OF_WEIGHT, of_weight)
            behind = vec.fma(2.0, vec.mul(of_weight, alpha), behind)
        vec.store(state, at + _ALPHA, of_alpha)
        vec.store(state, at + _BEHIND, vec.fma(of_alpha, alpha, behind))


@inline
def _sweep_entry(row, blocks, alive, rows, channels, measures, view, state, target, further, entry_sums):
    """Accumulate one entry's sums over its blocks; returns the blocks with transmittance left, one bit each."""
    zero = vec.splat(0.0)
    sum_v, sum_e, sum_f, sum_ee, sum_ef, sum_ff = zero, zero, zero, zero, zero, zero
    sum_c, sum_ce, sum_cf, sum_dx, sum_dy = zero, zero, zero, zero, zero
    sums = vec.repeat(0.0, channels)
    while blocks:
        block = vec.lowest_bit(blocks)
        blocks &= blocks - 1
        at = _STATE * block
        d_x, d_y, q, inverse_q, e, f, hit = intersect(rows, row, vec.load(state, at + _X), vec.load(state, at + _Y))
        of_disc, of_filter = vec.fma(e, e, vec.mul(f, f)), vec.fma(d_x, d_x, vec.mul(d_y, d_y))
        on_disc, squared = vec.at_most(of_disc, of_filter), vec.smaller(of_disc, of_filter)
        log2_alpha = vec.sub(vec.broadcast(rows, row + surfel_layout.LOG2_OPACITY), squared)
        free_alpha = vec.exp2(log2_alpha)
        alpha = vec.smaller(free_alpha, vec.broadcast(view, layout.VIEW_ALPHA_MAX))
        kept = vec.both(hit, vec.at_least(log2_alpha, vec.broadcast(view, layout.VIEW_LOG2_ALPHA_MIN)))
        alpha = vec.select(kept, alpha, 0.0)
        transmittance = vec.load(state, at + _TRANSMITTANCE)
        through = vec.sub(1.0, alpha)
        behind = vec.mul(transmittance, through)
        drawn = vec.at_least(behind, vec.broadcast(view, layout.VIEW_TRANSMITTANCE_MIN))
        weight = vec.select(drawn, vec.mul(alpha, transmittance), 0.0)
        vec.store(state, at + _TRANSMITTANCE, vec.select(drawn, behind, 0.0))

        given = vec.load_all(state, at + _CHANNELS, channels)
        own = vec.broadcast_all(rows, row + surfel_layout.CHANNELS, channels)
        shown = vec.dot(own, given, vec.load(state, at + _ALPHA))
        # Derivative with respect to ln(z), of the weighted sums over the weight, and of the median.
        of_log_z, of_median = zero, zero
        z = vec.mul(vec.broadcast(rows, row + surfel_layout.DEPTH), inverse_q)
        inverse_z = vec.mul(vec.broadcast(rows, row + INVERSE_DEPTH), q)
        if len(measures.depth) > 0:
            of_log_z = vec.mul(z, vec.load(state, at + _DEPTH))
            shown = vec.add(shown, of_log_z)
        if len(measures.inverse_depth) > 0:
            part = vec.mul(inverse_z, vec.load(state, at + _INVERSE_DEPTH))
            shown, of_log_z = vec.add(shown, part), vec.sub(of_log_z, part)
        if len(measures.distortion) > 0:
            difference = vec.sub(inverse_z, vec.load(state, at + _MEAN))
            slope = vec.mul(vec.load(state, at + _OF_SQUARE), difference)
            shown = vec.add(shown, vec.fma(slope, difference, vec.load(state, at + _OF_WEIGHT)))
            of_log_z = vec.fma(vec.mul(slope, -2.0), inverse_z, of_log_z)
        if len(measures.median) > 0:
            crosses = vec.both(vec.both(drawn, vec.greater(transmittance, 0.5)), vec.at_most(behind, 0.5))
            of_median = vec.select(crosses, vec.mul(z, vec.load(state, at + _MEDIAN)), 0.0)
        shown = vec.mul(weight, shown)
        hidden = vec.sub(vec.load(state, at + _BEHIND), shown)
        vec.store(state, at + _BEHIND, hidden)
        v = vec.sub(shown, vec.mul(vec.quick_div(alpha, through), hidden))
        v = vec.select(vec.both(drawn, vec.less(free_alpha, vec.broadcast(view, layout.VIEW_ALPHA_MAX))), v, 0.0)
        of_e = vec.select(on_disc, v, 0.0)
        by_filter = vec.sub(v, of_e)
        c = vec.fma(vec.mul(of_e, _PER_SQUARE), squared, vec.fma(weight, of_log_z, of_median))
        v_e, v_f = vec.mul(of_e, e), vec.mul(of_e, f)
        sum_v, sum_e, sum_f = vec.add(sum_v, v), vec.add(sum_e, v_e), vec.add(sum_f, v_f)
        sum_ee, sum_ef, sum_ff = vec.fma(v_e, e, sum_ee), vec.fma(v_e, f, sum_ef), vec.fma(v_f, f, sum_ff)
        sum_c, sum_ce, sum_cf = vec.add(sum_c, c), vec.fma(c, e, sum_ce), vec.fma(c, f, sum_cf)
        sum_dx, sum_dy = vec.fma(by_filter, d_x, sum_dx), vec.fma(by_filter, d_y, sum_dy)
        sums = vec.fma(weight, given, sums)
        if not vec.bits(drawn):
            alive &= ~(1 << block)
    vec.store_lane_sums(
        entry_sums, target, further,
        (sum_v, sum_e, sum_f, sum_ee, sum_ef, sum_ff, sum_c, sum_ce, sum_cf, sum_dx, sum_dy) + sums,
    )  # fmt: skip
    return alive


_sweep_tile = tile_sweep_backward(fetch_surfels, _sweep_entry, FETCHED)
_, _copy_from_image = image_copies(_STATE)
