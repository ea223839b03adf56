"""Records -> which blocks of which tiles each Gaussian touches, by tile and front to back.

Tiles and blocks only save work: what is listed here is a superset of the pairs of pixel and Gaussian with
alpha >= alpha_min, and the sweeps decide about each of those again.
"""

from __future__ import annotations

import numba

from coliags_plugin.renderers.numba_kernels import layout
from coliags_plugin.renderers.numba_kernels.compilation import kernel, part, region
from coliags_plugin.renderers.numba_kernels.geometry import squared_distance_to_box
from coliags_plugin.renderers.numba_kernels.lanes import (
    add,
    at_most,
    bits,
    broadcast,
    fma,
    lane_columns,
    lane_rows,
    number,
    prefetch,
    splat,
    sub,
)
from coliags_plugin.renderers.numba_kernels.sorting import NUMBER, sort_by_depth
from coliags_plugin.renderers.numba_kernels.threads import take
from coliags_plugin.renderers.numba_kernels.tiles import order_tiles

#: How many Gaussians before its turn a record is asked for.
_AHEAD = 8


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
    stretch_entries,
    entry_counts,
    cells,
    starts,
    order,
):  # type: ignore[no-untyped-def]
    """List the Gaussians of each tile.

    Args:
        workers: Threads to share the work.
        stretches: How many pieces the sorted list is handed out in.
        counters: For sharing; entries 1 to 3 must be 0.
        records, depth_bits, bounds, drawn, parcels: What projection wrote; the depths as integers.
        log2_alpha_min: Where a Gaussian ends.
        columns, tiles: Tiles side by side, and in all.
        keys: Out, see ``sorting``.
        moved, ranges, digits: Scratch, see ``sorting``.
        pair_gaussian, pair_tile, pair_blocks: Scratch. [tiles within bounds]
        tile_counts: Scratch. [tiles for each stretch]
        stretch_pairs: Scratch. [2 for each stretch]
        stretch_entries: Out: number of the first entry of each stretch, counted by depth, and how many there are.
            [stretches + 1]
        entry_counts: Out: entries of each Gaussian, by depth. [Gaussians drawn]
        cells: Out: see ``layout``. [3 for each tile within bounds]
        starts: Out: first entry of each tile, and how many there are. [tiles + 1]
        order: Out: tiles, long lists first. [tiles]
    """
    count = sort_by_depth(workers, parcels, depth_bits, drawn, keys, moved, ranges, digits)
    _find_all_pairs(
        workers, stretches, counters, count, keys, records, bounds, log2_alpha_min, columns, tiles, pair_gaussian,
        pair_tile, pair_blocks, tile_counts, stretch_pairs, entry_counts,
    )  # fmt: skip
    total = 0
    for stretch in range(stretches):
        stretch_entries[stretch] = total
        total += stretch_pairs[2 * stretch + 1] - stretch_pairs[2 * stretch]
    stretch_entries[stretches] = total
    total = 0
    for tile in range(tiles):
        starts[tile] = total
        for stretch in range(stretches):
            at = stretch * tiles + tile
            total, tile_counts[at] = total + tile_counts[at], total
    starts[tiles] = total
    order_tiles(starts, order)
    _sort_all_pairs(
        workers, stretches, counters, tiles, pair_gaussian, pair_tile, pair_blocks, tile_counts, stretch_pairs,
        stretch_entries, cells,
    )  # fmt: skip


@region
def _find_all_pairs(
    workers,
    stretches,
    counters,
    count,
    keys,
    records,
    bounds,
    log2_alpha_min,
    columns,
    tiles,
    pair_gaussian,
    pair_tile,
    pair_blocks,
    tile_counts,
    stretch_pairs,
    entry_counts,
):  # type: ignore[no-untyped-def]
    for _ in numba.prange(workers):
        while True:
            stretch = take(counters, 1, 1)
            if stretch >= stretches:
                break
            first, last = count * stretch // stretches, count * (stretch + 1) // stretches
            # Where the pairs of a stretch lie does not matter, for they are sorted by stretch.
            pair_first = take(counters, 2, _tiles_within_bounds(first, last, keys, bounds))
            pair_last = _find_pairs(
                first, last, pair_first, stretch * tiles, keys, records, bounds, log2_alpha_min, columns, tiles,
                pair_gaussian, pair_tile, pair_blocks, tile_counts, entry_counts,
            )  # fmt: skip
            stretch_pairs[2 * stretch], stretch_pairs[2 * stretch + 1] = pair_first, pair_last


