"""Pairs of Gaussians and the tiles that their outlines touch."""

from __future__ import annotations

import triton
import triton.language as tl

from coliags_plugin.renderers.triton_kernels.geometry import OUTLINE_COLUMNS, squared_distance_to_box


@triton.jit
def find_pairs(
    outlines, boxes, order, counts, ends, gaussian, tiles, count, columns,
    EMIT: tl.constexpr, SIZE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Count the tiles of each Gaussian; or, in the order given, write the pairs that end at ``ends``."""
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = place < count
    row = place
    if EMIT:
        row = tl.load(order + place, here, 0)
    entry = outlines + OUTLINE_COLUMNS * row
    center_x, center_y = tl.load(entry, here, 0.0), tl.load(entry + 1, here, 0.0)
    outline = (
        tl.load(entry + 2, here, 0.0),
        tl.load(entry + 3, here, 0.0),
        tl.load(entry + 4, here, 0.0),
        tl.load(entry + 5, here, 0.0),
        tl.load(entry + 6, here, 0.0),
    )
    rim = tl.load(entry + 7, here, -1.0)
    circle_x, circle_y = tl.load(entry + 8, here, 0.0), tl.load(entry + 9, here, 0.0)
    squared_radius = tl.load(entry + 10, here, -1.0)
    first, last = tl.load(boxes + 4 * row, here, 0), tl.load(boxes + 4 * row + 1, here, -1)
    upper, lower = tl.load(boxes + 4 * row + 2, here, 0), tl.load(boxes + 4 * row + 3, here, -1)
    across = last - first + 1
    area = across * (lower - upper + 1)
    pair_count = tl.zeros([BLOCK], tl.int32)
    begin = tl.zeros([BLOCK], tl.int64)
    if EMIT:
        counted = tl.load(counts + row, here, 0)
        begin = tl.load(ends + place, here, 0) - counted
    column, tile_row = first, upper
    step = 0
    most = tl.max(area)
    while step < most:
        x, y = (column * SIZE).to(tl.float32) + 0.5, (tile_row * SIZE).to(tl.float32) + 0.5
        left, top = x - center_x, y - center_y
        nearest = squared_distance_to_box(outline, left, left + (SIZE - 1), top, top + (SIZE - 1))
        out_x = tl.maximum(x - circle_x, 0.0) + tl.minimum(x + (SIZE - 1) - circle_x, 0.0)
        out_y = tl.maximum(y - circle_y, 0.0) + tl.minimum(y + (SIZE - 1) - circle_y, 0.0)
        hit = (step < area) & ((nearest <= rim) | (out_x * out_x + out_y * out_y <= squared_radius))
        if EMIT:
            # Counted by the same numbers, but maybe not rounded alike: never write more pairs than were counted.
            hit = hit & (pair_count < counted)
            tl.store(gaussian + begin + pair_count, row.to(tl.int32), hit)
            tl.store(tiles + begin + pair_count, tile_row * columns + column, hit)
        pair_count += hit.to(tl.int32)
        ends_row = column == last
        tile_row += ends_row.to(tl.int32)
        column = tl.where(ends_row, first, column + 1)
        step += 1
    if not EMIT:
        tl.store(counts + row, pair_count, here)
