"""Backward pass of compositing, tile by tile, front to back.

With g the derivative of the loss with respect to a pixel's composited channels, what a Gaussian of weight w and
channels c shows is w (g . c). A running difference, first the whole pixel's (g . composited), tells what everything
behind it still shows; see ``docs/rendering.md``, section "Derivatives". Nothing is kept from the forward sweep but what
it composited. Of surfels, where the disc decides alpha, the sums are the derivatives with respect to the intersection
of ray and disc.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from coliags_plugin.core.numba_kernels import lanes as vec
from coliags_plugin.core.numba_kernels.compilation import inline, kernel, part
from coliags_plugin.core.numba_kernels.threads import pieces
from coliags_plugin.renderers.numba_kernels import layout, tiles

# Of a block: what is still to be shown, in the place of the derivative with respect to depth over alpha; the mean of 1/z,
# and what squared differences to it, in the place of the derivative with respect to the distortion, and all weights are
# multiplied by; and x and y of its pixels.
_BEHIND = tiles.EXPECTED
_OF_SQUARE = tiles.DISTORTION
_MEAN = tiles.FURTHER
_OF_WEIGHT = tiles.FURTHER + 16
_X = tiles.FURTHER + 32
_Y = tiles.FURTHER + 48

#: Derivative of ln(alpha) with respect to the logarithm of a factor on (e, f), over e^2 + f^2.
_PER_SQUARE = -2.0 * math.log(2.0)

_composited_vectors = inline(tiles.composited_vectors)


def sweeping_backward(
    fetch: Callable[..., None],
    pixels: Callable[..., tuple],
    prepare_block: Callable[..., None],
    sweep_entry: Callable[..., int],
    row: int,
) -> Callable[..., None]:
    """Compile the kernel that writes the sums over the pixels of each entry (``layout``), of those that were reached.

    Empty ``of_images`` are 0; ``seventeen`` says whether there is a seventeenth sum.

    ``fetch`` and ``row`` are as of ``sweep_forward.sweeping``, ``pixels`` gives x and y of a block's pixels.
    ``prepare_block`` turns derivatives with respect to images into those with respect to sums, and initialises the running
    difference. ``sweep_entry`` accumulates one entry's sums over its blocks and returns the blocks with transmittance left.
    """

    @kernel
    def sweep(counters, projections, bins, view, grid, outputs, scratch, composited, of_images, seventeen, entry_sums):
        rows, state, blocks = tiles.of_thread(counters, scratch)
        further = layout.ROW * bins.starts[grid.tiles]
        size = 16 * _composited_vectors(outputs)
        for place in pieces(counters, 0, grid.tiles):
            tile = bins.order[place]
            if bins.starts[tile] < bins.reached[tile]:
                _, _, across, down = tiles.tile_corner(tile, grid)
                for block in range(layout.BLOCKS):
                    at = tiles.STATE * block
                    x, y = pixels(block, view)
                    for vector in range(tiles.ALPHA, tiles.STATE, 16):
                        vec.store(state, at + vector, 0.0)
                    vec.store(state, at + tiles.TRANSMITTANCE, vec.select(tiles.inside(block, across, down), 1.0, 0.0))
                    vec.store(state, at + _X, x)
                    vec.store(state, at + _Y, y)
                tiles.copy_pixels(tile, grid, state, of_images, False)
                for block in range(layout.BLOCKS):
                    source = size * (layout.BLOCKS * tile + block)
                    prepare_block(tiles.STATE * block, source, outputs, view, composited, state)
                sweep_tile(tile, projections, bins, view, grid, outputs, rows, state, blocks, further, entry_sums)
            for entry in range(bins.reached[tile], bins.starts[tile + 1]):
                number = bins.cells[layout.CELL * entry + 2]
                vec.store(entry_sums, layout.ROW * number, 0.0)
                if seventeen:
                    entry_sums[further + number] = 0.0

    @part
    def sweep_tile(tile, projections, bins, view, grid, outputs, rows, state, blocks, further, entry_sums):
        corner_x, corner_y, across, down = tiles.tile_corner(tile, grid)
        cells, alive = bins.cells, 0
        for block in range(layout.BLOCKS):
            if vec.bits(tiles.inside(block, across, down)):
                alive |= 1 << block
        first, last = bins.starts[tile], bins.reached[tile]
        while first < last:
            end = min(first + tiles.CHUNK, last)
            fetch(first, end, alive, corner_x, corner_y, projections, view, cells, rows, blocks)
            for entry in range(first, end):
                ahead = cells[layout.CELL * min(entry + tiles.SUMS_AHEAD, last - 1) + 2]
                vec.prefetch(entry_sums, layout.ROW * ahead)
                fetched, mine = row * (entry - first), blocks[entry - first] & alive
                number = cells[layout.CELL * entry + 2]
                target, beyond = layout.ROW * number, further + number
                alive = sweep_entry(fetched, mine, alive, rows, outputs, view, state, target, beyond, entry_sums)
            first = end

    return sweep


@inline
def _prepare_alpha(at, alpha, depth, view, state):
    """Derivative with respect to alpha, from background and depth over alpha; that with respect to depth is updated."""
    background, covered = vec.broadcast_all(view, layout.VIEW_BACKGROUND, (0, 0, 0)), vec.greater(alpha, 0.0)
    shaded = vec.dot(vec.load_all(state, at + tiles.CHANNELS, (0, 0, 0)), background, 0.0)
    share = vec.select(covered, vec.div(vec.load(state, at + tiles.EXPECTED), alpha), 0.0)
    vec.store(state, at + tiles.DEPTH, vec.add(vec.load(state, at + tiles.DEPTH), share))
    of_alpha = vec.sub(vec.load(state, at + tiles.ALPHA), shaded)
    of_alpha = vec.sub(of_alpha, vec.select(covered, vec.mul(share, vec.div(depth, alpha)), 0.0))
    vec.store(state, at + tiles.ALPHA, of_alpha)
    return of_alpha


# --- 3D Gaussians -----------------------------------------------------------------------------------------------------


@part
def _prepare_gaussians(at, source, outputs, view, composited, state):
    """Prepare a block: see :func:`sweeping_backward`."""
    alpha, sums = vec.load(composited, source), vec.load_all(composited, source + 16, outputs.channels)
    depth = vec.load(composited, source + 64) if len(outputs.channels) > 3 else vec.splat(0.0)
    of_alpha = _prepare_alpha(at, alpha, depth, view, state)
    of_channels = vec.load_all(state, at + tiles.CHANNELS, outputs.channels)
    vec.store(state, at + _BEHIND, vec.dot(of_channels, sums, vec.mul(of_alpha, alpha)))


@inline
def _sweep_gaussian(row, blocks, alive, rows, outputs, view, state, target, further, entry_sums):
    """Accumulate the sums of a 3D Gaussian: see :func:`sweeping_backward`.

    Broadcasting the row's numbers again for each block costs nothing, for the processor does it as it reads them; kept
    in registers they would crowd out the sums.
    """
    zero = vec.splat(0.0)
    sum_v, sum_e, sum_f, sum_ee, sum_ef, sum_ff = zero, zero, zero, zero, zero, zero
    sums = vec.repeat(0.0, outputs.channels)
    while blocks:
        block = vec.lowest_bit(blocks)
        blocks &= blocks - 1
        at = tiles.STATE * block
        x, y = vec.load(state, at + _X), vec.load(state, at + _Y)
        e = vec.fma(vec.broadcast(rows, row + layout.U_XX), x, vec.broadcast(rows, row + tiles.OFFSET_E))
        f = vec.fma(vec.broadcast(rows, row + layout.U_YY), y, vec.broadcast(rows, row + tiles.OFFSET_F))
        f = vec.fma(vec.broadcast(rows, row + layout.U_YX), x, f)
        log2_alpha = vec.fma(vec.neg(e), e, vec.fma(vec.neg(f), f, vec.broadcast(rows, row + layout.LOG2_OPACITY)))
        free_alpha = vec.exp2(log2_alpha)
        alpha = vec.smaller(free_alpha, vec.broadcast(view, layout.VIEW_ALPHA_MAX))
        alpha = vec.select(vec.at_least(log2_alpha, vec.broadcast(view, layout.VIEW_LOG2_ALPHA_MIN)), alpha, 0.0)
        drawn, _, _, weight = _blend(at, alpha, view, state)
        of_channels = vec.load_all(state, at + tiles.CHANNELS, outputs.channels)
        colors = vec.broadcast_all(rows, row + layout.CHANNELS, outputs.channels)
        shown = vec.mul(weight, vec.dot(colors, of_channels, vec.load(state, at + tiles.ALPHA)))
        v = _of_log_alpha(at, shown, alpha, free_alpha, drawn, view, state)
        v_e, v_f = vec.mul(v, e), vec.mul(v, f)
        sum_v, sum_e, sum_f = vec.add(sum_v, v), vec.add(sum_e, v_e), vec.add(sum_f, v_f)
        sum_ee, sum_ef, sum_ff = vec.fma(v_e, e, sum_ee), vec.fma(v_e, f, sum_ef), vec.fma(v_f, f, sum_ff)
        sums = vec.fma(weight, of_channels, sums)
        if not vec.bits(drawn):
            alive &= ~(1 << block)
    vec.store(entry_sums, target, vec.lane_sums((sum_v, sum_e, sum_f, sum_ee, sum_ef, sum_ff) + sums))
    return alive


@inline
def _blend(at, alpha, view, state):
    """Mask of the pixels that are drawn, transmittance in front and behind, and weights; the state's is updated."""
    transmittance = vec.load(state, at + tiles.TRANSMITTANCE)
    behind = vec.mul(transmittance, vec.sub(1.0, alpha))
    drawn = vec.at_least(behind, vec.broadcast(view, layout.VIEW_TRANSMITTANCE_MIN))
    vec.store(state, at + tiles.TRANSMITTANCE, vec.select(drawn, behind, 0.0))
    return drawn, transmittance, behind, vec.select(drawn, vec.mul(alpha, transmittance), 0.0)


