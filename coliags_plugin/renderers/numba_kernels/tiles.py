"""Tiles: binning of Gaussians sorted by depth into them and their blocks, and their handling in both sweeps.

Tiles and blocks only save work: what is listed here is a superset of the pairs of pixel and Gaussian with
alpha >= alpha_min, and the sweeps test each of those again. The list of Gaussians is cut into stretches that threads handle
on their own; the result is the same however many there are.
"""

from __future__ import annotations

import numpy as np

from coliags_plugin.core.numba_kernels import lanes as vec
from coliags_plugin.core.numba_kernels.compilation import inline, kernel, part
from coliags_plugin.core.numba_kernels.threads import pieces, take
from coliags_plugin.renderers.numba_kernels import layout
from coliags_plugin.renderers.numba_kernels.geometry import may_show, squared_distance_to_box

#: Entries of a tile fetched at a time: their rows fit into the first-level cache beside the blocks' state.
CHUNK = 128
#: Prefetch distance in the list of Gaussians, and of records, entries.
_AHEAD_IN_LIST, _AHEAD = 8, 32
#: Prefetch distance of the memory of the sums, entries.
SUMS_AHEAD = 12

# A fetched row of a 3D Gaussian is one of ``records`` with other columns where that holds the centre and a slope: with
# (x, y) counted from the middle of the tile e = U_XX x + OFFSET_E and f = U_YX x + U_YY y + OFFSET_F.
OFFSET_E = layout.MEAN_X
OFFSET_F = layout.MEAN_Y
MEDIAN_DEPTH = layout.SLOPE_UPRIGHT

# A fetched row of a surfel is one of ``records`` with the centre from the middle of the tile, in scaled pixels, and two
# more columns: 1 / SURFEL_DEPTH, and the largest q, where the disc is at the near plane.
INVERSE_DEPTH = layout.ROW
LARGEST_Q = layout.ROW + 1
FETCHED_SURFEL = layout.ROW + 4

# The vectors of a block: its state in a sweep, and the pixels of images, or the derivatives with respect to them.
TRANSMITTANCE = 0
ALPHA = 16
CHANNELS = 32  # colour; of 3D Gaussians with what follows
DEPTH = 80
INVERSE = 96
NORMALS = 112
MEDIAN = 160
EXPECTED = 176
DISTORTION = 192
FURTHER = 208  # what only one of the sweeps needs
STATE = 272

#: Scratch of one thread: rows of a chunk, states of a tile's blocks.
NUMBERS = CHUNK * FETCHED_SURFEL + layout.BLOCKS * STATE
#: Scratch of one thread: blocks of a chunk's entries, entries of a tile's blocks, and how many.
INTEGERS = CHUNK + layout.BLOCKS * CHUNK + layout.BLOCKS


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
        ahead = nearest_first[min(place + _AHEAD_IN_LIST, last - 1)]
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
    """Stand-in for the distance of a disc that crosses the near plane: ``reach`` in boxes where it may be seen."""
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


# --- sweeps -----------------------------------------------------------------------------------------------------------


@inline
def of_thread(counters, scratch):
    """The thread's rows, states and integers, which are taken by the second counter."""
    thread = take(counters, 1, 1)
    rows = scratch.numbers[thread * NUMBERS : (thread + 1) * NUMBERS]
    return rows, rows[CHUNK * FETCHED_SURFEL :], scratch.integers[thread * INTEGERS : (thread + 1) * INTEGERS]


def composited_vectors(outputs: layout.Outputs) -> int:
    """Vectors that a forward sweep leaves of each block: alpha, sums over what is composited, and the distortion's."""
    measures = len(outputs.normals) + len(outputs.depth) + len(outputs.inverse_depth) + 2 * len(outputs.distortion)
    return 1 + len(outputs.channels) + measures


