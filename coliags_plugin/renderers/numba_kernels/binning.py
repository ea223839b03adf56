"""Records -> which blocks of which tiles each Gaussian touches, by tile and front to back.

Tiles and blocks only save work: what is listed here is a superset of the pairs of pixel and Gaussian with
alpha >= alpha_min, and the sweeps decide about each of those again.
"""

from __future__ import annotations

import numba

from coliags_plugin.renderers.numba_kernels import layout
from coliags_plugin.renderers.numba_kernels.compilation import kernel, part
from coliags_plugin.renderers.numba_kernels.geometry import squared_distance_to_box
from coliags_plugin.renderers.numba_kernels.lanes import (
    add,
    at_most,
    bits,
    broadcast,
    fma,
    lane_columns,
    lane_rows,
    splat,
    sub,
)
from coliags_plugin.renderers.numba_kernels.sorting import (
    DIGIT_BITS,
    collect_parcel,
    count_digits,
    move_by_digit,
    turn_counts_into_places,
)
from coliags_plugin.renderers.numba_kernels.threads import take


@kernel
def bin_gaussians(
    workers,
    stretches,
    counters,
    records,
    depth_bits,
    bounds,
    drawn,
    parcels,
    log2_alpha_min,
    columns,
    tiles,
    keys,
    moved,
    ranges,
    digits,
    pair_gaussian,
    pair_tile,
    pair_blocks,
    tile_counts,
    stretch_pairs,
    entry_first,
    entry_count,
    entry_place,
    cells,
    starts,
):  # type: ignore[no-untyped-def]
    """List the Gaussians of each tile.

    Args:
        workers: Threads to share the work.
        stretches: How many pieces the sorted list is handed out in.
        counters: For sharing; entries 1 to 3 must be 0.
        records, depth_bits, bounds, drawn, parcels: What projection wrote; the depths as integers.
        log2_alpha_min: Where a Gaussian ends.
        columns, tiles: Tiles side by side, and in all.
        keys, moved: Scratch. [Gaussians drawn]
        ranges: Scratch. [2 for each parcel]
        digits: Scratch. [DIGITS for each worker]
        pair_gaussian, pair_tile, pair_blocks: Scratch. [tiles within bounds]
        tile_counts: Scratch. [tiles for each stretch]
        stretch_pairs: Scratch. [2 for each stretch]
        entry_first, entry_count: Out: where in ``entry_place`` the entries of a Gaussian are listed, and how many. Only
            those of Gaussians drawn are written. [Gaussians]
        entry_place: Out: place among ``cells``. [tiles within bounds]
        cells: Out: see ``layout``. [2 for each tile within bounds]
        starts: Out: first entry of each tile, and how many there are. [tiles + 1]
    """
    count = 0
    parcel_count = len(parcels) // 2
    for parcel in range(parcel_count):
        count, parcels[2 * parcel] = count + parcels[2 * parcel], count
    for worker in numba.prange(workers):
        for parcel in range(parcel_count * worker // workers, parcel_count * (worker + 1) // workers):
            collect_parcel(parcel, parcels[2 * parcel], depth_bits, drawn, keys, ranges)
    lowest, highest = ranges[0], ranges[1]
    for parcel in range(parcel_count):
        lowest, highest = min(lowest, ranges[2 * parcel]), max(highest, ranges[2 * parcel + 1])
    significant = 0
    while lowest + (1 << significant) <= highest:
        significant += 1
    passes = (significant + DIGIT_BITS - 1) // DIGIT_BITS
    width = (significant + passes - 1) // max(passes, 1)
    mask = (1 << width) - 1
    for turn in range(passes):
        shift = turn * width
        for worker in numba.prange(workers):
            first, last = count * worker // workers, count * (worker + 1) // workers
            count_digits(worker, keys, first, last, lowest, shift, mask, digits)
        turn_counts_into_places(workers, mask + 1, digits)
        for worker in numba.prange(workers):
            first, last = count * worker // workers, count * (worker + 1) // workers
            move_by_digit(worker, keys, first, last, lowest, shift, mask, digits, moved)
        keys, moved = moved, keys

    for _ in numba.prange(workers):
        while True:
            stretch = take(counters, 1, 1)
            if stretch >= stretches:
                break
            first, last = count * stretch // stretches, count * (stretch + 1) // stretches
            pairs = _find_pairs(
                stretch, first, last, keys, records, bounds, log2_alpha_min, columns, tiles, counters, pair_gaussian,
                pair_tile, pair_blocks, tile_counts, entry_first, entry_count,
            )  # fmt: skip
            stretch_pairs[2 * stretch], stretch_pairs[2 * stretch + 1] = pairs
    total = 0
    for tile in range(tiles):
        starts[tile] = total
        for stretch in range(stretches):
            at = stretch * tiles + tile
            total, tile_counts[at] = total + tile_counts[at], total
    starts[tiles] = total
    for _ in numba.prange(workers):
        while True:
            stretch = take(counters, 3, 1)
            if stretch >= stretches:
                break
            first, last = stretch_pairs[2 * stretch], stretch_pairs[2 * stretch + 1]
            _sort_pairs(
                first, last, stretch * tiles, pair_gaussian, pair_tile, pair_blocks, tile_counts, entry_place, cells
            )


@part
def _find_pairs(
    stretch,
    first,
    last,
    keys,
    records,
    bounds,
    log2_alpha_min,
    columns,
    tiles,
    counters,
    pair_gaussian,
    pair_tile,
    pair_blocks,
    tile_counts,
    entry_first,
    entry_count,
):  # type: ignore[no-untyped-def]
    """Pair the Gaussians in places ``first`` to ``last`` of the sorted list with the tiles they touch.

    Returns:
        First and last place of these pairs in the lists of pairs.
    """
    counted = stretch * tiles
    for tile in range(tiles):
        tile_counts[counted + tile] = 0
    within_bounds = 0
    for place in range(first, last):
        at = 4 * (keys[place] & 0xFFFFFFFF)
        across = int(bounds[at + 1]) - int(bounds[at]) + 1
        within_bounds += across * (int(bounds[at + 3]) - int(bounds[at + 2]) + 1)
    # Where the pairs of a stretch lie does not matter, for they are sorted by stretch.
    pair_first = take(counters, 2, within_bounds)
    pair = pair_first
    block_left = fma(lane_columns(), layout.BLOCK, 0.5)
    block_top = fma(lane_rows(), layout.BLOCK, 0.5)
    for place in range(first, last):
        index = keys[place] & 0xFFFFFFFF
        row = layout.ROW * index
        u_xx = broadcast(records, row + layout.U_XX)
        u_yx = broadcast(records, row + layout.U_YX)
        u_yy = broadcast(records, row + layout.U_YY)
        slope_upright = broadcast(records, row + layout.SLOPE_UPRIGHT)
        slope_level = broadcast(records, row + layout.SLOPE_LEVEL)
        mean_x, mean_y = records[row + layout.MEAN_X], records[row + layout.MEAN_Y]
        reach = splat(records[row + layout.LOG2_OPACITY] - log2_alpha_min + layout.REACH_SLACK)
        entry_first[index] = pair
        column_first, column_last = int(bounds[4 * index]), int(bounds[4 * index + 1])
        for tile_row in range(int(bounds[4 * index + 2]), int(bounds[4 * index + 3]) + 1):
            top = sub(add(block_top, tile_row * layout.TILE), mean_y)
            bottom = add(top, layout.BLOCK - 1)
            for column in range(column_first, column_last + 1):
                left = sub(add(block_left, column * layout.TILE), mean_x)
                nearest = squared_distance_to_box(
                    u_xx, u_yx, u_yy, slope_upright, slope_level, left, add(left, layout.BLOCK - 1), top, bottom
                )
                blocks = bits(at_most(nearest, reach))
                if blocks:
                    tile = tile_row * columns + column
                    pair_gaussian[pair] = index
                    pair_tile[pair] = tile
                    pair_blocks[pair] = blocks
                    tile_counts[counted + tile] += 1
                    pair += 1
        entry_count[index] = pair - entry_first[index]
    return pair_first, pair


@part
def _sort_pairs(first, last, counted, pair_gaussian, pair_tile, pair_blocks, places, entry_place, cells):  # type: ignore[no-untyped-def]
    """Put pairs ``first`` to ``last`` where their tile belongs; ``places`` from ``counted`` on say where that is."""
    for pair in range(first, last):
        at = counted + pair_tile[pair]
        place = places[at]
        places[at] = place + 1
        cells[2 * place] = pair_gaussian[pair]
        cells[2 * place + 1] = pair_blocks[pair]
        entry_place[pair] = place