@inline
def _of_log_alpha(at, shown, alpha, free_alpha, drawn, view, state):
    """Derivative with respect to ln(alpha), from what an entry shows; the running difference is updated."""
    hidden = vec.sub(vec.load(state, at + _BEHIND), shown)
    vec.store(state, at + _BEHIND, hidden)
    v = vec.sub(shown, vec.mul(vec.quick_div(alpha, vec.sub(1.0, alpha)), hidden))
    return vec.select(vec.both(drawn, vec.less(free_alpha, vec.broadcast(view, layout.VIEW_ALPHA_MAX))), v, 0.0)


# --- surfels ----------------------------------------------------------------------------------------------------------


@part
def _prepare_surfels(at, source, outputs, view, composited, state):
    """Prepare a block: see :func:`sweeping_backward`."""
    alpha, colors = vec.load(composited, source), vec.load_all(composited, source + 16, outputs.channels)
    source += 16 * (1 + len(outputs.channels))
    normals = vec.load_all(composited, source, outputs.normals)
    source += 16 * len(outputs.normals)
    of_channels = vec.load_all(state, at + tiles.CHANNELS, outputs.channels) + vec.load_all(
        state, at + tiles.NORMALS, outputs.normals
    )
    behind = vec.dot(of_channels, colors + normals, 0.0)
    depth = vec.load(composited, source) if len(outputs.depth) > 0 else vec.splat(0.0)
    of_alpha = _prepare_alpha(at, alpha, depth, view, state)
    if len(outputs.depth) > 0:
        behind = vec.fma(vec.load(state, at + tiles.DEPTH), depth, behind)
        source += 16
    if len(outputs.inverse_depth) > 0:
        behind = vec.fma(vec.load(state, at + tiles.INVERSE), vec.load(composited, source), behind)
        source += 16
    if len(outputs.distortion) > 0:
        # The distortion is alpha times the squares, and twice that is the sum of weights times its derivatives.
        squares, of_distortion = vec.load(composited, source + 16), vec.load(state, at + tiles.DISTORTION)
        of_distortion = vec.mul(of_distortion, vec.broadcast(view, layout.VIEW_DISTORTION))
        of_square, of_weight = vec.mul(of_distortion, alpha), vec.mul(of_distortion, squares)
        vec.store(state, at + _MEAN, vec.load(composited, source))
        vec.store(state, at + _OF_SQUARE, of_square)
        vec.store(state, at + _OF_WEIGHT, of_weight)
        behind = vec.fma(2.0, vec.mul(of_weight, alpha), behind)
    vec.store(state, at + _BEHIND, vec.fma(of_alpha, alpha, behind))


