"""Projection of surfels to records, and to outlines for binning: sixteen at a time.

The formulas are those of ``docs/rendering.md``, section "Surfels".
"""

from __future__ import annotations

from coliags_plugin.core.numba_compilation import inline, kernel, part
from coliags_plugin.renderers.numba_kernels import layout, surfel_layout
from coliags_plugin.renderers.numba_kernels.geometry import camera_axes, squared_distance_to_box
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
    either,
    fma,
    greater,
    lane,
    lane_sums,
    larger,
    less,
    load,
    load_columns,
    log2,
    mul,
    narrow,
    neg,
    select,
    smaller,
    sqrt,
    store,
    store_columns,
    sub,
)
from coliags_plugin.renderers.numba_kernels.projection import are_usable, tile_at
from coliags_plugin.renderers.numba_kernels.surfel_geometry import may_show, place_surfels
from coliags_plugin.renderers.numba_kernels.threads import take

#: Added to the squared distance to the rim, in standard deviations, and to the squared half-axes of its image, square
#: pixels: more than rounding, which is how discs seen edge-on stay ellipses.
_RIM_SLACK = 1e-2
_ELLIPSE_SLACK = 1e-4
#: Largest U and V. Discs so small that they reach it fall between all pixels.
_LARGEST_SLOPE = 1e10


@kernel
def project_surfels(counters, count, surfels, tail, view, projections, outlines, remainders, means2d, radii):
    """Project all surfels and compute their extents.

    Args:
        counters: Work counters for dynamic scheduling; entry 0 must be 0.
        count: Number of surfels.
        surfels: The surfels. [layout.Parameters]
        tail: Those behind the last full group, filled up with ones that are not drawn. [layout.Parameters]
        view: See ``layout``.
        projections: Out; its records as ``surfel_layout`` describes them.
        outlines: Out: likewise, padded to whole groups. [16 for each surfel]
        remainders: Out: what float32 leaves of the projected centres, pixels, padded to whole groups. [2 for each surfel]
        means2d: Out: projected centres, pixels, padded to whole groups. [2 for each surfel]
        radii: Out: pixels, 0 where not drawn, padded to whole groups. [1 for each surfel]
    """
    whole_groups = count // layout.GROUP
    per_parcel = layout.PARCEL // layout.GROUP
    while True:
        parcel = take(counters, 0, 1)
        if parcel * layout.PARCEL >= count:
            break
        first = parcel * per_parcel
        last = min(first + per_parcel, whole_groups)
        drawn, tiles = _project_groups(
            first, last, first, surfels, view, projections, outlines, remainders, means2d, radii
        )
        if last * layout.GROUP < min((parcel + 1) * layout.PARCEL, count):
            more, more_tiles = _project_groups(
                last, last + 1, 0, tail, view, projections, outlines, remainders, means2d, radii
            )
            drawn = -1 if drawn < 0 or more < 0 else drawn + more
            tiles += more_tiles
        projections.parcels[2 * parcel] = drawn
        projections.parcels[2 * parcel + 1] = tiles


