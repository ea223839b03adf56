"""Backward pass of compositing for surfels, tile by tile, front to back.

As ``sweep_backward``: a running difference tells what everything behind a surfel still shows. The sums are those of
``surfel_layout``: where the disc counts, the derivatives with respect to the intersection of ray and disc.
"""

from __future__ import annotations

import math

from coliags_plugin.core.numba_compilation import inline, kernel, part
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
    dot,
    exp2,
    fma,
    greater,
    less,
    load,
    load_all,
    lowest_bit,
    mul,
    prefetch_to_write,
    quick_div,
    repeat,
    select,
    smaller,
    splat,
    store,
    store_lane_sums,
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
from coliags_plugin.renderers.numba_kernels.tiles import CHUNK, copy_from_image, inside, tile_corner

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
#: Prefetch distance of the memory of the sums, entries.
_AHEAD = 12
#: Of a multiple of (e, f): derivative of ln(alpha) with respect to the logarithm of the factor, over e^2 + f^2.
_PER_SQUARE = -2.0 * math.log(2.0)


@kernel
def sweep_surfels_backward(
    counters, records, remainders, bins, view, grid, channels, measures, scratch, composited, of_images, entry_sums
):
    """Compute the gradient sums over the pixels of each entry.

    Args:
        counters: Work counters for dynamic scheduling; entries 0 and 1 must be 0.
        records, remainders, bins, composited: As the forward sweep left them.
        view: See ``layout``.
        grid: The image and its tiles.
        channels: Any tuple as long as there are channels.
        measures: What was composited besides. [surfel_layout.Measures]
        scratch: NUMBERS and INTEGERS for each thread.
        of_images: Derivatives with respect to the images; empty where 0.
        entry_sums: Out: see ``surfel_layout``. [16 for each entry, counted by surfel, and 1 for each if there are six
            channels]
    """
    thread = take(counters, 1, 1)
    rows = scratch.numbers[thread * NUMBERS : (thread + 1) * NUMBERS]
    state = rows[CHUNK * FETCHED :]
    blocks = scratch.integers[thread * INTEGERS : (thread + 1) * INTEGERS]
    further = layout.ROW * bins.starts[grid.tiles]
    while True:
        place = take(counters, 0, 1)
        if place >= grid.tiles:
            break
        tile = bins.order[place]
        if bins.starts[tile] < bins.reached[tile]:
            _read_tile(tile, grid, view, channels, of_images, state)
            _prepare_tile(tile, channels, measures, view, composited, state)
            _sweep_tile(
                tile, records, remainders, bins, view, grid, channels, measures, rows, state, blocks, further,
                entry_sums,
            )  # fmt: skip
        for entry in range(bins.reached[tile], bins.starts[tile + 1]):
            number = bins.cells[layout.CELL * entry + 2]
            store(entry_sums, layout.ROW * number, 0.0)
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
        store(state, at + _X, x)
        store(state, at + _Y, y)
        store(state, at + _TRANSMITTANCE, select(inside(block, across, down), 1.0, 0.0))
        for vector in range(_BEHIND, _STATE, 16):
            store(state, at + vector, 0.0)
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
def _copy_from_image(image, depth, channel, tile, grid, vector, state):
    copy_from_image(image, depth, channel, tile, grid, vector, state, _STATE)


