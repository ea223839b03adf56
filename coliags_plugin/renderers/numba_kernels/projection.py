"""Projection of 3D Gaussians to records: centre, whitening of the 2D covariance, and composited channels.

The formulas are those of ``docs/rendering.md``, section "Projection", for sixteen Gaussians at a time.
"""

from __future__ import annotations

from coliags_plugin.core.numba_kernels import lanes as vec
from coliags_plugin.core.numba_kernels.compilation import inline, kernel, part
from coliags_plugin.core.numba_kernels.threads import pieces
from coliags_plugin.renderers.numba_kernels import layout
from coliags_plugin.renderers.numba_kernels.geometry import (
    camera_axes,
    cross,
    project_axes,
    shortest_axes,
    shortest_column,
    squared_distance_to_box,
)

#: Shorter quaternions (squared) have no direction.
SMALLEST_SQUARED_NORM = 1e-24


@kernel
def project(counters, count, gaussians, tail, view, own, projections, means2d, radii):
    """Project all Gaussians and compute their extents.

    Written are ``projections``, ``means2d`` in pixels and ``radii`` in pixels, 0 where not drawn. ``tail`` are the Gaussians
    behind the last full group, filled up with ones that are not drawn.
    """
    whole_groups = count // layout.GROUP
    per_parcel = layout.PARCEL // layout.GROUP
    for parcel in pieces(counters, 0, -(-count // layout.PARCEL)):
        first = parcel * per_parcel
        last = min(first + per_parcel, whole_groups)
        drawn, tiles = _project_groups(first, last, first, gaussians, view, own, projections, means2d, radii)
        if last * layout.GROUP < min((parcel + 1) * layout.PARCEL, count):
            more, more_tiles = _project_groups(last, last + 1, 0, tail, view, own, projections, means2d, radii)
            drawn = -1 if drawn < 0 or more < 0 else drawn + more
            tiles += more_tiles
        projections.parcels[2 * parcel] = drawn
        projections.parcels[2 * parcel + 1] = tiles


@part
def _project_groups(first, last, source, gaussians, view, extras, projections, means2d, radii):
    """Project groups ``first`` to ``last``, reading from group ``source`` of the Gaussians on.

    Returns the number of Gaussians drawn, -1 where one is invalid; and the number of tiles within their bounds.
    """
    drawn, tiles, usable = 0, 0, True
    three = (0, 0, 0)
    log2_alpha_min = vec.broadcast(view, layout.VIEW_LOG2_ALPHA_MIN)
    low_pass = vec.broadcast(view, layout.VIEW_LOW_PASS)
    right_edge = vec.sub(vec.broadcast(view, layout.VIEW_WIDTH), 0.5)
    bottom_edge = vec.sub(vec.broadcast(view, layout.VIEW_HEIGHT), 0.5)
    for group in range(first, last):
        row = layout.GROUP * (group - first + source)
        mean = vec.load_columns(gaussians.means, 3 * row, three)
        scale = vec.load_columns(gaussians.scales, 3 * row, three)
        quat, opacity = vec.load_columns(gaussians.quats, 4 * row, (0, 0, 0, 0)), vec.load(gaussians.opacities, row)
        color = vec.load_columns(gaussians.colors, 3 * row, three)
        at = project_axes(mean, quat, view)
        usable = usable and vec.bits(are_usable(mean, at.squared_norm, scale, opacity, color)) == 0xFFFF

        row_x, row_y = vec.mul(at.local_x, scale), vec.mul(at.local_y, scale)
        sharp_xx, sharp_yy = vec.dot(row_x, row_x, 0.0), vec.dot(row_y, row_y, 0.0)
        xx, xy, yy = vec.add(sharp_xx, low_pass), vec.dot(row_x, row_y, 0.0), vec.add(sharp_yy, low_pass)
        # xx yy - xy^2 cancels for needles; this sum of squares is the same number (Cauchy-Binet) and does not.
        across = cross(row_x, row_y)
        determinant = vec.dot(across, across, vec.mul(low_pass, vec.add(vec.add(sharp_xx, sharp_yy), low_pass)))
        u_xx = vec.div(layout.U_FACTOR, vec.sqrt(xx))
        u_yy = vec.mul(layout.U_FACTOR, vec.sqrt(vec.div(xx, determinant)))
        slope_upright, slope_level = vec.div(xy, xx), vec.div(xy, yy)
        u_yx = vec.neg(vec.mul(u_yy, slope_upright))
        slope_x, slope_y = vec.mul(at.x, at.inverse_z), vec.mul(at.y, at.inverse_z)
        mean_x = vec.fma(vec.broadcast(view, layout.VIEW_FX), slope_x, vec.broadcast(view, layout.VIEW_CX))
        mean_y = vec.fma(vec.broadcast(view, layout.VIEW_FY), slope_y, vec.broadcast(view, layout.VIEW_CY))

        log2_opacity = vec.log2(opacity)
        reach = vec.sub(log2_opacity, log2_alpha_min)
        left, right = vec.sub(0.5, mean_x), vec.sub(right_edge, mean_x)
        top, bottom = vec.sub(0.5, mean_y), vec.sub(bottom_edge, mean_y)
        nearest = squared_distance_to_box(u_xx, u_yx, u_yy, slope_upright, slope_level, left, right, top, bottom)
        shown = vec.both(vec.both(at.in_front, vec.at_least(reach, 0.0)), vec.at_most(nearest, reach))
        tau = vec.mul(reach, 1.0 / layout.U_FACTOR_SQUARED)
        half = vec.larger(vec.sqrt(vec.mul(tau, xx)), vec.sqrt(vec.mul(tau, yy)))
        vec.store(radii, layout.GROUP * group, vec.select(shown, vec.ceil(half), 0.0))

        tau = vec.mul(vec.add(reach, layout.REACH_SLACK), 1.0 / layout.U_FACTOR_SQUARED)
        half_x, half_y = vec.sqrt(vec.mul(tau, xx)), vec.sqrt(vec.mul(tau, yy))
        columns = (tile_at(vec.sub(mean_x, half_x), right_edge), tile_at(vec.add(mean_x, half_x), right_edge))
        rows = (tile_at(vec.sub(mean_y, half_y), bottom_edge), tile_at(vec.add(mean_y, half_y), bottom_edge))
        more, more_tiles = store_extents(group, shown, columns, rows, projections)
        drawn, tiles = drawn + more, tiles + more_tiles

        vec.store_columns(means2d, 2 * layout.GROUP * group, (mean_x, mean_y))
        vec.store(projections.depths, layout.GROUP * group, at.z)
        normal = _facing_normals(at, scale, view) if extras.normals else vec.repeat(0.0, three)
        whole = (u_xx, u_yx, u_yy, mean_x, mean_y, log2_opacity) + color
        whole = whole + _without_gaps(at.z, at.inverse_z, normal, extras) + (slope_upright, slope_level)
        vec.store_columns(projections.records, layout.ROW * layout.GROUP * group, whole)
    return (drawn if usable else -1), tiles


@inline
def store_extents(group, shown, columns, rows, projections):
    """Write the first and last columns and rows of tiles of a group; how many of it are drawn, and tiles within bounds."""
    vec.store_columns(projections.bounds, 4 * layout.GROUP * group, columns + rows)
    area = vec.mul(vec.add(vec.sub(columns[1], columns[0]), 1.0), vec.add(vec.sub(rows[1], rows[0]), 1.0))
    flags = vec.bits(shown)
    projections.drawn[group] = flags
    return vec.bit_count(flags), int(vec.lane(vec.lane_sums((vec.select(shown, area, 0.0),)), 0))


@inline
def are_usable(mean, squared_norm, scale, opacity, color):
    """Whether all numbers are finite, scales are not negative, and the quaternion has a direction."""
    # 0 times infinity or NaN is NaN.
    none = (0.0, 0.0, 0.0)
    finite = vec.dot(mean, none, vec.dot(scale, none, vec.dot(color, none, vec.mul(opacity, 0.0))))
    finite = vec.fma(squared_norm, 0.0, finite)
    positive = vec.at_least(vec.smaller(vec.smaller(scale[0], scale[1]), scale[2]), 0.0)
    return vec.both(vec.both(vec.at_least(finite, 0.0), positive), vec.at_least(squared_norm, SMALLEST_SQUARED_NORM))


@inline
def tile_at(position, edge):
    """Column or row of the tile at a position, clamped to those in the image; finite whatever the position."""
    return vec.larger(
        vec.smaller(vec.floor(vec.mul(position, 1.0 / layout.TILE)), vec.floor(vec.mul(edge, 1.0 / layout.TILE))), 0.0
    )


@inline
def _facing_normals(at, scale, view):
    """The shortest axes, camera axes, oriented towards the camera."""
    second, third = shortest_axes(scale)
    axis = shortest_column(at.rotation, second, third)
    # The line of sight and the axis may be compared in the world as well as in the camera.
    axis = vec.select(vec.greater(vec.dot(axis, at.offset, 0.0), 0.0), vec.neg(axis), axis)
    right, down, forward = camera_axes(view)
    return vec.dot(axis, right, 0.0), vec.dot(axis, down, 0.0), vec.dot(axis, forward, 0.0)


@inline
def _without_gaps(depth, inverse_depth, normal, extras):
    """The composited extras without gaps; the remaining entries are ignored."""
    if extras.depth:
        if extras.inverse_depth:
            return depth, inverse_depth, normal[0], normal[1], normal[2]
        return depth, normal[0], normal[1], normal[2], vec.splat(0.0)
    if extras.inverse_depth:
        return inverse_depth, normal[0], normal[1], normal[2], vec.splat(0.0)
    return normal[0], normal[1], normal[2], vec.splat(0.0), vec.splat(0.0)