@part
def fetch_gaussians(first, last, alive, corner_x, corner_y, projections, view, cells, rows, blocks):
    """Fetch the rows of entries ``first`` to ``last`` of a tile, and the alive blocks that each touches.

    ``alive`` has one bit for each block with transmittance left; the corner is the first pixel of the tile.
    """
    records = projections.records
    middle_x, middle_y = np.float32(corner_x + layout.TILE // 2), np.float32(corner_y + layout.TILE // 2)
    for entry in range(first, last):
        vec.prefetch(records, layout.ROW * cells[layout.CELL * min(entry + _AHEAD, last - 1)])
        index = cells[layout.CELL * entry]
        mine = cells[layout.CELL * entry + 1] & alive
        blocks[entry - first] = mine
        if mine:
            source, target = layout.ROW * index, layout.ROW * (entry - first)
            vec.store(rows, target, vec.load(records, source))
            x = vec.number(records, source + layout.MEAN_X) - middle_x
            y = vec.number(records, source + layout.MEAN_Y) - middle_y
            turned = vec.number(records, source + layout.U_YX) * x + vec.number(records, source + layout.U_YY) * y
            rows[target + OFFSET_E] = -vec.number(records, source + layout.U_XX) * x
            rows[target + OFFSET_F] = -turned
            rows[target + MEDIAN_DEPTH] = vec.number(projections.depths, index)


@part
def fetch_surfels(first, last, alive, corner_x, corner_y, projections, view, cells, rows, blocks):
    """Fetch the rows of surfels: as :func:`fetch_gaussians`."""
    records, remainders = projections.records, projections.remainders
    scale, near = vec.number(view, layout.VIEW_PIXEL_SCALE), vec.number(view, layout.VIEW_NEAR)
    middle_x, middle_y = np.float32(corner_x + layout.TILE // 2), np.float32(corner_y + layout.TILE // 2)
    for entry in range(first, last):
        ahead = cells[layout.CELL * min(entry + _AHEAD, last - 1)]
        vec.prefetch(records, layout.ROW * ahead)
        vec.prefetch(remainders, 2 * ahead)
        index = cells[layout.CELL * entry]
        mine = cells[layout.CELL * entry + 1] & alive
        blocks[entry - first] = mine
        if mine:
            source, target = layout.ROW * index, FETCHED_SURFEL * (entry - first)
            vec.store(rows, target, vec.load(records, source))
            x = vec.number(records, source + layout.SURFEL_MEAN_X) - middle_x + vec.number(remainders, 2 * index)
            y = vec.number(records, source + layout.SURFEL_MEAN_Y) - middle_y + vec.number(remainders, 2 * index + 1)
            rows[target + layout.SURFEL_MEAN_X], rows[target + layout.SURFEL_MEAN_Y] = scale * x, scale * y
            depth = vec.number(records, source + layout.SURFEL_DEPTH)
            rows[target + INVERSE_DEPTH] = np.float32(1.0) / depth
            rows[target + LARGEST_Q] = min(depth / near, np.float32(layout.LARGE))


@inline
def scaled_pixels(block, view):
    """Columns and rows of a block's pixel centres from the middle of its tile, in scaled pixels."""
    return vec.mul(vec.broadcast(view, layout.VIEW_PIXEL_SCALE), block_pixels(block, view))


@inline
def intersect(rows, row, x, y):
    """Intersect the rays of pixels with the disc of a fetched row.

    Returns the offset from the projected centre, scaled pixels; q, 1 / q, e and f of ``surfel_layout``; and where the ray
    hits the disc's plane beyond the near plane: elsewhere all but the offset are 0.
    """
    u_x, u_y, v_x, v_y, q_x, q_y = vec.broadcast_all(rows, row + layout.SURFEL_U_X, (0,) * 6)
    d_x = vec.sub(x, vec.broadcast(rows, row + layout.SURFEL_MEAN_X))
    d_y = vec.sub(y, vec.broadcast(rows, row + layout.SURFEL_MEAN_Y))
    q = vec.fma(q_x, d_x, vec.fma(q_y, d_y, 1.0))
    hit = vec.both(vec.greater(q, 0.0), vec.at_most(q, vec.broadcast(rows, row + LARGEST_Q)))
    inverse_q = vec.select(hit, vec.quick_div(1.0, q), 0.0)
    e, f = vec.fma(u_x, d_x, vec.mul(u_y, d_y)), vec.fma(v_x, d_x, vec.mul(v_y, d_y))
    return d_x, d_y, vec.select(hit, q, 0.0), inverse_q, vec.mul(e, inverse_q), vec.mul(f, inverse_q), hit


@inline
def tile_corner(tile, grid):
    """Column and row of a tile's first pixel, and how many of its columns and rows are inside the image."""
    x, y = layout.TILE * (tile % grid.columns), layout.TILE * (tile // grid.columns)
    return x, y, min(layout.TILE, grid.width - x), min(layout.TILE, grid.height - y)


@inline
def block_corner(block):
    """Column and row of a block's first pixel within its tile."""
    return layout.BLOCK * (block & 3), layout.BLOCK * (block >> 2)


@inline
def block_pixels(block, _view):
    """Columns and rows of a block's pixel centres from the middle of its tile."""
    x, y = block_corner(block)
    half = 0.5 * layout.TILE - 0.5
    return vec.add(vec.lane_columns(), x - half), vec.add(vec.lane_rows(), y - half)


@inline
def inside(block, across, down):
    """Mask of the pixels of a block that are among the first ``across`` columns and ``down`` rows of its tile."""
    x, y = block_corner(block)
    return vec.both(vec.less(vec.lane_columns(), across - x), vec.less(vec.lane_rows(), down - y))


@inline
def place_in_blocks(x, y):
    """Index of pixel (x, y) of a tile in vectors of its blocks."""
    return STATE * (4 * (y >> 2) + (x >> 2)) + 4 * (y & 3) + (x & 3)


@part
def list_by_block(count, stride, blocks, listed, counts):
    """List the rows of a chunk that touch each block, front to back.

    Branch-free, as branches would be unpredictable, and four blocks at a time: every row is written to every list, and
    kept where the length of the list is incremented.
    """
    for block in range(0, layout.BLOCKS, 4):
        a, b, c, d = CHUNK * block, CHUNK * (block + 1), CHUNK * (block + 2), CHUNK * (block + 3)
        for entry in range(count):
            row, touched = stride * entry, blocks[entry] >> block
            listed[a], listed[b], listed[c], listed[d] = row, row, row, row
            a += touched & 1
            b += touched >> 1 & 1
            c += touched >> 2 & 1
            d += touched >> 3 & 1
        counts[block], counts[block + 1] = a - CHUNK * block, b - CHUNK * (block + 1)
        counts[block + 2], counts[block + 3] = c - CHUNK * (block + 2), d - CHUNK * (block + 3)


@part
def copy_pixels(tile, grid, state, images, outwards):
    """Copy the pixels of a tile from its blocks to the images that are not empty, or from these to the blocks."""
    for channel in range(3):
        _copy_channel(tile, grid, state, CHANNELS + 16 * channel, images.rgb, 3, channel, outwards)
        _copy_channel(tile, grid, state, NORMALS + 16 * channel, images.normals, 3, channel, outwards)
    for vector, image in (
        (ALPHA, images.alpha),
        (DEPTH, images.depth),
        (INVERSE, images.inverse_depth),
        (MEDIAN, images.median),
        (EXPECTED, images.expected),
        (DISTORTION, images.distortion),
    ):
        _copy_channel(tile, grid, state, vector, image, 1, 0, outwards)


@part
def _copy_channel(tile, grid, state, vector, image, depth, channel, outwards):
    """Copy a vector of a tile's blocks to one of the ``depth`` channels of an image, or the other way."""
    if len(image):
        corner_x, corner_y, across, down = tile_corner(tile, grid)
        for y in range(down):
            first = ((corner_y + y) * grid.width + corner_x) * depth + channel
            for x in range(across):
                pixel, place = first + x * depth, vector + place_in_blocks(x, y)
                if outwards:
                    image[pixel] = vec.number(state, place)
                else:
                    state[place] = vec.number(image, pixel)