@part
def _prepare_tile(tile, channels, measures, view, composited, state):
    """Turn derivatives with respect to images into those with respect to sums, and initialise the running difference."""
    width = 1 + len(channels) + len(measures.depth) + len(measures.inverse_depth) + 2 * len(measures.distortion)
    background = broadcast_all(view, layout.VIEW_BACKGROUND, (0, 0, 0))
    for block in range(layout.BLOCKS):
        at, source = _STATE * block, 16 * width * (layout.BLOCKS * tile + block)
        alpha, sums = load(composited, source), load_all(composited, source + 16, channels)
        of_alpha = sub(load(state, at + _ALPHA), dot(load_all(state, at + _CHANNELS, (0, 0, 0)), background, 0.0))
        behind = dot(load_all(state, at + _CHANNELS, channels), sums, 0.0)
        source += 16 * (1 + len(channels))
        if len(measures.depth) > 0:
            covered, depth = greater(alpha, 0.0), load(composited, source)
            share = select(covered, div(load(state, at + _BEHIND), alpha), 0.0)
            of_depth = add(load(state, at + _DEPTH), share)
            of_alpha = sub(of_alpha, select(covered, mul(share, div(depth, alpha)), 0.0))
            store(state, at + _DEPTH, of_depth)
            behind = fma(of_depth, depth, behind)
            source += 16
        if len(measures.inverse_depth) > 0:
            behind = fma(load(state, at + _INVERSE_DEPTH), load(composited, source), behind)
            source += 16
        if len(measures.distortion) > 0:
            # The distortion is alpha times the squares, and twice that is the sum of weights times its derivatives.
            squares, given = load(composited, source + 16), load(state, at + _OF_SQUARE)
            given = mul(given, broadcast(view, layout.VIEW_DISTORTION))
            of_square, of_weight = mul(given, alpha), mul(given, squares)
            store(state, at + _MEAN, load(composited, source))
            store(state, at + _OF_SQUARE, of_square)
            store(state, at + _OF_WEIGHT, of_weight)
            behind = fma(2.0, mul(of_weight, alpha), behind)
        store(state, at + _ALPHA, of_alpha)
        store(state, at + _BEHIND, fma(of_alpha, alpha, behind))


@part
def _sweep_tile(
    tile, records, remainders, bins, view, grid, channels, measures, rows, state, blocks, further, entry_sums
):
    """Sweep through those of one tile's entries that were reached."""
    corner_x, corner_y, across, down = tile_corner(tile, grid)
    cells = bins.cells
    alive = 0
    for block in range(layout.BLOCKS):
        if bits(inside(block, across, down)):
            alive |= 1 << block
    first, last = bins.starts[tile], bins.reached[tile]
    while first < last:
        end = min(first + CHUNK, last)
        fetch_surfels(first, end, alive, corner_x, corner_y, (records, remainders, view), cells, rows, blocks)
        for entry in range(first, end):
            ahead = cells[layout.CELL * min(entry + _AHEAD, last - 1) + 2]
            prefetch_to_write(entry_sums, layout.ROW * ahead)
            row, mine = FETCHED * (entry - first), blocks[entry - first] & alive
            number = cells[layout.CELL * entry + 2]
            target, beyond = layout.ROW * number, further + number
            alive = _sweep_entry(row, mine, alive, rows, channels, measures, view, state, target, beyond, entry_sums)
        first = end


