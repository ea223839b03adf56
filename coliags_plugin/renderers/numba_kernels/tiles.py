"""What both sweeps do with a tile: order of tiles, and fetching its Gaussians."""

from __future__ import annotations

from coliags_plugin.renderers.numba_kernels import layout
from coliags_plugin.renderers.numba_kernels.compilation import inline, part

#: Entries of a tile fetched at a time: their rows fit into the first-level cache beside the blocks' state.
CHUNK = 128

# Columns of a fetched row: the whitening and log2(opacity) where ``records`` has them, and with (x, y) counted from the
# middle of the tile e = U_XX x + OFFSET_E and f = U_YX x + U_YY y + OFFSET_F.
OFFSET_E = layout.MEAN_X
OFFSET_F = layout.MEAN_Y
CHANNELS = layout.COLOR
MEDIAN_DEPTH = CHANNELS + layout.MAX_CHANNELS


@part
def fetch_chunk(first, last, alive, cells, records, channel_columns, middle_x, middle_y, at, rows, blocks):  # type: ignore[no-untyped-def]
    """Fetch entries ``first`` to ``last`` of a tile.

    Args:
        first, last: Among ``cells``.
        alive: Blocks that still let light through, one bit each.
        cells, records: See ``layout``.
        channel_columns: Which columns of ``records`` are composited.
        middle_x, middle_y: Middle of the tile, pixels.
        at: Where to write in ``rows``.
        rows: Out. [16 for each entry]
        blocks: Out: those of the alive blocks that the entry touches.

    Returns:
        Whether there are any.
    """
    touched = 0
    for entry in range(first, last):
        mine = cells[2 * entry + 1] & alive
        blocks[entry - first] = mine
        touched |= mine
        if mine:
            source = layout.ROW * cells[2 * entry]
            target = at + layout.ROW * (entry - first)
            u_xx, u_yx, u_yy = records[source], records[source + 1], records[source + 2]
            x, y = records[source + layout.MEAN_X] - middle_x, records[source + layout.MEAN_Y] - middle_y
            rows[target] = u_xx
            rows[target + 1] = u_yx
            rows[target + 2] = u_yy
            rows[target + OFFSET_E] = -u_xx * x
            rows[target + OFFSET_F] = -(u_yx * x + u_yy * y)
            rows[target + layout.LOG2_OPACITY] = records[source + layout.LOG2_OPACITY]
            for channel in range(len(channel_columns)):
                rows[target + CHANNELS + channel] = records[source + channel_columns[channel]]
            rows[target + MEDIAN_DEPTH] = records[source + layout.DEPTH]
    return touched


@inline
def tile_corner(tile, columns):  # type: ignore[no-untyped-def]
    """Column and row of a tile's first pixel."""
    return layout.TILE * (tile % columns), layout.TILE * (tile // columns)


@inline
def block_corner(block):  # type: ignore[no-untyped-def]
    """Column and row of a block's first pixel within its tile."""
    return layout.BLOCK * (block & 3), layout.BLOCK * (block >> 2)


@part
def order_tiles(starts, order):  # type: ignore[no-untyped-def]
    """Tiles by the number of binary digits of their number of entries, longest first, so that no thread is left with a
    long one in the end."""
    place = 0
    for digits in range(40, -1, -1):
        for tile in range(len(starts) - 1):
            count = starts[tile + 1] - starts[tile]
            if (count >> digits) == 1 or (digits == 0 and count == 0):
                order[place] = tile
                place += 1
