"""What both sweeps do with a tile: order of tiles, and fetching its Gaussians."""

from __future__ import annotations

from coliags_plugin.renderers.numba_kernels import layout
from coliags_plugin.renderers.numba_kernels.compilation import inline, part
from coliags_plugin.renderers.numba_kernels.lanes import load, number, prefetch, store

#: Entries of a tile fetched at a time: their rows fit into the first-level cache beside the blocks' state.
CHUNK = 128
#: How many entries before its turn a record is asked for.
_AHEAD = 32

# A fetched row is one of ``records`` with other columns where those hold the centre, and the slopes: with (x, y)
# counted from the middle of the tile e = U_XX x + OFFSET_E and f = U_YX x + U_YY y + OFFSET_F.
OFFSET_E = layout.MEAN_X
OFFSET_F = layout.MEAN_Y
MEDIAN_DEPTH = layout.SLOPE_UPRIGHT


@part
def fetch_chunk(first, last, alive, cells, records, depths, middle_x, middle_y, rows, blocks):  # type: ignore[no-untyped-def]
    """Fetch entries ``first`` to ``last`` of a tile.

    Args:
        first, last: Among ``cells``.
        alive: Blocks that still let light through, one bit each.
        cells, records, depths: See ``layout``.
        middle_x, middle_y: Middle of the tile, pixels.
        rows: Out. [16 for each entry]
        blocks: Out: those of the alive blocks that the entry touches.

    Returns:
        All blocks that any of the entries touches.
    """
    touched = 0
    for entry in range(first, last):
        prefetch(records, layout.ROW * cells[layout.CELL * min(entry + _AHEAD, last - 1)])
        mine = cells[layout.CELL * entry + 1] & alive
        blocks[entry - first] = mine
        touched |= mine
        if mine:
            index = cells[layout.CELL * entry]
            source, target = layout.ROW * index, layout.ROW * (entry - first)
            store(rows, target, load(records, source))
            x, y = (
                number(records, source + layout.MEAN_X) - middle_x,
                number(records, source + layout.MEAN_Y) - middle_y,
            )
            turned = number(records, source + layout.U_YX) * x + number(records, source + layout.U_YY) * y
            rows[target + OFFSET_E] = -number(records, source + layout.U_XX) * x
            rows[target + OFFSET_F] = -turned
            rows[target + MEDIAN_DEPTH] = number(depths, index)
    return touched


@inline
def tile_corner(tile, columns):  # type: ignore[no-untyped-def]
    """Column and row of a tile's first pixel."""
    return layout.TILE * (tile % columns), layout.TILE * (tile // columns)


@inline
def block_corner(block):  # type: ignore[no-untyped-def]
    """Column and row of a block's first pixel within its tile."""
    return layout.BLOCK * (block & 3), layout.BLOCK * (block >> 2)


@inline
def place_in_blocks(x, y, stride):  # type: ignore[no-untyped-def]
    """Where pixel (x, y) of a tile is in vectors of its blocks that are ``stride`` apart."""
    return stride * (4 * (y >> 2) + (x >> 2)) + 4 * (y & 3) + (x & 3)


@part
def order_tiles(starts, order):  # type: ignore[no-untyped-def]
    """Tiles by the binary digits of their number of entries, longest first: no thread is left with a long one."""
    place = 0
    for digits in range(40, -1, -1):
        for tile in range(len(starts) - 1):
            count = starts[tile + 1] - starts[tile]
            if (count >> digits) == 1 or (digits == 0 and count == 0):
                order[place] = tile
                place += 1