@inline
def _sweep_entry(row, blocks, alive, rows, channels, measures, view, state, target, further, entry_sums):
    """Accumulate one entry's sums over its blocks.

    Returns:
        Mask of the blocks with transmittance left.
    """
    zero = splat(0.0)
    sum_v, sum_e, sum_f, sum_ee, sum_ef, sum_ff = zero, zero, zero, zero, zero, zero
    sum_c, sum_ce, sum_cf, sum_dx, sum_dy = zero, zero, zero, zero, zero
    sums = repeat(0.0, channels)
    while blocks:
        block = lowest_bit(blocks)
        blocks &= blocks - 1
        at = _STATE * block
        d_x, d_y, q, inverse_q, e, f, hit = intersect(rows, row, load(state, at + _X), load(state, at + _Y))
        of_disc, of_filter = fma(e, e, mul(f, f)), fma(d_x, d_x, mul(d_y, d_y))
        on_disc, squared = at_most(of_disc, of_filter), smaller(of_disc, of_filter)
        log2_alpha = sub(broadcast(rows, row + surfel_layout.LOG2_OPACITY), squared)
        free_alpha = exp2(log2_alpha)
        alpha = smaller(free_alpha, broadcast(view, layout.VIEW_ALPHA_MAX))
        kept = both(hit, at_least(log2_alpha, broadcast(view, layout.VIEW_LOG2_ALPHA_MIN)))
        alpha = select(kept, alpha, 0.0)
        transmittance = load(state, at + _TRANSMITTANCE)
        through = sub(1.0, alpha)
        behind = mul(transmittance, through)
        drawn = at_least(behind, broadcast(view, layout.VIEW_TRANSMITTANCE_MIN))
        weight = select(drawn, mul(alpha, transmittance), 0.0)
        store(state, at + _TRANSMITTANCE, select(drawn, behind, 0.0))

        given = load_all(state, at + _CHANNELS, channels)
        own = broadcast_all(rows, row + surfel_layout.CHANNELS, channels)
        shown = dot(own, given, load(state, at + _ALPHA))
        # Derivative with respect to ln(z), of the weighted sums over the weight, and of the median.
        of_log_z, of_median = zero, zero
        if len(measures.depth) > 0:
            of_log_z = mul(mul(broadcast(rows, row + surfel_layout.DEPTH), inverse_q), load(state, at + _DEPTH))
            shown = add(shown, of_log_z)
        if len(measures.inverse_depth) > 0:
            part = mul(mul(broadcast(rows, row + INVERSE_DEPTH), q), load(state, at + _INVERSE_DEPTH))
            shown, of_log_z = add(shown, part), sub(of_log_z, part)
        if len(measures.distortion) > 0:
            inverse_z = mul(broadcast(rows, row + INVERSE_DEPTH), q)
            difference = sub(inverse_z, load(state, at + _MEAN))
            slope = mul(load(state, at + _OF_SQUARE), difference)
            shown = add(shown, fma(slope, difference, load(state, at + _OF_WEIGHT)))
            of_log_z = fma(mul(slope, -2.0), inverse_z, of_log_z)
        if len(measures.median) > 0:
            crosses = both(both(drawn, greater(transmittance, 0.5)), at_most(behind, 0.5))
            of_median = mul(mul(broadcast(rows, row + surfel_layout.DEPTH), inverse_q), load(state, at + _MEDIAN))
            of_median = select(crosses, of_median, 0.0)
        shown = mul(weight, shown)
        hidden = sub(load(state, at + _BEHIND), shown)
        store(state, at + _BEHIND, hidden)
        v = sub(shown, mul(quick_div(alpha, through), hidden))
        v = select(both(drawn, less(free_alpha, broadcast(view, layout.VIEW_ALPHA_MAX))), v, 0.0)
        of_e = select(on_disc, v, 0.0)
        by_filter = sub(v, of_e)
        c = fma(mul(of_e, _PER_SQUARE), squared, fma(weight, of_log_z, of_median))
        v_e, v_f = mul(of_e, e), mul(of_e, f)
        sum_v, sum_e, sum_f = add(sum_v, v), add(sum_e, v_e), add(sum_f, v_f)
        sum_ee, sum_ef, sum_ff = fma(v_e, e, sum_ee), fma(v_e, f, sum_ef), fma(v_f, f, sum_ff)
        sum_c, sum_ce, sum_cf = add(sum_c, c), fma(c, e, sum_ce), fma(c, f, sum_cf)
        sum_dx, sum_dy = fma(by_filter, d_x, sum_dx), fma(by_filter, d_y, sum_dy)
        sums = fma(weight, given, sums)
        if not bits(drawn):
            alive &= ~(1 << block)
    store_lane_sums(
        entry_sums, target, further,
        (sum_v, sum_e, sum_f, sum_ee, sum_ef, sum_ff, sum_c, sum_ce, sum_cf, sum_dx, sum_dy) + sums,
    )  # fmt: skip
    return alive