@inline
def _sweep_surfel(row, blocks, alive, rows, outputs, view, state, target, further, entry_sums):
    """Accumulate the sums of a surfel: see :func:`sweeping_backward`."""
    zero = vec.splat(0.0)
    sum_v, sum_e, sum_f, sum_ee, sum_ef, sum_ff = zero, zero, zero, zero, zero, zero
    sum_c, sum_ce, sum_cf, sum_dx, sum_dy = zero, zero, zero, zero, zero
    sums = vec.repeat(0.0, outputs.channels) + vec.repeat(0.0, outputs.normals)
    while blocks:
        block = vec.lowest_bit(blocks)
        blocks &= blocks - 1
        at = tiles.STATE * block
        d_x, d_y, q, inverse_q, e, f, hit = tiles.intersect(
            rows, row, vec.load(state, at + _X), vec.load(state, at + _Y)
        )
        of_disc, of_filter = vec.fma(e, e, vec.mul(f, f)), vec.fma(d_x, d_x, vec.mul(d_y, d_y))
        on_disc, squared = vec.at_most(of_disc, of_filter), vec.smaller(of_disc, of_filter)
        log2_alpha = vec.sub(vec.broadcast(rows, row + layout.SURFEL_LOG2_OPACITY), squared)
        free_alpha = vec.exp2(log2_alpha)
        alpha = vec.smaller(free_alpha, vec.broadcast(view, layout.VIEW_ALPHA_MAX))
        counts = vec.both(hit, vec.at_least(log2_alpha, vec.broadcast(view, layout.VIEW_LOG2_ALPHA_MIN)))
        alpha = vec.select(counts, alpha, 0.0)
        drawn, transmittance, behind, weight = _blend(at, alpha, view, state)
        of_channels = vec.load_all(state, at + tiles.CHANNELS, outputs.channels)
        of_channels = of_channels + vec.load_all(state, at + tiles.NORMALS, outputs.normals)
        colors = vec.broadcast_all(rows, row + layout.SURFEL_CHANNELS, outputs.channels)
        colors = colors + vec.broadcast_all(rows, row + layout.SURFEL_CHANNELS + 3, outputs.normals)
        shown = vec.dot(colors, of_channels, vec.load(state, at + tiles.ALPHA))
        # Derivative with respect to ln(z), of the weighted sums over the weight, and of the median.
        of_log_z, of_median = zero, zero
        z = vec.mul(vec.broadcast(rows, row + layout.SURFEL_DEPTH), inverse_q)
        inverse_z = vec.mul(vec.broadcast(rows, row + tiles.INVERSE_DEPTH), q)
        if len(outputs.depth) > 0:
            of_log_z = vec.mul(z, vec.load(state, at + tiles.DEPTH))
            shown = vec.add(shown, of_log_z)
        if len(outputs.inverse_depth) > 0:
            part_of_z = vec.mul(inverse_z, vec.load(state, at + tiles.INVERSE))
            shown, of_log_z = vec.add(shown, part_of_z), vec.sub(of_log_z, part_of_z)
        if len(outputs.distortion) > 0:
            difference = vec.sub(inverse_z, vec.load(state, at + _MEAN))
            slope = vec.mul(vec.load(state, at + _OF_SQUARE), difference)
            shown = vec.add(shown, vec.fma(slope, difference, vec.load(state, at + _OF_WEIGHT)))
            of_log_z = vec.fma(vec.mul(slope, -2.0), inverse_z, of_log_z)
        if len(outputs.median) > 0:
            crosses = vec.both(vec.both(drawn, vec.greater(transmittance, 0.5)), vec.at_most(behind, 0.5))
            of_median = vec.select(crosses, vec.mul(z, vec.load(state, at + tiles.MEDIAN)), 0.0)
        v = _of_log_alpha(at, vec.mul(weight, shown), alpha, free_alpha, drawn, view, state)
        of_e = vec.select(on_disc, v, 0.0)
        by_filter = vec.sub(v, of_e)
        c = vec.fma(vec.mul(of_e, _PER_SQUARE), squared, vec.fma(weight, of_log_z, of_median))
        v_e, v_f = vec.mul(of_e, e), vec.mul(of_e, f)
        sum_v, sum_e, sum_f = vec.add(sum_v, v), vec.add(sum_e, v_e), vec.add(sum_f, v_f)
        sum_ee, sum_ef, sum_ff = vec.fma(v_e, e, sum_ee), vec.fma(v_e, f, sum_ef), vec.fma(v_f, f, sum_ff)
        sum_c, sum_ce, sum_cf = vec.add(sum_c, c), vec.fma(c, e, sum_ce), vec.fma(c, f, sum_cf)
        sum_dx, sum_dy = vec.fma(by_filter, d_x, sum_dx), vec.fma(by_filter, d_y, sum_dy)
        sums = vec.fma(weight, of_channels, sums)
        if not vec.bits(drawn):
            alive &= ~(1 << block)
    vec.store_lane_sums(
        entry_sums, target, further,
        (sum_v, sum_e, sum_f, sum_ee, sum_ef, sum_ff, sum_c, sum_ce, sum_cf, sum_dx, sum_dy) + sums,
    )  # fmt: skip
    return alive


sweep = sweeping_backward(tiles.fetch_gaussians, tiles.block_pixels, _prepare_gaussians, _sweep_gaussian, layout.ROW)
sweep_surfels = sweeping_backward(
    tiles.fetch_surfels, tiles.scaled_pixels, _prepare_surfels, _sweep_surfel, tiles.FETCHED_SURFEL
)
