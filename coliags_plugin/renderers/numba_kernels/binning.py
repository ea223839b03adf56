"""Binning of the drawn Gaussians, sorted by depth, into tiles and blocks, front to back.

Tiles and blocks only save work: what is listed here is a superset of the pairs of pixel and Gaussian with
alpha >= alpha_min, and the sweeps test each of those again. The list of Gaussians is cut into stretches that
threads handle on their own; the result is the same however many there are.
"""

from __future__ import annotations

from coliags_plugin.core.numba_kernels import lanes as vec
from coliags_plugin.core.numba_kernels.compilation import inline, kernel, part
from coliags_plugin.core.numba_kernels.threads import pieces, take
from coliags_plugin.renderers.numba_kernels import layout
from coliags_plugin.renderers.numba_kernels.geometry import may_show, squared_distance_to_box

#: Prefetch distance, Gaussians.
_AHEAD = 8


@kernel
def find_pairs(counters, projections, view, grid, circle, nearest_first, pairs, entry_counts):
    """Pair the Gaussians with the tiles they touch.

    ``circle`` is an empty tuple for 3D Gaussians, and one with an element for surfels, which also reach a circle; records are
    their outlines then. ``pairs`` has room for all tiles within bounds, and those of a stretch may be anywhere among the
    others; ``entry_counts`` is written likewise: pairs of each Gaussian.
    """
    stretches = len(pairs.begins)
    for stretch in pieces(counters, 0, stretches):
        first, last = len(nearest_first) * stretch // stretches, len(nearest_first) * (stretch + 1) // stretches
        begin = take(counters, 1, _tiles_within_bounds(first, last, nearest_first, projections.bounds))
        pairs.begins[stretch] = begin
        pairs.ends[stretch] = _find_stretch(
            first,
            last,
            begin,
            stretch * grid.tiles,
            projections,
            view,
            grid,
            circle,
            nearest_first,
            pairs,
            entry_counts,
        )


@part
def _tiles_within_bounds(first, last, nearest_first, bounds):
    """Upper bound of the number of pairs of the Gaussians with indices ``first`` to ``last`` in the sorted list."""
    total = 0
    for place in range(first, last):
        at = 4 * (nearest_first[place])
        across = int(vec.number(bounds, at + 1)) - int(vec.number(bounds, at)) + 1
        total += across * (int(vec.number(bounds, at + 3)) - int(vec.number(bounds, at + 2)) + 1)
    return total


@part
def _find_stretch(first, last, pair, counted, projections, view, grid, circle, nearest_first, pairs, entry_counts):
    """Pair the Gaussians with indices ``first`` to ``last`` in the sorted list.

    Writes the pairs from ``pair`` on and counts those of each tile from ``counted`` on; returns the index after the last.
    """
    records, bounds = projections.outlines, projections.bounds
    for tile in range(counted, counted + grid.tiles):
        pairs.tile_counts[tile] = 0
    block_left = vec.fma(vec.lane_columns(), layout.BLOCK, 0.5)
    block_top = vec.fma(vec.lane_rows(), layout.BLOCK, 0.5)
    for place in range(first, last):
        ahead = nearest_first[min(place + _AHEAD, last - 1)]
        vec.prefetch(records, layout.ROW * ahead)
        vec.prefetch(bounds, 4 * ahead)
        index = nearest_first[place]
        row, bound = layout.ROW * index, 4 * index
        u_xx, u_yx = vec.broadcast(records, row + layout.U_XX), vec.broadcast(records, row + layout.U_YX)
        u_yy = vec.broadcast(records, row + layout.U_YY)
        slope_upright = vec.broadcast(records, row + layout.SLOPE_UPRIGHT)
        slope_level = vec.broadcast(records, row + layout.SLOPE_LEVEL)
        mean_x, mean_y = vec.number(records, row + layout.MEAN_X), vec.number(records, row + layout.MEAN_Y)
        reach = vec.number(records, row + layout.LOG2_OPACITY) - vec.number(view, layout.VIEW_LOG2_ALPHA_MIN)
        reach = vec.splat(reach + layout.REACH_SLACK)
        column_first, column_last = int(vec.number(bounds, bound)), int(vec.number(bounds, bound + 1))
        begin = pair
        for tile_row in range(int(vec.number(bounds, bound + 2)), int(vec.number(bounds, bound + 3)) + 1):
            top = vec.sub(vec.add(block_top, tile_row * layout.TILE), mean_y)
            bottom = vec.add(top, layout.BLOCK - 1)
            for column in range(column_first, column_last + 1):
                left = vec.sub(vec.add(block_left, column * layout.TILE), mean_x)
                right = vec.add(left, layout.BLOCK - 1)
                nearest = squared_distance_to_box(
                    u_xx, u_yx, u_yy, slope_upright, slope_level, left, right, top, bottom
                )
                if len(circle) > 0:
                    nearest = _nearest_of_surfel(nearest, reach, records, row, left, right, top, bottom, view)
                blocks = vec.bits(vec.at_most(nearest, reach))
                if blocks:
                    tile = tile_row * grid.columns + column
                    pairs.gaussian[pair] = index
                    pairs.tile[pair] = tile
                    pairs.blocks[pair] = blocks
                    pairs.tile_counts[counted + tile] += 1
                    pair += 1
        entry_counts[place] = pair - begin
    return pair


