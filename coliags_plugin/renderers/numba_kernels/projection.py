"""Projection of 3D Gaussians to records: centre, whitening of the 2D covariance, and composited channels.

The formulas are those of ``docs/rendering.md``, section "Projection", for sixteen Gaussians at a time.
"""

from __future__ import annotations

from coliags_plugin.core.numba_compilation import inline, kernel, part
from coliags_plugin.renderers.numba_kernels import layout
from coliags_plugin.renderers.numba_kernels.geometry import (
    camera_axes,
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

#: Shorter quaternions (squared) have no direction.
SMALLEST_SQUARED_NORM = 1e-24


@kernel
def project(counters, count, gaussians, tail, view, extras, projections, means2d, radii):
    """Project all Gaussians and compute their extents.

    Args:
        counters: Work counters for dynamic scheduling; entry 0 must be 0.
        count: Number of Gaussians.
        gaussians: The Gaussians. [layout.Parameters]
        tail: Those behind the last full group, filled up with ones that are not drawn. [layout.Parameters]
        view: See ``layout``.
        extras: What is composited besides colour.
        projections: Out.
        means2d: Out: projected centres, pixels, padded to whole groups. [2 for each Gaussian]
        radii: Out: pixels, 0 where not drawn, padded to whole groups. [1 for each Gaussian]
    """
    whole_groups = count // layout.GROUP
    per_parcel = layout.PARCEL // layout.GROUP
    while True:
        parcel = take(counters, 0, 1)
        if parcel * layout.PARCEL >= count:
            break
        first = parcel * per_parcel
        last = min(first + per_parcel, whole_groups)
        drawn, tiles = _project_groups(first, last, first, gaussians, view, extras, projections, means2d, radii)
        if last * layout.GROUP < min((parcel + 1) * layout.PARCEL, count):
            more, more_tiles = _project_groups(last, last + 1, 0, tail, view, extras, projections, means2d, radii)
            drawn = -1 if drawn < 0 or more < 0 else drawn + more
            tiles += more_tiles
        projections.parcels[2 * parcel] = drawn
        projections.parcels[2 * parcel + 1] = tiles


@part
def _project_groups(first, last, source, gaussians, view, extras, projections, means2d, radii):
    """Project groups ``first`` to ``last``, reading from group ``source`` of the Gaussians on.

    Returns:
        The number of Gaussians drawn, -1 where one is invalid; and the number of tiles within their bounds.
    """
    drawn, tiles, usable = 0, 0, True
    three = (0, 0, 0)
    log2_alpha_min, low_pass = broadcast(view, layout.VIEW_LOG2_ALPHA_MIN), broadcast(view, layout.VIEW_LOW_PASS)
    right_edge = sub(broadcast(view, layout.VIEW_WIDTH), 0.5)
    bottom_edge = sub(broadcast(view, layout.VIEW_HEIGHT), 0.5)
    for group in range(first, last):
        row = layout.GROUP * (group - first + source)
        mean, scale = load_columns(gaussians.means, 3 * row, three), load_columns(gaussians.scales, 3 * row, three)
        quat, opacity = load_columns(gaussians.quats, 4 * row, (0, 0, 0, 0)), load(gaussians.opacities, row)
        color = load_columns(gaussians.colors, 3 * row, three)
        at = project_axes(mean, quat, view)
        usable = usable and bits(are_usable(mean, at.squared_norm, scale, opacity, color)) == 0xFFFF

        row_x, row_y = mul(at.local_x, scale), mul(at.local_y, scale)
        sharp_xx, sharp_yy = dot(row_x, row_x, 0.0), dot(row_y, row_y, 0.0)
        xx, xy, yy = add(sharp_xx, low_pass), dot(row_x, row_y, 0.0), add(sharp_yy, low_pass)
        # xx yy - xy^2 cancels for needles; this sum of squares is the same number (Cauchy-Binet) and does not.
        across = cross(row_x, row_y)
        determinant = dot(across, across, mul(low_pass, add(add(sharp_xx, sharp_yy), low_pass)))
        u_xx = div(layout.U_FACTOR, sqrt(xx))
        u_yy = mul(layout.U_FACTOR, sqrt(div(xx, determinant)))
        slope_upright, slope_level = div(xy, xx), div(xy, yy)
        u_yx = neg(mul(u_yy, slope_upright))
        mean_x = fma(broadcast(view, layout.VIEW_FX), mul(at.x, at.inverse_z), broadcast(view, layout.VIEW_CX))
        mean_y = fma(broadcast(view, layout.VIEW_FY), mul(at.y, at.inverse_z), broadcast(view, layout.VIEW_CY))

        log2_opacity = log2(opacity)
        reach = sub(log2_opacity, log2_alpha_min)
        left, right = sub(0.5, mean_x), sub(right_edge, mean_x)
        top, bottom = sub(0.5, mean_y), sub(bottom_edge, mean_y)
        nearest = squared_distance_to_box(u_xx, u_yx, u_yy, slope_upright, slope_level, left, right, top, bottom)
        shown = both(both(at.in_front, at_least(reach, 0.0)), at_most(nearest, reach))
        tau = mul(reach, 1.0 / layout.U_FACTOR_SQUARED)
        half = larger(sqrt(mul(tau, xx)), sqrt(mul(tau, yy)))
        store(radii, layout.GROUP * group, select(shown, ceil(half), 0.0))

        tau = mul(add(reach, layout.REACH_SLACK), 1.0 / layout.U_FACTOR_SQUARED)
        half_x, half_y = sqrt(mul(tau, xx)), sqrt(mul(tau, yy))
        column_first, column_last = tile_at(sub(mean_x, half_x), right_edge), tile_at(add(mean_x, half_x), right_edge)
        row_first, row_last = tile_at(sub(mean_y, half_y), bottom_edge), tile_at(add(mean_y, half_y), bottom_edge)
        store_columns(projections.bounds, 4 * layout.GROUP * group, (column_first, column_last, row_first, row_last))
        area = mul(add(sub(column_last, column_first), 1.0), add(sub(row_last, row_first), 1.0))
        tiles += int(lane(lane_sums((select(shown, area, 0.0),)), 0))
        flags = bits(shown)
        drawn += bit_count(flags)
        projections.drawn[group] = flags

        store_columns(means2d, 2 * layout.GROUP * group, (mean_x, mean_y))
        store(projections.depths, layout.GROUP * group, at.z)
        normal = _facing_normals(at, scale, view) if extras.normals else (splat(0.0), splat(0.0), splat(0.0))
        whole = (
            (u_xx, u_yx, u_yy, mean_x, mean_y, log2_opacity)
            + color
            + _without_gaps(at.z, at.inverse_z, normal, extras)
            + (slope_upright, slope_level)
        )
        store_columns(projections.records, layout.ROW * layout.GROUP * group, whole)
    return (drawn if usable else -1), tiles


@inline
def are_usable(mean, squared_norm, scale, opacity, color):
    """Whether all numbers are finite, scales are not negative, and the quaternion has a direction."""
    # 0 times infinity or NaN is NaN.
    none = (0.0, 0.0, 0.0)
    finite = dot(mean, none, dot(scale, none, dot(color, none, mul(opacity, 0.0))))
    finite = fma(squared_norm, 0.0, finite)
    positive = at_least(smaller(smaller(scale[0], scale[1]), scale[2]), 0.0)
    return both(both(at_least(finite, 0.0), positive), at_least(squared_norm, SMALLEST_SQUARED_NORM))


@inline
def tile_at(position, edge):
    """Column or row of the tile at a position, clamped to those in the image; finite whatever the position."""
    return larger(smaller(floor(mul(position, 1.0 / layout.TILE)), floor(mul(edge, 1.0 / layout.TILE))), 0.0)


@inline
def _facing_normals(at, scale, view):
    """The shortest axes, camera axes, oriented towards the camera."""
    second, third = shortest_axes(scale)
    axis = shortest_column(at.rotation, second, third)
    # The line of sight and the axis may be compared in the world as well as in the camera.
    axis = select(greater(dot(axis, at.offset, 0.0), 0.0), neg(axis), axis)
    right, down, forward = camera_axes(view)
    return dot(axis, right, 0.0), dot(axis, down, 0.0), dot(axis, forward, 0.0)


@inline
def _without_gaps(depth, inverse_depth, normal, extras):
    """The composited extras without gaps; the remaining entries are ignored."""
    if extras.depth:
        if extras.inverse_depth:
            return depth, inverse_depth, normal[0], normal[1], normal[2]
        return depth, normal[0], normal[1], normal[2], splat(0.0)
    if extras.inverse_depth:
        return inverse_depth, normal[0], normal[1], normal[2], splat(0.0)
    return normal[0], normal[1], normal[2], splat(0.0), splat(0.0)
