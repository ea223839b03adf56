"""Projection of 3D Gaussians to records, and of surfels to records and to outlines for binning: sixteen at a time.

The formulas are those of ``docs/rendering.md``, sections "Projection" and "Surfels".
"""

from __future__ import annotations

from collections.abc import Callable

from coliags_plugin.core.numba_kernels import lanes as vec
from coliags_plugin.core.numba_kernels.compilation import inline, kernel, part
from coliags_plugin.core.numba_kernels.threads import pieces
from coliags_plugin.renderers.numba_kernels import layout
from coliags_plugin.renderers.numba_kernels.geometry import (
    camera_axes,
    cross,
    may_show,
    place_surfels,
    project_axes,
    shortest_axes,
    shortest_column,
    squared_distance_to_box,
)

#: Shorter quaternions (squared) have no direction.
SMALLEST_SQUARED_NORM = 1e-24
#: Added to the squared distance to the rim, in standard deviations, and to the squared half-axes of its image, square
#: pixels: more than rounding, which is how discs seen edge-on stay ellipses.
_RIM_SLACK = 1e-2
_ELLIPSE_SLACK = 1e-4
#: Largest U and V. Discs so small that they reach it fall between all pixels.
_LARGEST_SLOPE = 1e10


def projecting(project_groups: Callable[..., tuple[int, int]]) -> Callable[..., None]:
    """Compile the kernel that projects all Gaussians, parcel by parcel, and computes their extents.

    It writes ``projections``, ``means2d`` in pixels and ``radii`` in pixels, 0 where not drawn; ``normals`` says whether
    normals are composited.

    ``project_groups`` projects groups ``first`` to ``last``. It returns the number of Gaussians drawn, -1 where one is
    invalid; and the number of tiles within their bounds.
    """

    @kernel
    def project(counters, gaussians, view, normals, projections, means2d, radii):
        groups, per_parcel = len(projections.drawn), layout.PARCEL // layout.GROUP
        for parcel in pieces(counters, 0, len(projections.parcels) // 2):
            first, last = parcel * per_parcel, min((parcel + 1) * per_parcel, groups)
            drawn, tiles = project_groups(first, last, gaussians, view, normals, projections, means2d, radii)
            projections.parcels[2 * parcel] = drawn
            projections.parcels[2 * parcel + 1] = tiles

    return project


# --- 3D Gaussians -----------------------------------------------------------------------------------------------------


@part
def _project_gaussians(first, last, gaussians, view, normals, projections, means2d, radii):
    """Project groups of 3D Gaussians: see :func:`projecting`."""
    drawn, tiles, usable = 0, 0, True
    three = (0, 0, 0)
    log2_alpha_min = vec.broadcast(view, layout.VIEW_LOG2_ALPHA_MIN)
    low_pass = vec.broadcast(view, layout.VIEW_LOW_PASS)
    right_axis, down_axis, forward_axis = camera_axes(view)
    right_edge = vec.sub(vec.broadcast(view, layout.VIEW_WIDTH), 0.5)
    bottom_edge = vec.sub(vec.broadcast(view, layout.VIEW_HEIGHT), 0.5)
    for group in range(first, last):
        row = layout.GROUP * group
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
        vec.store(radii, row, vec.select(shown, vec.ceil(half), 0.0))

        tau = vec.mul(vec.add(reach, layout.REACH_SLACK), 1.0 / layout.U_FACTOR_SQUARED)
        half_x, half_y = vec.sqrt(vec.mul(tau, xx)), vec.sqrt(vec.mul(tau, yy))
        columns = (tile_at(vec.sub(mean_x, half_x), right_edge), tile_at(vec.add(mean_x, half_x), right_edge))
        rows = (tile_at(vec.sub(mean_y, half_y), bottom_edge), tile_at(vec.add(mean_y, half_y), bottom_edge))
        more, more_tiles = store_extents(group, shown, columns, rows, projections)
        drawn, tiles = drawn + more, tiles + more_tiles

        vec.store_columns(means2d, 2 * row, (mean_x, mean_y))
        vec.store(projections.depths, row, at.z)
        normal = vec.repeat(0.0, three)
        if normals:
            second, third = shortest_axes(scale)
            axis = shortest_column(at.rotation, second, third)
            # The line of sight and the axis may be compared in the world as well as in the camera.
            axis = vec.select(vec.greater(vec.dot(axis, at.offset, 0.0), 0.0), vec.neg(axis), axis)
            normal = (vec.dot(axis, right_axis, 0.0), vec.dot(axis, down_axis, 0.0), vec.dot(axis, forward_axis, 0.0))
        whole = (u_xx, u_yx, u_yy, mean_x, mean_y, log2_opacity) + color
        whole = whole + (at.z, at.inverse_z) + normal + (slope_upright, slope_level)
        vec.store_columns(projections.records, layout.ROW * row, whole)
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
    """True if all numbers are finite, scales are not negative, and the quaternion has a direction."""
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


# --- surfels ----------------------------------------------------------------------------------------------------------


@part
def _project_surfels(first, last, surfels, view, _normals, projections, means2d, radii):
    """Project groups of surfels, always with normals: see :func:`projecting`."""
    drawn, tiles, usable = 0, 0, True
    three = (0, 0, 0)
    right, down, forward = camera_axes(view)
    fx, fy = vec.broadcast(view, layout.VIEW_FX), vec.broadcast(view, layout.VIEW_FY)
    log2_alpha_min, near = vec.broadcast(view, layout.VIEW_LOG2_ALPHA_MIN), vec.broadcast(view, layout.VIEW_NEAR)
    pixel_scale = vec.broadcast(view, layout.VIEW_PIXEL_SCALE)
    width, height = vec.broadcast(view, layout.VIEW_WIDTH), vec.broadcast(view, layout.VIEW_HEIGHT)
    right_edge, bottom_edge = vec.sub(width, 0.5), vec.sub(height, 0.5)
    half_size = vec.mul(0.5, vec.larger(width, height))
    for group in range(first, last):
        row = layout.GROUP * group
        mean, scale = vec.load_columns(surfels.means, 3 * row, three), vec.load_columns(surfels.scales, 2 * row, (0, 0))
        quat, opacity = vec.load_columns(surfels.quats, 4 * row, (0, 0, 0, 0)), vec.load(surfels.opacities, row)
        color = vec.load_columns(surfels.colors, 3 * row, three)
        squared_norm = vec.dot(quat, quat, 0.0)
        all_scales = (scale[0], scale[1], scale[1])
        usable = usable and vec.bits(are_usable(mean, squared_norm, all_scales, opacity, color)) == 0xFFFF
        at = place_surfels(mean, quat, view)

        slope_x, slope_y = vec.mul(at.x, at.inverse_z), vec.mul(at.y, at.inverse_z)
        wide_x = vec.fma(fx, slope_x, vec.broadcast(view, layout.VIEW_CX))
        wide_y = vec.fma(fy, slope_y, vec.broadcast(view, layout.VIEW_CY))
        mean_x, mean_y = vec.narrow(wide_x), vec.narrow(wide_y)
        remainder = vec.narrow((vec.sub(wide_x, mean_x), vec.sub(wide_y, mean_y)))
        vec.store_columns(projections.remainders, 2 * row, remainder)
        per_x, per_y = vec.div(at.z, vec.mul(fx, pixel_scale)), vec.div(at.z, vec.mul(fy, pixel_scale))
        u_x, u_y = _slopes(at.of_first, right, down, per_x, per_y, scale[0])
        v_x, v_y = _slopes(at.of_second, right, down, per_x, per_y, scale[1])
        q_x, q_y = vec.mul(per_x, vec.dot(right, at.of_z, 0.0)), vec.mul(per_y, vec.dot(down, at.of_z, 0.0))
        q_x, q_y = vec.narrow((q_x, q_y))
        normal = vec.select(vec.greater(at.height, 0.0), vec.neg(at.normal), at.normal)
        normal = vec.narrow((vec.dot(right, normal, 0.0), vec.dot(down, normal, 0.0), vec.dot(forward, normal, 0.0)))

        log2_opacity = vec.log2(opacity)
        reach = vec.sub(log2_opacity, log2_alpha_min)
        level = vec.fma(_RIM_SLACK, layout.U_FACTOR_SQUARED, vec.larger(reach, 0.0))
        deviations = vec.mul(vec.sqrt(vec.mul(level, 1.0 / layout.U_FACTOR_SQUARED)), scale)
        # The rim, about the centre: pixels moved along x and y for a step along the two axes, and the change of depth.
        image_x, image_y = vec.fma(vec.neg(slope_x), forward, right), vec.fma(vec.neg(slope_y), forward, down)
        scale_x, scale_y = vec.mul(fx, at.inverse_z), vec.mul(fy, at.inverse_z)
        rim_x = vec.mul(scale_x, (vec.dot(image_x, at.first, 0.0), vec.dot(image_x, at.second, 0.0)))
        rim_y = vec.mul(scale_y, (vec.dot(image_y, at.first, 0.0), vec.dot(image_y, at.second, 0.0)))
        rim_x, rim_y = vec.mul(vec.narrow(rim_x), deviations), vec.mul(vec.narrow(rim_y), deviations)
        rise = vec.mul(vec.narrow((vec.dot(forward, at.first, 0.0), vec.dot(forward, at.second, 0.0))), deviations)
        z = vec.narrow(at.z)
        crosses, shift_x, shift_y, rim_x, rim_y = _bent(rim_x, rim_y, rise, z, near)
        center_x, center_y = vec.sub(mean_x, shift_x), vec.sub(mean_y, shift_y)
        sharp_xx, sharp_yy = vec.dot(rim_x, rim_x, 0.0), vec.dot(rim_y, rim_y, 0.0)
        xx, xy, yy = vec.add(sharp_xx, _ELLIPSE_SLACK), vec.dot(rim_x, rim_y, 0.0), vec.add(sharp_yy, _ELLIPSE_SLACK)
        across = vec.fma(rim_x[0], rim_y[1], vec.neg(vec.mul(rim_x[1], rim_y[0])))
        padding = vec.mul(_ELLIPSE_SLACK, vec.add(vec.add(sharp_xx, sharp_yy), _ELLIPSE_SLACK))
        determinant = vec.fma(across, across, padding)
        slope_upright, slope_level = vec.div(xy, xx), vec.div(xy, yy)
        u_xx, u_yy = vec.sqrt(vec.div(level, xx)), vec.sqrt(vec.mul(level, vec.div(xx, determinant)))
        u_yx = vec.neg(vec.mul(u_yy, slope_upright))

        left, end = vec.sub(0.5, center_x), vec.sub(right_edge, center_x)
        top, bottom = vec.sub(0.5, center_y), vec.sub(bottom_edge, center_y)
        in_ellipse = squared_distance_to_box(u_xx, u_yx, u_yy, slope_upright, slope_level, left, end, top, bottom)
        out_x = vec.sub(vec.smaller(vec.larger(mean_x, 0.5), right_edge), mean_x)
        out_y = vec.sub(vec.smaller(vec.larger(mean_y, 0.5), bottom_edge), mean_y)
        outwards = vec.mul(pixel_scale, (out_x, out_y))
        in_circle = vec.dot(outwards, outwards, 0.0)
        shown = vec.either(crosses, vec.at_most(vec.smaller(in_ellipse, in_circle), level))
        shown = vec.both(vec.both(shown, at.in_front), vec.at_least(reach, 0.0))
        shown = vec.both(shown, vec.greater(vec.smaller(scale[0], scale[1]), 0.0))
        shown = vec.both(shown, vec.either(vec.less(at.height, 0.0), vec.greater(at.height, 0.0)))

        half_x, half_y, radius = vec.sqrt(xx), vec.sqrt(yy), vec.div(vec.sqrt(level), pixel_scale)
        left = vec.smaller(vec.sub(center_x, half_x), vec.sub(mean_x, radius))
        end = vec.larger(vec.add(center_x, half_x), vec.add(mean_x, radius))
        top = vec.smaller(vec.sub(center_y, half_y), vec.sub(mean_y, radius))
        bottom = vec.larger(vec.add(center_y, half_y), vec.add(mean_y, radius))
        half = vec.select(crosses, half_size, vec.mul(0.5, vec.larger(vec.sub(end, left), vec.sub(bottom, top))))
        vec.store(radii, row, vec.select(shown, vec.ceil(half), 0.0))
        left, end = vec.select(crosses, 0.0, left), vec.select(crosses, right_edge, end)
        top, bottom = vec.select(crosses, 0.0, top), vec.select(crosses, bottom_edge, bottom)
        columns = (tile_at(left, right_edge), tile_at(end, right_edge))
        rows = (tile_at(top, bottom_edge), tile_at(bottom, bottom_edge))
        # Most discs that cross the near plane are beside the camera: drawn, but in no tile.
        slopes, largest_q = (u_x, u_y, v_x, v_y, q_x, q_y), vec.smaller(vec.div(z, near), layout.LARGE)
        size_x, size_y = vec.mul(0.5, vec.sub(right_edge, 0.5)), vec.mul(0.5, vec.sub(bottom_edge, 0.5))
        middle = vec.mul(pixel_scale, (vec.sub(vec.add(size_x, 0.5), mean_x), vec.sub(vec.add(size_y, 0.5), mean_y)))
        size_x, size_y = vec.mul(pixel_scale, (size_x, size_y))
        is_seen = may_show(slopes, vec.sqrt(level), largest_q, middle[0], middle[1], size_x, size_y)
        absent = vec.select(vec.either(is_seen, vec.at_most(in_circle, level)), 0.0, vec.select(crosses, 1.0, 0.0))
        columns = vec.select(vec.greater(absent, 0.0), (0.0, -1.0), columns)
        more, more_tiles = store_extents(group, shown, columns, rows, projections)
        drawn, tiles = drawn + more, tiles + more_tiles

        vec.store_columns(means2d, 2 * row, (mean_x, mean_y))
        vec.store(projections.depths, row, z)
        u_xx, u_yy = vec.select(crosses, (0.0, largest_q), (u_xx, u_yy))
        outline = (u_xx, u_yx, u_yy, center_x, center_y, log2_opacity, mean_x, mean_y)
        outline = outline + slopes + (slope_upright, slope_level)
        vec.store_columns(projections.outlines, layout.ROW * row, outline)
        record = slopes + (mean_x, mean_y, log2_opacity, z) + color + normal
        vec.store_columns(projections.records, layout.ROW * row, record)
    return (drawn if usable else -1), tiles


@inline
def _slopes(function, right, down, per_x, per_y, scale):
    """U or V of a surfel's record, finite, from a function of the ray that gives a coordinate over z."""
    per_deviation = vec.div(layout.U_FACTOR, scale)
    x = vec.narrow(vec.mul(vec.mul(per_x, vec.dot(right, function, 0.0)), per_deviation))
    y = vec.narrow(vec.mul(vec.mul(per_y, vec.dot(down, function, 0.0)), per_deviation))
    return vec.larger(vec.smaller((x, y), _LARGEST_SLOPE), -_LARGEST_SLOPE)


@inline
def _bent(rim_x, rim_y, rise, z, near):
    """Image of a rim at depth z + rise under perspective.

    Returns whether it crosses the near plane, so that its image may be no ellipse; the shift of the ellipse's centre; and two
    vectors of pixels whose products are the ellipse's matrix, as those of ``rim_x`` and ``rim_y`` are without perspective.
    """
    spread = vec.sqrt(vec.dot(rise, rise, 0.0))
    crosses = vec.at_most(vec.sub(z, spread), near)
    span = vec.select(crosses, 1.0, vec.mul(vec.sub(z, spread), vec.add(z, spread)))
    root = vec.sqrt(span)
    shift_x = vec.mul(z, vec.div(vec.dot(rim_x, rise, 0.0), span))
    shift_y = vec.mul(z, vec.div(vec.dot(rim_y, rise, 0.0), span))
    bend, shrink = vec.div(rise, vec.add(z, root)), vec.div(z, root)
    bent_x, bent_y = vec.fma(shrink, rim_x, vec.mul(shift_x, bend)), vec.fma(shrink, rim_y, vec.mul(shift_y, bend))
    return crosses, shift_x, shift_y, bent_x, bent_y


project, project_surfels = projecting(_project_gaussians), projecting(_project_surfels)
