"""Kernels of decoding: visibility and opacities of all anchors, the children drawn, and the gradients of both.

There are M anchors of K children, in tiles of R, ``networks.ROWS``; N children are drawn. Their tables are those
of ``fields/children.py``.
"""

from __future__ import annotations

import triton
import triton.language as tl

from coliags_plugin.fields.triton_kernels.networks import OUTPUTS, ROWS, outputs, outputs_backward, tanh

#: Shortest quaternion, and smallest scale, that is divided by.
SHORTEST = tl.constexpr(1e-12)


@triton.jit
def _in_frustum(
    positions, offsets, scalings, rows, inside, slots, is_child, pose, fx, fy, cx, cy, width, height, near_plane, sigmas
):
    """True if an anchor's children may overlap the image, as ``spheres_in_frustum`` finds of their sphere. [R]"""
    farthest = tl.zeros(slots.shape, tl.float32)
    largest = tl.full(rows.shape, float("-inf"), tl.float32)
    for axis in tl.static_range(3):
        size = tl.exp(tl.load(scalings + 6 * rows + axis, inside, 0.0))
        shift = tl.load(offsets + 3 * slots + axis, is_child, 0.0) * size[:, None]
        farthest += shift * shift
        largest = tl.maximum(largest, tl.load(scalings + 6 * rows + 3 + axis, inside, 0.0))
    radius = tl.sqrt(tl.max(farthest, axis=1)) + sigmas * tl.exp(largest)
    x, y, z = tl.zeros(rows.shape, tl.float32), tl.zeros(rows.shape, tl.float32), tl.zeros(rows.shape, tl.float32)
    for axis in tl.static_range(3):
        sight = tl.load(positions + 3 * rows + axis, inside, 0.0) - tl.load(pose + 4 * axis + 3)
        x += sight * tl.load(pose + 4 * axis)
        y += sight * tl.load(pose + 4 * axis + 1)
        z += sight * tl.load(pose + 4 * axis + 2)
    inside &= z + radius > near_plane
    inside &= _passes_side(x, z, radius, fx, cx) & _passes_side(-x, z, radius, fx, width - cx)
    return inside & _passes_side(y, z, radius, fy, cy) & _passes_side(-y, z, radius, fy, height - cy)


@triton.jit
def _passes_side(x, z, radius, focal_length, border):
    """True if spheres reach across the plane through an image border, so far from the principal point. [R]"""
    return focal_length * x + border * z + radius * tl.sqrt(focal_length * focal_length + border * border) > 0.0


@triton.jit
def _tile(tile, anchors, CHILDREN: tl.constexpr, SLOTS: tl.constexpr):
    """Anchors and whether they are there [R], children [K], slots of all children and whether they are there. [R, K]"""
    rows = tile * ROWS + tl.arange(0, ROWS)
    child = tl.arange(0, SLOTS)
    is_child = (rows < anchors)[:, None] & (child < CHILDREN)[None, :]
    return rows, rows < anchors, child, rows[:, None] * CHILDREN + child[None, :], is_child


@triton.jit
def _numbers(first, drawn):
    """The numbers of the children drawn of a tile, in order. [R, K]"""
    counts = drawn.to(tl.int32)
    of_rows = tl.sum(counts, axis=1)
    return first.to(tl.int32) + (tl.cumsum(of_rows) - of_rows)[:, None] + tl.cumsum(counts, axis=1) - counts


@triton.jit
def decode_opacities(
    positions, offsets, scalings, features, inputs, table, pose, visible, opacities, counts,
    anchors, tiles, fx, fy, cx, cy, width, height, near_plane, sigmas,
    NETWORK: tl.constexpr, SLOTS: tl.constexpr,
):  # fmt: skip
    """Write which anchors are visible [M], opacities [M, K], 0 of those not visible, and counts by tile. [2, 1 + tiles]

    Counted are visible anchors, and children of positive opacity.
    """
    tile = tl.program_id(0)
    rows, inside, child, slots, is_child = _tile(tile, anchors, NETWORK.children, SLOTS)
    shown = _in_frustum(
        positions, offsets, scalings, rows, inside, slots, is_child,
        pose, fx, fy, cx, cy, width, height, near_plane, sigmas,
    )  # fmt: skip
    tl.store(visible + rows, shown, inside)
    count = tl.sum(shown.to(tl.int32))
    values = tl.zeros(slots.shape, tl.float32)
    if count > 0:
        (logits,) = outputs(table, features, inputs, rows, shown, child, NETWORK)
        values = tl.where(shown[:, None] & is_child, tanh(logits), 0.0)
    tl.store(opacities + slots, values, is_child)
    tl.store(counts + 1 + tile, count)
    tl.store(counts + tiles + 2 + tile, tl.sum((values > 0.0).to(tl.int32)))