@part
def _project_groups(first, last, source, surfels, view, projections, outlines, remainders, means2d, radii):
    """Project groups ``first`` to ``last``, reading from group ``source`` of the surfels on.

    Returns:
        The number of surfels drawn, -1 where one is invalid; and the number of tiles within their bounds.
    """
    drawn, tiles, usable = 0, 0, True
    three = (0, 0, 0)
    right, down, forward = camera_axes(view)
    fx, fy = broadcast(view, layout.VIEW_FX), broadcast(view, layout.VIEW_FY)
    log2_alpha_min, near = broadcast(view, layout.VIEW_LOG2_ALPHA_MIN), broadcast(view, layout.VIEW_NEAR)
    pixel_scale = broadcast(view, layout.VIEW_PIXEL_SCALE)
    right_edge = sub(broadcast(view, layout.VIEW_WIDTH), 0.5)
    bottom_edge = sub(broadcast(view, layout.VIEW_HEIGHT), 0.5)
    half_size = mul(0.5, larger(broadcast(view, layout.VIEW_WIDTH), broadcast(view, layout.VIEW_HEIGHT)))
    for group in range(first, last):
        row = layout.GROUP * (group - first + source)
        mean, scale = load_columns(surfels.means, 3 * row, three), load_columns(surfels.scales, 2 * row, (0, 0))
        quat, color = load_columns(surfels.quats, 4 * row, (0, 0, 0, 0)), load_columns(surfels.colors, 3 * row, three)
        opacity = load(surfels.opacities, row)
        squared_norm = dot(quat, quat, 0.0)
        all_scales = (scale[0], scale[1], scale[1])
        usable = usable and bits(are_usable(mean, squared_norm, all_scales, opacity, color)) == 0xFFFF
        at = place_surfels(mean, quat, view)

        slope_x, slope_y = mul(at.x, at.inverse_z), mul(at.y, at.inverse_z)
        wide_x = fma(fx, slope_x, broadcast(view, layout.VIEW_CX))
        wide_y = fma(fy, slope_y, broadcast(view, layout.VIEW_CY))
        mean_x, mean_y = narrow(wide_x), narrow(wide_y)
        remainder = narrow((sub(wide_x, mean_x), sub(wide_y, mean_y)))
        store_columns(remainders, 2 * layout.GROUP * group, remainder)
        per_x, per_y = div(at.z, mul(fx, pixel_scale)), div(at.z, mul(fy, pixel_scale))
        u_x, u_y = _slopes(at.of_first, right, down, per_x, per_y, scale[0])
        v_x, v_y = _slopes(at.of_second, right, down, per_x, per_y, scale[1])
        q_x, q_y = narrow(mul(per_x, dot(right, at.of_z, 0.0))), narrow(mul(per_y, dot(down, at.of_z, 0.0)))
        normal = select(greater(at.height, 0.0), neg(at.normal), at.normal)
        normal = narrow((dot(right, normal, 0.0), dot(down, normal, 0.0), dot(forward, normal, 0.0)))

        log2_opacity = log2(opacity)
        reach = sub(log2_opacity, log2_alpha_min)
        level = fma(_RIM_SLACK, layout.U_FACTOR_SQUARED, larger(reach, 0.0))
        deviations = mul(sqrt(mul(level, 1.0 / layout.U_FACTOR_SQUARED)), scale)
        # The rim, about the centre: pixels moved along x and y for a step along the two axes, and the change of depth.
        image_x, image_y = fma(neg(slope_x), forward, right), fma(neg(slope_y), forward, down)
        scale_x, scale_y = mul(fx, at.inverse_z), mul(fy, at.inverse_z)
        rim_x = mul(narrow(mul(scale_x, (dot(image_x, at.first, 0.0), dot(image_x, at.second, 0.0)))), deviations)
        rim_y = mul(narrow(mul(scale_y, (dot(image_y, at.first, 0.0), dot(image_y, at.second, 0.0)))), deviations)
        rise = mul(narrow((dot(forward, at.first, 0.0), dot(forward, at.second, 0.0))), deviations)
        z = narrow(at.z)
        crosses, shift_x, shift_y, rim_x, rim_y = _bent(rim_x, rim_y, rise, z, near)
        center_x, center_y = sub(mean_x, shift_x), sub(mean_y, shift_y)
        sharp_xx, sharp_yy = dot(rim_x, rim_x, 0.0), dot(rim_y, rim_y, 0.0)
        xx, xy, yy = add(sharp_xx, _ELLIPSE_SLACK), dot(rim_x, rim_y, 0.0), add(sharp_yy, _ELLIPSE_SLACK)
        across = fma(rim_x[0], rim_y[1], neg(mul(rim_x[1], rim_y[0])))
        padding = mul(_ELLIPSE_SLACK, add(add(sharp_xx, sharp_yy), _ELLIPSE_SLACK))
        determinant = fma(across, across, padding)
        slope_upright, slope_level = div(xy, xx), div(xy, yy)
        u_xx, u_yy = sqrt(div(level, xx)), sqrt(mul(level, div(xx, determinant)))
        u_yx = neg(mul(u_yy, slope_upright))

        left, end = sub(0.5, center_x), sub(right_edge, center_x)
        top, bottom = sub(0.5, center_y), sub(bottom_edge, center_y)
        in_ellipse = squared_distance_to_box(u_xx, u_yx, u_yy, slope_upright, slope_level, left, end, top, bottom)
        out_x = sub(smaller(larger(mean_x, 0.5), right_edge), mean_x)
        out_y = sub(smaller(larger(mean_y, 0.5), bottom_edge), mean_y)
        outwards = mul(pixel_scale, (out_x, out_y))
        in_circle = dot(outwards, outwards, 0.0)
        shown = either(crosses, at_most(smaller(in_ellipse, in_circle), level))
        shown = both(both(shown, at.in_front), both(at_least(reach, 0.0), greater(smaller(scale[0], scale[1]), 0.0)))
        shown = both(shown, either(less(at.height, 0.0), greater(at.height, 0.0)))

        half_x, half_y, radius = sqrt(xx), sqrt(yy), div(sqrt(level), pixel_scale)
        left = smaller(sub(center_x, half_x), sub(mean_x, radius))
        end = larger(add(center_x, half_x), add(mean_x, radius))
        top = smaller(sub(center_y, half_y), sub(mean_y, radius))
        bottom = larger(add(center_y, half_y), add(mean_y, radius))
        half = select(crosses, half_size, mul(0.5, larger(sub(end, left), sub(bottom, top))))
        store(radii, layout.GROUP * group, select(shown, ceil(half), 0.0))
        left, end = select(crosses, 0.0, left), select(crosses, right_edge, end)
        top, bottom = select(crosses, 0.0, top), select(crosses, bottom_edge, bottom)
        column_first, column_last = tile_at(left, right_edge), tile_at(end, right_edge)
        row_first, row_last = tile_at(top, bottom_edge), tile_at(bottom, bottom_edge)
        # Most discs that cross the near plane are beside the camera: drawn, but in no tile.
        slopes, largest_q = (u_x, u_y, v_x, v_y, q_x, q_y), smaller(div(z, near), surfel_layout.LARGE)
        size_x, size_y = mul(0.5, sub(right_edge, 0.5)), mul(0.5, sub(bottom_edge, 0.5))
        middle = mul(pixel_scale, (sub(add(size_x, 0.5), mean_x), sub(add(size_y, 0.5), mean_y)))
        size_x, size_y = mul(pixel_scale, (size_x, size_y))
        seen = may_show(slopes, sqrt(level), largest_q, middle[0], middle[1], size_x, size_y)
        absent = select(either(seen, at_most(in_circle, level)), 0.0, select(crosses, 1.0, 0.0))
        column_first, column_last = select(greater(absent, 0.0), (0.0, -1.0), (column_first, column_last))
        store_columns(projections.bounds, 4 * layout.GROUP * group, (column_first, column_last, row_first, row_last))
        area = mul(add(sub(column_last, column_first), 1.0), add(sub(row_last, row_first), 1.0))
        tiles += int(lane(lane_sums((select(shown, area, 0.0),)), 0))
        flags = bits(shown)
        drawn += bit_count(flags)
        projections.drawn[group] = flags

        store_columns(means2d, 2 * layout.GROUP * group, (mean_x, mean_y))
        store(projections.depths, layout.GROUP * group, z)
        u_xx, u_yy = select(crosses, (0.0, largest_q), (u_xx, u_yy))
        outline = (u_xx, u_yx, u_yy, center_x, center_y, log2_opacity, mean_x, mean_y)
        outline = outline + slopes + (slope_upright, slope_level)
        store_columns(outlines, layout.ROW * layout.GROUP * group, outline)
        record = slopes + (mean_x, mean_y, log2_opacity, z) + color + normal
        store_columns(projections.records, layout.ROW * layout.GROUP * group, record)
    return (drawn if usable else -1), tiles


