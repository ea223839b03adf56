"""3D Gaussians -> records: projected centre, whitening of the 2D covariance, and what is composited.

The formulas are those of ``docs/rendering.md``, section "Projection", for sixteen Gaussians at a time.
"""

from __future__ import annotations

import numba

from coliags_plugin.renderers.numba_kernels import layout
from coliags_plugin.renderers.numba_kernels.compilation import inline, part, region_kernel
from coliags_plugin.renderers.numba_kernels.geometry import (
    cross,
    project_axes,
    shortest_axes,
    shortest_column,
    squared_distance_to_box,
)
from coliags_plugin.renderers.numba_kernels.lanes import (
    add,
    at_least,
    at_most,
    bit_count,
    bits,
    both,
    broadcast,
    broadcast_all,
    ceil,
    div,
    dot,
    floor,
    fma,
    greater,
    lane,
    lane_sums,
    larger,
    load,
    load_columns,
    log2,
    mul,
    neg,
    select,
    smaller,
    splat,
    sqrt,
    store,
    store_columns,
    sub,
)
from coliags_plugin.renderers.numba_kernels.threads import take

#: Gaussians of one parcel of work.
PARCEL = 1024
#: Shorter quaternions (squared) have no direction.
_SMALLEST_SQUARED_NORM = 1e-24


@region_kernel
def project(
    workers,
    counters,
    count,
    means,
    quats,
    scales,
    opacities,
    colors,
    tail_means,
    tail_quats,
    tail_scales,
    tail_opacities,
    tail_colors,
    view,
    with_depth,
    with_inverse_depth,
    with_normals,
    records,
    means2d,
    depths,
    radii,
    bounds,
    drawn,
    parcels,
):  # type: ignore[no-untyped-def]
    """Project all Gaussians and find out how far they reach.

    Args:
        workers: Threads to share the work.
        counters: For sharing; entry 0 must be 0.
        count: How many Gaussians.
        means, quats, scales, opacities, colors: Flat.
        tail_means, tail_quats, tail_scales, tail_opacities, tail_colors: Those Gaussians that do not fill a group of
            sixteen, filled up with ones that are not drawn.
        view: See ``layout``.
        with_depth, with_inverse_depth, with_normals: What is composited besides colour.
        records: Out, see ``layout``. [16 rows for each group]
        means2d: Out, pixels. [2 for each Gaussian, groups filled up, like all that follow]
        depths: Out.
        radii: Out, pixels, 0 where not drawn.
        bounds: Out: first and last column, first and last row of the tiles within reach. [4 for each Gaussian]
        drawn: Out: one bit for each Gaussian of a group. [groups]
        parcels: Out: of each parcel Gaussians drawn, -1 where one cannot be used, and tiles within their bounds.
            [2 for each parcel]
    """
    groups = (count + 15) // 16
    whole_groups = count // 16
    parcel_count = (count + PARCEL - 1) // PARCEL
    per_parcel = PARCEL // 16
    for _ in numba.prange(workers):
        while True:
            parcel = take(counters, 0, 1)
            if parcel >= parcel_count:
                break
            first = parcel * per_parcel
            last = min(first + per_parcel, whole_groups)
            drawn_count, tile_count = _project_groups(
                first, last, first, means, quats, scales, opacities, colors, view, with_depth, with_inverse_depth,
                with_normals, records, means2d, depths, radii, bounds, drawn,
            )  # fmt: skip
            if last < min(first + per_parcel, groups) and drawn_count >= 0:
                more, more_tiles = _project_groups(
                    last, last + 1, 0, tail_means, tail_quats, tail_scales, tail_opacities, tail_colors, view,
                    with_depth, with_inverse_depth, with_normals, records, means2d, depths, radii, bounds, drawn,
                )  # fmt: skip
                drawn_count = drawn_count + more if more >= 0 else -1
                tile_count += more_tiles
            parcels[2 * parcel] = drawn_count
            parcels[2 * parcel + 1] = tile_count