@triton.jit
def draw(
    positions, offsets, scalings, features, of_geometry, of_appearance, table, visible, opacities, starts,
    means, quats, inverse_lengths, scales, drawn_opacities, colors, sources, visible_sources, anchors, tiles,
    COVARIANCE: tl.constexpr, COLOR: tl.constexpr, SLOTS: tl.constexpr,
):  # fmt: skip
    """Write the visible anchors, and decode and write the children of positive opacity, both in order.

    ``starts`` are the numbers of either before each tile. [2, tiles + 1]
    """
    tile = tl.program_id(0)
    rows, inside, child, slots, is_child = _tile(tile, anchors, COLOR.children, SLOTS)
    shown = tl.load(visible + rows, inside, 0) != 0
    place = tl.load(starts + tile) + tl.cumsum(shown.to(tl.int32)) - 1
    tl.store(visible_sources + place, rows.to(tl.int64), shown)
    first, end = tl.load(starts + tiles + 1 + tile), tl.load(starts + tiles + 2 + tile)
    if first < end:
        values = tl.load(opacities + slots, is_child, 0.0)
        drawn = values > 0.0
        number = _numbers(first, drawn)
        tl.store(sources + number, slots.to(tl.int64), drawn)
        tl.store(drawn_opacities + number, values, drawn)
        decoded = outputs(table, features, of_geometry, rows, shown, child, COVARIANCE)
        squares = tl.zeros(slots.shape, tl.float32)
        for axis in tl.static_range(4):
            squares += decoded[3 + axis] * decoded[3 + axis]
        inverse = 1.0 / tl.maximum(tl.sqrt(squares), SHORTEST)
        tl.store(inverse_lengths + number, inverse, drawn)
        for axis in tl.static_range(4):
            tl.store(quats + 4 * number + axis, decoded[3 + axis] * inverse, drawn)
        for axis in tl.static_range(3):
            shift = tl.load(offsets + 3 * slots + axis, is_child, 0.0)
            shift *= tl.exp(tl.load(scalings + 6 * rows + axis, inside, 0.0))[:, None]
            position = tl.load(positions + 3 * rows + axis, inside, 0.0)
            tl.store(means + 3 * number + axis, position[:, None] + shift, drawn)
            size = tl.exp(tl.load(scalings + 6 * rows + 3 + axis, inside, 0.0))
            tl.store(scales + 3 * number + axis, size[:, None] * tl.sigmoid(decoded[axis]), drawn)
        decoded = outputs(table, features, of_appearance, rows, shown, child, COLOR)
        for axis in tl.static_range(3):
            tl.store(colors + 3 * number + axis, tl.sigmoid(decoded[axis]), drawn)


