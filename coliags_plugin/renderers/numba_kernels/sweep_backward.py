"""Backward pass of compositing, tile by tile, front to back.

With g the derivative of the loss with respect to a pixel's composited channels, what a Gaussian of weight w and
channels c shows is w (g . c). A running difference, first the whole pixel's (g . composited), tells what everything
behind it still shows; see ``docs/rendering.md``, section "Derivatives". Nothing is kept from the forward sweep but what
it composited.
"""

from __future__ import annotations

from coliags_plugin.core.numba_compilation import inline, kernel, part
from coliags_plugin.renderers.numba_kernels import layout
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
    copy_from_image,
    fetch_chunk,
    inside,
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
NUMBERS = CHUNK * layout.ROW + layout.BLOCKS * _STATE
#: Scratch of one thread: blocks of a chunk's entries.
INTEGERS = CHUNK
#: Prefetch distance of the memory of the sums, entries.
_AHEAD = 12


@kernel
def sweep_backward(
    counters, projections, bins, view, grid, extras, channels, scratch, composited, of_images, entry_sums
):
    """Compute the gradient sums over the pixels of each entry.

    Args:
        counters: Work counters for dynamic scheduling; entries 0 and 1 must be 0.
        projections, bins, composited: As the forward sweep left them.
        view: See ``layout``.
        grid: The image and its tiles.
        extras: What was composited besides colour.
        channels: Any tuple as long as there are channels.
        scratch: NUMBERS and INTEGERS for each thread.
        of_images: Derivatives with respect to the images; empty where 0.
        entry_sums: Out: see ``layout``. [16 for each entry, counted by Gaussian]
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
        if bins.starts[tile] < bins.reached[tile]:
            _read_tile(tile, grid, extras, channels, of_images, state)
            _prepare_tile(tile, channels, view, extras.depth, composited, state)
            _sweep_tile(tile, projections, bins, view, grid, channels, rows, state, blocks, entry_sums)
        for entry in range(bins.reached[tile], bins.starts[tile + 1]):
            store(entry_sums, layout.ROW * bins.cells[layout.CELL * entry + 2], 0.0)


@part
def _read_tile(tile, grid, extras, channels, of_images, state):
    """Fill the states of a tile's blocks; the derivative with respect to depth over alpha goes to ``_BEHIND``."""
    _, _, across, down = tile_corner(tile, grid)
    half = 0.5 * layout.TILE - 0.5
    for block in range(layout.BLOCKS):
        at = _STATE * block
        block_x, block_y = block_corner(block)
        store(state, at + _X, add(lane_columns(), block_x - half))
        store(state, at + _Y, add(lane_rows(), block_y - half))
        store(state, at + _TRANSMITTANCE, select(inside(block, across, down), 1.0, 0.0))
        store(state, at + _BEHIND, 0.0)
        store(state, at + _ALPHA, 0.0)
        store_all(state, at + _CHANNELS, repeat(0.0, channels))
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
def _copy_from_image(image, depth, channel, tile, grid, vector, state):
    copy_from_image(image, depth, channel, tile, grid, vector, state, _STATE)


@part
def _prepare_tile(tile, channels, view, has_depth, composited, state):
    """Turn derivatives with respect to images into those with respect to sums, and initialise the running difference."""
    size = 16 * (1 + len(channels))
    background = broadcast_all(view, layout.VIEW_BACKGROUND, (0, 0, 0))
    for block in range(layout.BLOCKS):
        at, source = _STATE * block, size * (layout.BLOCKS * tile + block)
        alpha, sums = load(composited, source), load_all(composited, source + 16, channels)
        of_alpha = sub(load(state, at + _ALPHA), dot(load_all(state, at + _CHANNELS, (0, 0, 0)), background, 0.0))
        if has_depth:
            covered = greater(alpha, 0.0)
            share = select(covered, div(load(state, at + _BEHIND), alpha), 0.0)
            store(state, at + _CHANNELS + 48, add(load(state, at + _CHANNELS + 48), share))
            depth = load(composited, source + 64)
            of_alpha = sub(of_alpha, select(covered, mul(share, div(depth, alpha)), 0.0))
        store(state, at + _ALPHA, of_alpha)
        store(state, at + _BEHIND, dot(load_all(state, at + _CHANNELS, channels), sums, mul(of_alpha, alpha)))


@part
def _sweep_tile(tile, projections, bins, view, grid, channels, rows, state, blocks, entry_sums):
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
        fetch_chunk(first, end, alive, corner_x, corner_y, projections, cells, rows, blocks)
        for entry in range(first, end):
            ahead = cells[layout.CELL * min(entry + _AHEAD, last - 1) + 2]
            prefetch_to_write(entry_sums, layout.ROW * ahead)
            row, mine = layout.ROW * (entry - first), blocks[entry - first] & alive
            target = layout.ROW * cells[layout.CELL * entry + 2]
            alive = _sweep_entry(row, mine, alive, rows, channels, view, state, target, entry_sums)
        first = end


@inline
def _sweep_entry(row, blocks, alive, rows, channels, view, state, target, entry_sums):
    """Accumulate one entry's sums over its blocks.

    Broadcasting the row's numbers again for each block costs nothing, for the processor does it as it reads them; kept
    in registers they would crowd out the sums.

    Returns:
        Mask of the blocks with transmittance left.
    """
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
        alpha = smaller(free_alpha, broadcast(view, layout.VIEW_ALPHA_MAX))
        alpha = select(at_least(log2_alpha, broadcast(view, layout.VIEW_LOG2_ALPHA_MIN)), alpha, 0.0)
        transmittance = load(state, at + _TRANSMITTANCE)
        through = sub(1.0, alpha)
        behind = mul(transmittance, through)
        drawn = at_least(behind, broadcast(view, layout.VIEW_TRANSMITTANCE_MIN))
        weight = select(drawn, mul(alpha, transmittance), 0.0)
        store(state, at + _TRANSMITTANCE, select(drawn, behind, 0.0))

        given = load_all(state, at + _CHANNELS, channels)
        own = broadcast_all(rows, row + layout.CHANNELS, channels)
        shown = mul(weight, dot(own, given, load(state, at + _ALPHA)))
        hidden = sub(load(state, at + _BEHIND), shown)
        store(state, at + _BEHIND, hidden)
        v = sub(shown, mul(quick_div(alpha, through), hidden))
        v = select(both(drawn, less(free_alpha, broadcast(view, layout.VIEW_ALPHA_MAX))), v, 0.0)
        v_e, v_f = mul(v, e), mul(v, f)
        sum_v, sum_e, sum_f = add(sum_v, v), add(sum_e, v_e), add(sum_f, v_f)
        sum_ee, sum_ef, sum_ff = fma(v_e, e, sum_ee), fma(v_e, f, sum_ef), fma(v_f, f, sum_ff)
        sums = fma(weight, given, sums)
        if not bits(drawn):
            alive &= ~(1 << block)
    store(entry_sums, target, lane_sums((sum_v, sum_e, sum_f, sum_ee, sum_ef, sum_ff) + sums))
    return alive