@inline
def _slopes(function, right, down, per_x, per_y, scale):
    """U or V of ``surfel_layout``, finite, from a function of the ray that gives a coordinate over z."""
    per_deviation = div(layout.U_FACTOR, scale)
    x = narrow(mul(mul(per_x, dot(right, function, 0.0)), per_deviation))
    y = narrow(mul(mul(per_y, dot(down, function, 0.0)), per_deviation))
    return larger(smaller((x, y), _LARGEST_SLOPE), -_LARGEST_SLOPE)


@inline
def _bent(rim_x, rim_y, rise, z, near):
    """What perspective makes of the image of a rim at depth z + rise.

    Returns:
        Whether it crosses the near plane, so that its image may be no ellipse; the shift of the ellipse's centre; and
        two vectors of pixels whose products are the ellipse's matrix, as those of ``rim_x`` and ``rim_y`` are without
        perspective.
    """
    spread = sqrt(dot(rise, rise, 0.0))
    crosses = at_most(sub(z, spread), near)
    span = select(crosses, 1.0, mul(sub(z, spread), add(z, spread)))
    root = sqrt(span)
    shift_x, shift_y = mul(z, div(dot(rim_x, rise, 0.0), span)), mul(z, div(dot(rim_y, rise, 0.0), span))
    bend, shrink = div(rise, add(z, root)), div(z, root)
    bent_x, bent_y = fma(shrink, rim_x, mul(shift_x, bend)), fma(shrink, rim_y, mul(shift_y, bend))
    return crosses, shift_x, shift_y, bent_x, bent_y