@part
def _project_groups(
    first,
    last,
    source,
    means,
    quats,
    scales,
    opacities,
    colors,
    view,
    with_depth,
    with_inverse_depth,
    with_normals,
    records,
    means2d,
    depths,
    radii,
    bounds,
    drawn,
):  # type: ignore[no-untyped-def]
    """Project groups ``first`` to ``last``, reading from group ``source`` of the inputs on.

    Returns:
        How many are drawn, -1 where one cannot be used; and how many tiles are within their bounds.
    """
    drawn_count, tile_count = 0, 0
    usable = True
    three = (0, 0, 0)
    log2_alpha_min = broadcast(view, layout.VIEW_LOG2_ALPHA_MIN)
    right_edge = sub(broadcast(view, layout.VIEW_WIDTH), 0.5)
    bottom_edge = sub(broadcast(view, layout.VIEW_HEIGHT), 0.5)
    last_column = floor(mul(right_edge, 1.0 / layout.TILE))
    last_row = floor(mul(bottom_edge, 1.0 / layout.TILE))
    low_pass = broadcast(view, layout.VIEW_LOW_PASS)
    for group in range(first, last):
        from_row = 16 * (group - first + source)
        mean = load_columns(means, 3 * from_row, three)
        quat = load_columns(quats, 4 * from_row, (0, 0, 0, 0))
        scale = load_columns(scales, 3 * from_row, three)
        opacity = load(opacities, from_row)
        color = load_columns(colors, 3 * from_row, three)
        at = project_axes(mean, quat, view)

        # Zero times anything but a finite number is not a number.
        finite = dot(mean, (0.0, 0.0, 0.0), mul(opacity, 0.0))
        finite = dot(scale, (0.0, 0.0, 0.0), finite)
        finite = dot(color, (0.0, 0.0, 0.0), finite)
        finite = fma(at.squared_norm, 0.0, finite)
        good = both(at_least(finite, 0.0), at_least(at.squared_norm, _SMALLEST_SQUARED_NORM))
        good = both(good, at_least(smaller(smaller(scale[0], scale[1]), scale[2]), 0.0))
        usable = usable and bits(good) == 0xFFFF

        row_x, row_y = mul(at.local_x, scale), mul(at.local_y, scale)
        sharp_xx, sharp_yy = dot(row_x, row_x, 0.0), dot(row_y, row_y, 0.0)
        xx, xy, yy = add(sharp_xx, low_pass), dot(row_x, row_y, 0.0), add(sharp_yy, low_pass)
        # xx yy - xy^2 cancels for needles; this sum of squares is the same number (Cauchy-Binet) and does not.
        normal = cross(row_x, row_y)
        determinant = dot(normal, normal, mul(low_pass, add(add(sharp_xx, sharp_yy), low_pass)))
        u_xx = div(layout.U_FACTOR, sqrt(xx))
        u_yy = mul(layout.U_FACTOR, sqrt(div(xx, determinant)))
        slope_upright, slope_level = div(xy, xx), div(xy, yy)
        u_yx = neg(mul(u_yy, slope_upright))
        mean_x = fma(broadcast(view, layout.VIEW_FX), mul(at.x, at.inverse_z), broadcast(view, layout.VIEW_CX))
        mean_y = fma(broadcast(view, layout.VIEW_FY), mul(at.y, at.inverse_z), broadcast(view, layout.VIEW_CY))
        log2_opacity = log2(opacity)

        reach = sub(log2_opacity, log2_alpha_min)
        nearest = squared_distance_to_box(
            u_xx, u_yx, u_yy, slope_upright, slope_level, sub(0.5, mean_x), sub(right_edge, mean_x),
            sub(0.5, mean_y), sub(bottom_edge, mean_y),
        )  # fmt: skip
        shown = both(both(at.in_front, at_least(reach, 0.0)), at_most(nearest, reach))
        tau = mul(reach, 1.0 / layout.U_FACTOR_SQUARED)
        half = larger(sqrt(mul(tau, xx)), sqrt(mul(tau, yy)))
        store(radii, 16 * group, select(shown, ceil(half), 0.0))

        tau = mul(add(reach, layout.REACH_SLACK), 1.0 / layout.U_FACTOR_SQUARED)
        half_x, half_y = sqrt(mul(tau, xx)), sqrt(mul(tau, yy))
        column_first = _tile(sub(mean_x, half_x), last_column)
        column_last = _tile(add(mean_x, half_x), last_column)
        row_first = _tile(sub(mean_y, half_y), last_row)
        row_last = _tile(add(mean_y, half_y), last_row)
        store_columns(bounds, 64 * group, (column_first, column_last, row_first, row_last))
        area = mul(add(sub(column_last, column_first), 1.0), add(sub(row_last, row_first), 1.0))
        tile_count += int(lane(lane_sums((select(shown, area, 0.0),)), 0))
        flags = bits(shown)
        drawn[group] = flags
        drawn_count += bit_count(flags)

        store_columns(means2d, 32 * group, (mean_x, mean_y))
        store(depths, 16 * group, at.z)
        facing = _facing_normals(at, scale, view) if with_normals else (splat(0.0), splat(0.0), splat(0.0))
        channels = color + _extra_channels(at.z, at.inverse_z, facing, with_depth, with_inverse_depth)
        row = (u_xx, u_yx, u_yy, mean_x, mean_y, log2_opacity) + channels + (slope_upright, slope_level)  # noqa: RUF005
        store_columns(records, 16 * layout.ROW * group, row)
    return (drawn_count if usable else -1), tile_count


@inline
def _tile(position, last):  # type: ignore[no-untyped-def]
    """Column or row of the tile at a position, clamped to those there are; finite whatever the position."""
    return larger(smaller(floor(mul(position, 1.0 / layout.TILE)), last), 0.0)


@inline
def _extra_channels(depth, inverse_depth, normal, with_depth, with_inverse_depth):  # type: ignore[no-untyped-def]
    """What is composited besides colour, without gaps; what is behind that does not matter."""
    if with_depth:
        if with_inverse_depth:
            return depth, inverse_depth, normal[0], normal[1], normal[2]
        return depth, normal[0], normal[1], normal[2], splat(0.0)
    if with_inverse_depth:
        return inverse_depth, normal[0], normal[1], normal[2], splat(0.0)
    return normal[0], normal[1], normal[2], splat(0.0), splat(0.0)


@inline
def _facing_normals(at, scale, view):  # type: ignore[no-untyped-def]
    """The shortest axes, camera axes, turned so that they look at the camera."""
    second, third = shortest_axes(scale)
    axis = shortest_column(at.rotation, second, third)
    # The line of sight and the axis may be compared in the world as well as in the camera.
    axis = select(greater(dot(axis, at.offset, 0.0), 0.0), neg(axis), axis)
    right = broadcast_all(view, layout.VIEW_RIGHT, (0, 0, 0))
    down = broadcast_all(view, layout.VIEW_DOWN, (0, 0, 0))
    forward = broadcast_all(view, layout.VIEW_FORWARD, (0, 0, 0))
    return dot(axis, right, 0.0), dot(axis, down, 0.0), dot(axis, forward, 0.0)
