"""Backward pass of the projection: gradients of Gaussians and camera pose from sums over entries.

``gather`` adds up the entries of each Gaussian, tile by tile, and finds the derivative with respect to means2d;
``project_backward`` takes it from there through the formulas of ``docs/rendering.md``, section "Projection".

Of surfels, with P = p + u a + v b the intersection of a ray with the disc's plane, (A, B, N) the functions of a ray in
``geometry.Placed`` and (g_u, g_v, g_z) the derivatives with respect to u, v and z,

    dL/dP = -(g_u A / s_u + g_v B / s_v - (g_u u + g_v v + g_z z) N)

so the sums of ``layout``, of these three factors times 1, u and v, suffice for p, a and b.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from coliags_plugin.core.numba_kernels import lanes as vec
from coliags_plugin.core.numba_kernels.compilation import inline, kernel, part
from coliags_plugin.core.numba_kernels.threads import pieces
from coliags_plugin.renderers.numba_kernels import layout
from coliags_plugin.renderers.numba_kernels.geometry import (
    camera_axes,
    place_surfels,
    project_axes,
    shortest_axes,
    shortest_column,
)

#: Turn products of one, two (or four) factors of the scaled U into those of the plain one.
_PLAIN = 1.0 / layout.U_FACTOR
_PLAIN_SQUARE = 1.0 / layout.U_FACTOR_SQUARED
_PLAIN_FOURTH = _PLAIN_SQUARE * _PLAIN_SQUARE
#: Prefetch distance, Gaussians.
_AHEAD = 16


def gathering(of_center: Callable[..., tuple[float, float]]) -> Callable[..., None]:
    """Compile the kernel that adds up the sums of each Gaussian's entries, 0 where it is not drawn.

    It writes ``gaussian_sums`` and the derivative with respect to the projected centres.
    ``of_center`` gives the derivative with respect to the projected centre from the sums; ``seventeen`` says whether there
    is a seventeenth sum.
    """

    @kernel
    def gather(counters, projections, bins, view, seventeen, entry_sums, gaussian_sums, of_means2d):
        groups, count, stretches = len(projections.drawn), len(bins.nearest_first), len(bins.stretch_entries) - 1
        records, further = projections.records, layout.ROW * layout.GROUP * groups
        entries_further = layout.ROW * bins.starts[-1]
        for group in pieces(counters, 0, groups):
            flags = projections.drawn[group] ^ 0xFFFF
            while flags:
                index = layout.GROUP * group + vec.lowest_bit(flags)
                flags &= flags - 1
                vec.store(gaussian_sums, layout.ROW * index, 0.0)
                of_means2d[2 * index] = 0.0
                of_means2d[2 * index + 1] = 0.0
                if seventeen:
                    gaussian_sums[further + index] = 0.0
        for stretch in pieces(counters, 1, stretches):
            first, last = count * stretch // stretches, count * (stretch + 1) // stretches
            entry = bins.stretch_entries[stretch]
            for place in range(first, last):
                ahead = bins.nearest_first[min(place + _AHEAD, last - 1)]
                vec.prefetch(records, layout.ROW * ahead)
                vec.prefetch(gaussian_sums, layout.ROW * ahead)
                vec.prefetch(of_means2d, 2 * ahead)
                index = bins.nearest_first[place]
                total, last_total = vec.splat(0.0), np.float32(0.0)
                for _ in range(bins.entry_counts[place]):
                    total = vec.add(total, vec.load(entry_sums, layout.ROW * entry))
                    if seventeen:
                        last_total += vec.number(entry_sums, entries_further + entry)
                    entry += 1
                vec.store(gaussian_sums, layout.ROW * index, total)
                if seventeen:
                    gaussian_sums[further + index] = last_total
                of_means2d[2 * index], of_means2d[2 * index + 1] = of_center(total, records, layout.ROW * index, view)

    return gather


def projecting_backward(project_groups: Callable[..., tuple]) -> Callable[..., None]:
    """Compile the kernel of the derivatives of the loss with respect to Gaussians and pose, from each Gaussian's sums.

    ``channels`` is the number of channels composited; ``of_pose`` gets the derivatives with respect to the camera's three
    axes and its centre in the world, one row for each parcel.

    ``project_groups`` is the backward pass of groups ``first`` to ``last``, and returns the derivatives with respect to
    the camera's axes and centre.
    """

    @kernel
    def project_backward(
        counters, gaussians, view, channels, projections, gaussian_sums, of_means2d, of_gaussians, of_pose
    ):
        groups, per_parcel = len(projections.drawn), layout.PARCEL // layout.GROUP
        for parcel in pieces(counters, 0, len(projections.parcels) // 2):
            first, last = parcel * per_parcel, min((parcel + 1) * per_parcel, groups)
            pose = project_groups(
                first, last, gaussians, view, channels, projections, gaussian_sums, of_means2d, of_gaussians
            )
            vec.store(of_pose, layout.ROW * parcel, vec.lane_sums(pose))

    return project_backward


# --- 3D Gaussians -----------------------------------------------------------------------------------------------------


@inline
def _of_gaussian_center(total, records, row, view):
    """Derivative with respect to the projected centre of a 3D Gaussian."""
    square = np.float32(_PLAIN_SQUARE)
    e, f = vec.lane(total, layout.SUM_E), vec.lane(total, layout.SUM_F)
    of_x = vec.number(records, row + layout.U_XX) * e + vec.number(records, row + layout.U_YX) * f
    return square * of_x, square * (vec.number(records, row + layout.U_YY) * f)


@part
def _project_gaussians_backward(
    first, last, gaussians, view, channels, projections, gaussian_sums, given_means2d, of_gaussians
):
    """Groups of 3D Gaussians: see :func:`projecting_backward`."""
    three = (0, 0, 0)
    right, down, forward = camera_axes(view)
    fx, fy = vec.broadcast(view, layout.VIEW_FX), vec.broadcast(view, layout.VIEW_FY)
    nothing = vec.repeat(0.0, three)
    of_right, of_down, of_forward, of_center = nothing, nothing, nothing, nothing
    for group in range(first, last):
        shown = vec.from_bits(projections.drawn[group])
        row = layout.GROUP * group
        mean = vec.load_columns(gaussians.means, 3 * row, three)
        scale = vec.load_columns(gaussians.scales, 3 * row, three)
        quat, opacity = vec.load_columns(gaussians.quats, 4 * row, (0, 0, 0, 0)), vec.load(gaussians.opacities, row)
        at = project_axes(mean, quat, view)
        sums = vec.load_columns(gaussian_sums, layout.ROW * row, (0,) * 16)
        by_x, by_y = vec.load_columns(given_means2d, 2 * row, (0, 0))

        row_x, row_y = vec.mul(at.local_x, scale), vec.mul(at.local_y, scale)
        record = vec.load_columns(projections.records, layout.ROW * row, (0,) * 16)
        by_xx, by_xy, by_yy = _covariance_derivative(record, sums)
        of_row_x = vec.fma(by_xx, row_x, vec.mul(by_xy, row_y))
        of_row_y = vec.fma(by_xy, row_x, vec.mul(by_yy, row_y))
        of_scale = vec.fma(of_row_x, at.local_x, vec.mul(of_row_y, at.local_y))
        of_local_x, of_local_y = vec.mul(of_row_x, scale), vec.mul(of_row_y, scale)

        # local = R^T image: image gets R local, and R gets image local^T, row by row.
        a, b, c = at.rotation
        of_image_x = (vec.dot(a, of_local_x, 0.0), vec.dot(b, of_local_x, 0.0), vec.dot(c, of_local_x, 0.0))
        of_image_y = (vec.dot(a, of_local_y, 0.0), vec.dot(b, of_local_y, 0.0), vec.dot(c, of_local_y, 0.0))
        of_a = vec.fma(at.image_x[0], of_local_x, vec.mul(at.image_y[0], of_local_y))
        of_b = vec.fma(at.image_x[1], of_local_x, vec.mul(at.image_y[1], of_local_y))
        of_c = vec.fma(at.image_x[2], of_local_x, vec.mul(at.image_y[2], of_local_y))

        # image_x = fx / z (right - slope_x forward), where slope_x follows x / z unless it is clamped.
        to_right = vec.mul(vec.mul(fx, at.inverse_z), of_image_x)
        to_down = vec.mul(vec.mul(fy, at.inverse_z), of_image_y)
        to_forward = vec.neg(vec.fma(at.slope_x, to_right, vec.mul(at.slope_y, to_down)))
        of_slope_x = vec.select(at.follows_x, vec.neg(vec.dot(forward, to_right, 0.0)), 0.0)
        of_slope_y = vec.select(at.follows_y, vec.neg(vec.dot(forward, to_down, 0.0)), 0.0)
        of_x = vec.mul(vec.fma(fx, by_x, of_slope_x), at.inverse_z)
        of_y = vec.mul(vec.fma(fy, by_y, of_slope_y), at.inverse_z)
        lost = vec.fma(of_x, at.x, vec.mul(of_y, at.y))
        lost = vec.dot(at.image_x, of_image_x, vec.dot(at.image_y, of_image_y, lost))
        of_depth = sums[layout.SUM_CHANNELS + 3] if channels > 3 else vec.splat(0.0)
        of_inverse_depth = sums[layout.SUM_CHANNELS + 4] if channels > 4 else vec.splat(0.0)
        lost = vec.fma(of_inverse_depth, at.inverse_z, lost)
        of_z = vec.sub(of_depth, vec.mul(lost, at.inverse_z))

        if channels > 5:
            # The normal is a column of R, turned by its sign, in camera axes.
            second, third = shortest_axes(scale)
            axis = shortest_column(at.rotation, second, third)
            of_normal = (sums[layout.SUM_CHANNELS + 5], sums[layout.SUM_CHANNELS + 6], sums[layout.SUM_CHANNELS + 7])
            of_normal = vec.mul(vec.select(vec.greater(vec.dot(axis, at.offset, 0.0), 0.0), -1.0, 1.0), of_normal)
            of_axis = vec.fma(of_normal[0], right, vec.fma(of_normal[1], down, vec.mul(of_normal[2], forward)))
            chosen = vec.select(third, (0.0, 0.0, 1.0), vec.select(second, (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)))
            of_a, of_b = vec.fma(of_axis[0], chosen, of_a), vec.fma(of_axis[1], chosen, of_b)
            of_c = vec.fma(of_axis[2], chosen, of_c)
            to_right, to_down = vec.fma(of_normal[0], axis, to_right), vec.fma(of_normal[1], axis, to_down)
            to_forward = vec.fma(of_normal[2], axis, to_forward)

        of_mean = vec.select(shown, vec.fma(of_x, right, vec.fma(of_y, down, vec.mul(of_z, forward))), nothing)
        of_center = vec.sub(of_center, of_mean)
        of_right = vec.add(of_right, vec.select(shown, vec.fma(of_x, at.offset, to_right), nothing))
        of_down = vec.add(of_down, vec.select(shown, vec.fma(of_y, at.offset, to_down), nothing))
        of_forward = vec.add(of_forward, vec.select(shown, vec.fma(of_z, at.offset, to_forward), nothing))

        of_quat = _quaternion_derivative(at, of_a, of_b, of_c)
        of_color = (sums[layout.SUM_CHANNELS], sums[layout.SUM_CHANNELS + 1], sums[layout.SUM_CHANNELS + 2])
        vec.store_columns(of_gaussians.means, 3 * row, of_mean)
        vec.store_columns(of_gaussians.quats, 4 * row, vec.select(shown, of_quat, vec.repeat(0.0, (0, 0, 0, 0))))
        vec.store_columns(of_gaussians.scales, 3 * row, vec.select(shown, of_scale, nothing))
        vec.store(of_gaussians.opacities, row, vec.select(shown, vec.div(sums[layout.SUM_V], opacity), 0.0))
        vec.store_columns(of_gaussians.colors, 3 * row, vec.select(shown, of_color, nothing))
    return of_right + of_down + of_forward + of_center


@inline
def _covariance_derivative(record, sums):
    """Twice the derivative with respect to the 2D covariance: xx, xy (one of the two), yy.

    It is U^T S U / 2 with S the sums of v w w^T and w = U d. Unlike the way through the derivative of U nothing cancels.
    """
    u_xx, u_yx, u_yy = record[layout.U_XX], record[layout.U_YX], record[layout.U_YY]
    sum_ee, sum_ef, sum_ff = sums[layout.SUM_EE], sums[layout.SUM_EF], sums[layout.SUM_FF]
    right_e, right_f = vec.fma(sum_ee, u_xx, vec.mul(sum_ef, u_yx)), vec.fma(sum_ef, u_xx, vec.mul(sum_ff, u_yx))
    xx, yy = vec.fma(u_xx, right_e, vec.mul(u_yx, right_f)), vec.mul(u_yy, vec.mul(u_yy, sum_ff))
    return vec.mul(_PLAIN_FOURTH, (xx, vec.mul(u_yy, right_f), yy))


@inline
def _quaternion_derivative(at, a, b, c):
    """Derivative with respect to the quaternion given, w first, from that with respect to the rows of its rotation."""
    w, x, y, z = at.quaternion
    turn_x, turn_y, turn_z = vec.sub(c[1], b[2]), vec.sub(a[2], c[0]), vec.sub(b[0], a[1])
    xy, xz, yz = vec.add(a[1], b[0]), vec.add(a[2], c[0]), vec.add(b[2], c[1])
    less_x, less_y, less_z = vec.mul(-2.0, (vec.add(b[1], c[2]), vec.add(a[0], c[2]), vec.add(a[0], b[1])))
    of_unit = vec.mul(
        2.0,
        (
            vec.fma(x, turn_x, vec.fma(y, turn_y, vec.mul(z, turn_z))),
            vec.fma(w, turn_x, vec.fma(y, xy, vec.fma(z, xz, vec.mul(x, less_x)))),
            vec.fma(w, turn_y, vec.fma(x, xy, vec.fma(z, yz, vec.mul(y, less_y)))),
            vec.fma(w, turn_z, vec.fma(x, xz, vec.fma(y, yz, vec.mul(z, less_z)))),
        ),
    )
    # The length does not matter.
    along = vec.dot(of_unit, at.quaternion, 0.0)
    return vec.mul(at.inverse_norm, vec.fma(vec.neg(along), at.quaternion, of_unit))


# --- surfels ----------------------------------------------------------------------------------------------------------


@inline
def _of_surfel_center(total, records, row, view):
    """Derivative with respect to the projected centre of a surfel."""
    scale, square = vec.number(view, layout.VIEW_PIXEL_SCALE), np.float32(_PLAIN_SQUARE)
    e, f = square * vec.lane(total, layout.SUM_E), square * vec.lane(total, layout.SUM_F)
    c = vec.lane(total, layout.SUM_C)
    of_x = vec.number(records, row + layout.SURFEL_U_X) * e + vec.number(records, row + layout.SURFEL_V_X) * f
    of_y = vec.number(records, row + layout.SURFEL_U_Y) * e + vec.number(records, row + layout.SURFEL_V_Y) * f
    of_x, of_y = (
        of_x + vec.number(records, row + layout.SURFEL_Q_X) * c,
        of_y + vec.number(records, row + layout.SURFEL_Q_Y) * c,
    )
    return scale * of_x, scale * of_y


@part
def _project_surfels_backward(
    first, last, surfels, view, channels, projections, surfel_sums, given_means2d, of_surfels
):
    """Groups of surfels: see :func:`projecting_backward`."""
    drawn = projections.drawn
    three = (0, 0, 0)
    right, down, forward = camera_axes(view)
    fx, fy = vec.broadcast(view, layout.VIEW_FX), vec.broadcast(view, layout.VIEW_FY)
    filtered = vec.mul(_PLAIN_SQUARE, vec.broadcast(view, layout.VIEW_PIXEL_SCALE))
    nothing, channel = vec.repeat(0.0, three), layout.SURFEL_SUM_CHANNELS
    of_right, of_down, of_forward, of_center = nothing, nothing, nothing, nothing
    for group in range(first, last):
        shown = vec.from_bits(drawn[group])
        row = layout.GROUP * group
        mean, scale = vec.load_columns(surfels.means, 3 * row, three), vec.load_columns(surfels.scales, 2 * row, (0, 0))
        quat, opacity = vec.load_columns(surfels.quats, 4 * row, (0, 0, 0, 0)), vec.load(surfels.opacities, row)
        at = place_surfels(mean, quat, view)
        sums = vec.load_columns(surfel_sums, layout.ROW * row, (0,) * 16)
        by_x, by_y = vec.load_columns(given_means2d, 2 * row, (0, 0))

        # The filter's centre moves with the surfel, and is no part of the derivative with respect to means2d.
        by_x = vec.fma(filtered, sums[layout.SUM_DX], by_x)
        by_y = vec.fma(filtered, sums[layout.SUM_DY], by_y)
        of_x, of_y = vec.mul(vec.mul(fx, by_x), at.inverse_z), vec.mul(vec.mul(fy, by_y), at.inverse_z)
        lost = vec.fma(of_x, at.x, vec.mul(of_y, at.y))
        of_z = vec.mul(vec.sub(sums[layout.SUM_C], lost), at.inverse_z)

        ee, ef, ff = vec.mul(
            _PLAIN_SQUARE,
            vec.widen((sums[layout.SUM_EE], sums[layout.SUM_EF], sums[layout.SUM_FF])),
        )
        ce, cf = vec.mul(vec.mul(_PLAIN, vec.widen((sums[layout.SUM_CE], sums[layout.SUM_CF]))), scale)
        ratio = vec.div(vec.widen(scale[0]), scale[1])
        of_scale = vec.narrow((vec.div(ee, scale[0]), vec.div(ff, scale[1])))
        of_first = vec.fma(ee, at.of_first, vec.fma(vec.mul(ef, ratio), at.of_second, vec.mul(ce, at.of_z)))
        of_second = vec.fma(vec.div(ef, ratio), at.of_first, vec.fma(ff, at.of_second, vec.mul(cf, at.of_z)))
        of_normal = vec.mul(0.0, at.normal)
        if channels > 3:
            # In camera axes, turned by its sign.
            further = layout.ROW * layout.GROUP * len(drawn) + row  # the last sum is behind the rows of sixteen
            of_camera_normal = (sums[channel + 3], sums[channel + 4], vec.load(surfel_sums, further))
            of_camera_normal = vec.mul(vec.select(vec.greater(at.height, 0.0), -1.0, 1.0), of_camera_normal)
            of_normal = vec.fma(
                of_camera_normal[0],
                right,
                vec.fma(of_camera_normal[1], down, vec.mul(vec.widen(of_camera_normal[2]), forward)),
            )

        of_right = _turned(of_right, right, at, of_x, of_first, of_second, of_normal, shown)
        of_down = _turned(of_down, down, at, of_y, of_first, of_second, of_normal, shown)
        of_forward = _turned(of_forward, forward, at, of_z, of_first, of_second, of_normal, shown)
        of_mean = vec.narrow(vec.fma(of_x, right, vec.fma(of_y, down, vec.mul(of_z, forward))))
        of_mean = vec.select(shown, of_mean, nothing)
        of_center = vec.sub(of_center, of_mean)

        a = (of_first[0], of_second[0], of_normal[0])
        b = (of_first[1], of_second[1], of_normal[1])
        c = (of_first[2], of_second[2], of_normal[2])
        of_quat = vec.narrow(_quaternion_derivative(at, a, b, c))
        of_color = (sums[channel], sums[channel + 1], sums[channel + 2])
        vec.store_columns(of_surfels.means, 3 * row, of_mean)
        vec.store_columns(of_surfels.quats, 4 * row, vec.select(shown, of_quat, vec.repeat(0.0, (0, 0, 0, 0))))
        vec.store_columns(of_surfels.scales, 2 * row, vec.select(shown, of_scale, vec.repeat(0.0, (0, 0))))
        vec.store(of_surfels.opacities, row, vec.select(shown, vec.div(sums[layout.SUM_V], opacity), 0.0))
        vec.store_columns(of_surfels.colors, 3 * row, vec.select(shown, of_color, nothing))
    return of_right + of_down + of_forward + of_center


@inline
def _turned(total, axis, at, of_offset, of_first, of_second, of_normal, shown):
    """Derivative with respect to one of the camera's axes, added to ``total``.

    All depend on this axis by the products with it of offset and local axes, whose derivatives are ``of_offset`` and the
    products of the axis with those of the local axes.
    """
    change = vec.mul(of_offset, at.offset)
    change = vec.fma(vec.dot(axis, of_first, 0.0), at.first, change)
    change = vec.fma(vec.dot(axis, of_second, 0.0), at.second, change)
    change = vec.narrow(vec.fma(vec.dot(axis, of_normal, 0.0), at.normal, change))
    return vec.add(total, vec.select(shown, change, (0.0, 0.0, 0.0)))


gather, gather_surfels = gathering(_of_gaussian_center), gathering(_of_surfel_center)
project_backward = projecting_backward(_project_gaussians_backward)
project_surfels_backward = projecting_backward(_project_surfels_backward)