@triton.jit
def draw_backward(
    offsets, scalings, opacities, starts, quats, inverse_lengths, scales, colors,
    given_means, given_quats, given_scales, given_opacities, given_colors, of_offsets, of_scalings, of_outputs,
    anchors, tiles, CHILDREN: tl.constexpr, SLOTS: tl.constexpr,
):  # fmt: skip
    """Write gradients of offsets, scalings and networks' outputs [N, OUTPUTS], from those given of what was drawn."""
    tile = tl.program_id(0)
    rows, inside, _, slots, is_child = _tile(tile, anchors, CHILDREN, SLOTS)
    values = tl.load(opacities + slots, is_child, 0.0)
    drawn = values > 0.0
    number = _numbers(tl.load(starts + tiles + 1 + tile), drawn)
    of_outputs += OUTPUTS * number
    tl.store(of_outputs, tl.load(given_opacities + number, drawn, 0.0) * (1.0 - values * values), drawn)
    for axis in tl.static_range(3):
        size = tl.exp(tl.load(scalings + 6 * rows + axis, inside, 0.0))
        of_offset = tl.load(given_means + 3 * number + axis, drawn, 0.0) * size[:, None]
        tl.store(of_offsets + 3 * slots + axis, of_offset, is_child)
        shift = tl.load(offsets + 3 * slots + axis, is_child, 0.0)
        tl.store(of_scalings + 6 * rows + axis, tl.sum(of_offset * shift, axis=1), inside)
        scale = tl.load(scales + 3 * number + axis, drawn, 0.0)
        of_log = tl.load(given_scales + 3 * number + axis, drawn, 0.0) * scale
        tl.store(of_scalings + 6 * rows + 3 + axis, tl.sum(of_log, axis=1), inside)
        size = tl.exp(tl.load(scalings + 6 * rows + 3 + axis, inside, 0.0))
        tl.store(of_outputs + 1 + axis, of_log * (1.0 - scale / tl.maximum(size, SHORTEST)[:, None]), drawn)
        color = tl.load(colors + 3 * number + axis, drawn, 0.0)
        of_color = tl.load(given_colors + 3 * number + axis, drawn, 0.0)
        tl.store(of_outputs + 8 + axis, of_color * color * (1.0 - color), drawn)
    along = tl.zeros(slots.shape, tl.float32)
    for axis in tl.static_range(4):
        quat = tl.load(quats + 4 * number + axis, drawn, 0.0)
        along += quat * tl.load(given_quats + 4 * number + axis, drawn, 0.0)
    inverse = tl.load(inverse_lengths + number, drawn, 0.0)
    for axis in tl.static_range(4):
        quat = tl.load(quats + 4 * number + axis, drawn, 0.0)
        across = tl.load(given_quats + 4 * number + axis, drawn, 0.0) - quat * along
        tl.store(of_outputs + 4 + axis, across * inverse, drawn)


@triton.jit
def networks_backward(
    features, of_geometry, of_appearance, table, visible, opacities, starts, of_outputs,
    of_features, of_geometry_inputs, of_appearance_inputs, sums, anchors, tiles,
    OPACITY: tl.constexpr, COVARIANCE: tl.constexpr, COLOR: tl.constexpr, LENGTH: tl.constexpr,
    WITH_GEOMETRY: tl.constexpr, WITH_APPEARANCE: tl.constexpr,
    SLOTS: tl.constexpr, INPUTS: tl.constexpr,
):  # fmt: skip
    """Write gradients of the networks' inputs; add those of features and of their table to zeros.

    Every program has a slab of ``sums``, a table of LENGTH numbers, to which it adds those of its tiles.
    """
    of_table = sums + tl.program_id(0) * LENGTH
    for tile in range(tl.program_id(0), tiles, tl.num_programs(0)):
        rows, inside, child, slots, is_child = _tile(tile, anchors, COLOR.children, SLOTS)
        shown = tl.load(visible + rows, inside, 0) != 0
        if tl.max(shown.to(tl.int32)) > 0:
            drawn = tl.load(opacities + slots, is_child, 0.0) > 0.0
            number = _numbers(tl.load(starts + tiles + 1 + tile), drawn)
            column = tl.arange(0, INPUTS)
            zeros = tl.zeros([ROWS, INPUTS], tl.float32)
            of_inputs = outputs_backward(
                table, features, of_geometry, rows, shown, child, number, drawn, of_outputs, of_table, of_features,
                zeros, OPACITY, WITH_GEOMETRY,
            )  # fmt: skip
            of_inputs = outputs_backward(
                table, features, of_geometry, rows, shown, child, number, drawn, of_outputs + 1, of_table, of_features,
                of_inputs, COVARIANCE, WITH_GEOMETRY,
            )  # fmt: skip
            if WITH_GEOMETRY:
                here = shown[:, None] & (column < COVARIANCE.plain_inputs)[None, :]
                tl.store(
                    of_geometry_inputs + rows[:, None] * COVARIANCE.plain_inputs + column[None, :], of_inputs, here
                )
            of_inputs = outputs_backward(
                table, features, of_appearance, rows, shown, child, number, drawn, of_outputs + 8, of_table,
                of_features, zeros, COLOR, WITH_APPEARANCE,
            )  # fmt: skip
            if WITH_APPEARANCE:
                here = shown[:, None] & (column < COLOR.plain_inputs)[None, :]
                tl.store(of_appearance_inputs + rows[:, None] * COLOR.plain_inputs + column[None, :], of_inputs, here)