@inline
def _nearest_of_surfel(in_ellipse, reach, records, row, left, right, top, bottom, view):
    """Smallest squared distance of a surfel's reach to boxes, given that of its ellipse.

    The sides of the boxes are offsets from the ellipse's centre.
    """
    if vec.number(records, row + layout.U_XX) == 0.0:
        in_ellipse = _nearest_of_crossing(reach, records, row, left, right, top, bottom, view)
    shift_x, shift_y = _circle(records, row)
    x = vec.add(vec.larger(vec.sub(left, shift_x), 0.0), vec.smaller(vec.sub(right, shift_x), 0.0))
    y = vec.add(vec.larger(vec.sub(top, shift_y), 0.0), vec.smaller(vec.sub(bottom, shift_y), 0.0))
    away = vec.mul(vec.broadcast(view, layout.VIEW_PIXEL_SCALE), (x, y))
    return vec.smaller(in_ellipse, vec.dot(away, away, 0.0))


@part
def _nearest_of_crossing(reach, records, row, left, right, top, bottom, view):
    """Stands for the distance where a disc crosses the near plane: ``reach`` in boxes where it may be seen."""
    scale, (shift_x, shift_y) = vec.broadcast(view, layout.VIEW_PIXEL_SCALE), _circle(records, row)
    half_x, half_y = vec.mul(0.5, vec.sub(right, left)), vec.mul(0.5, vec.sub(bottom, top))
    x, y = vec.sub(vec.add(left, half_x), shift_x), vec.sub(vec.add(top, half_y), shift_y)
    x, y, half_x, half_y = vec.mul(scale, (x, y, half_x, half_y))
    slopes = vec.broadcast_all(records, row + layout.OUTLINE_SLOPES, (0,) * 6)
    is_seen = may_show(slopes, vec.sqrt(reach), vec.broadcast(records, row + layout.U_YY), x, y, half_x, half_y)
    return vec.select(is_seen, reach, vec.add(reach, 1.0))


@inline
def _circle(records, row):
    """The centre of the circle that a surfel reaches, from that of its ellipse."""
    x = vec.number(records, row + layout.CIRCLE_X) - vec.number(records, row + layout.MEAN_X)
    return x, vec.number(records, row + layout.CIRCLE_Y) - vec.number(records, row + layout.MEAN_Y)


@kernel
def sort_pairs(counters, grid, pairs, bins):
    """Sort the pairs by tile into ``bins.cells``.

    ``pairs.tile_counts`` are the offsets of the first entry of each stretch and tile, which are incremented.
    """
    cells, places = bins.cells, pairs.tile_counts
    for stretch in pieces(counters, 2, len(pairs.begins)):
        entry, first = bins.stretch_entries[stretch], stretch * grid.tiles
        for pair in range(pairs.begins[stretch], pairs.ends[stretch]):
            at = first + pairs.tile[pair]
            cell = layout.CELL * places[at]
            places[at] += 1
            cells[cell] = pairs.gaussian[pair]
            cells[cell + 1] = pairs.blocks[pair]
            cells[cell + 2] = entry
            entry += 1