@part
def _tiles_within_bounds(first, last, keys, bounds):  # type: ignore[no-untyped-def]
    """How many pairs the Gaussians in places ``first`` to ``last`` can make."""
    total = 0
    for place in range(first, last):
        at = 4 * (keys[place] & NUMBER)
        across = int(number(bounds, at + 1)) - int(number(bounds, at)) + 1
        total += across * (int(number(bounds, at + 3)) - int(number(bounds, at + 2)) + 1)
    return total


@part
def _find_pairs(
    first,
    last,
    pair,
    counted,
    keys,
    records,
    bounds,
    log2_alpha_min,
    columns,
    tiles,
    pair_gaussian,
    pair_tile,
    pair_blocks,
    tile_counts,
    entry_counts,
):  # type: ignore[no-untyped-def]
    """Pair the Gaussians in places ``first`` to ``last`` of the sorted list with the tiles they touch.

    Writes the pairs from ``pair`` on, and counts those of each tile in ``tile_counts`` from ``counted`` on.

    Returns:
        Where the pairs end.
    """
    for tile in range(counted, counted + tiles):
        tile_counts[tile] = 0
    block_left = fma(lane_columns(), layout.BLOCK, 0.5)
    block_top = fma(lane_rows(), layout.BLOCK, 0.5)
    for place in range(first, last):
        prefetch(records, layout.ROW * (keys[min(place + _AHEAD, last - 1)] & NUMBER))
        index = keys[place] & NUMBER
        row = layout.ROW * index
        u_xx = broadcast(records, row + layout.U_XX)
        u_yx = broadcast(records, row + layout.U_YX)
        u_yy = broadcast(records, row + layout.U_YY)
        slope_upright = broadcast(records, row + layout.SLOPE_UPRIGHT)
        slope_level = broadcast(records, row + layout.SLOPE_LEVEL)
        mean_x, mean_y = records[row + layout.MEAN_X], records[row + layout.MEAN_Y]
        reach = splat(records[row + layout.LOG2_OPACITY] - log2_alpha_min + layout.REACH_SLACK)
        column_first, column_last = int(bounds[4 * index]), int(bounds[4 * index + 1])
        pair_start = pair
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
        entry_counts[place] = pair - pair_start
    return pair


@region
def _sort_all_pairs(
    workers,
    stretches,
    counters,
    tiles,
    pair_gaussian,
    pair_tile,
    pair_blocks,
    tile_counts,
    stretch_pairs,
    stretch_entries,
    cells,
):  # type: ignore[no-untyped-def]
    for _ in numba.prange(workers):
        while True:
            stretch = take(counters, 3, 1)
            if stretch >= stretches:
                break
            _sort_pairs(
                stretch_pairs[2 * stretch], stretch_pairs[2 * stretch + 1], stretch_entries[stretch], stretch * tiles,
                pair_gaussian, pair_tile, pair_blocks, tile_counts, cells,
            )  # fmt: skip


@part
def _sort_pairs(first, last, entry, counted, pair_gaussian, pair_tile, pair_blocks, places, cells):  # type: ignore[no-untyped-def]
    """Put pairs ``first`` to ``last``, which become the entries from ``entry`` on, where their tiles belong.

    ``places`` say from ``counted`` on where that is.
    """
    for pair in range(first, last):
        at = counted + pair_tile[pair]
        cell = layout.CELL * places[at]
        places[at] += 1
        cells[cell] = pair_gaussian[pair]
        cells[cell + 1] = pair_blocks[pair]
        cells[cell + 2] = entry
        entry += 1
