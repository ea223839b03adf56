"""Backward pass of the projection of surfels: gradients of surfels and camera pose from sums over entries.

With P = p + u a + v b the intersection of a ray with the disc's plane, (A, B, N) the functions of a ray in
``surfel_geometry`` and (g_u, g_v, g_z) the derivatives with respect to u, v and z,

    dL/dP = -(g_u A / s_u + g_v B / s_v - (g_u u + g_v v + g_z z) N)

so the sums of ``surfel_layout``, of these three factors times 1, u and v, suffice for p, a and b.
"""

from __future__ import annotations

import numpy as np

from coliags_plugin.core.numba_kernels import lanes as vec
from coliags_plugin.core.numba_kernels.compilation import inline, kernel, part
from coliags_plugin.core.numba_kernels.threads import pieces
from coliags_plugin.renderers.numba_kernels import layout, surfel_layout
from coliags_plugin.renderers.numba_kernels.geometry import camera_axes
from coliags_plugin.renderers.numba_kernels.projection_backward import gathering, quaternion_derivative
from coliags_plugin.renderers.numba_kernels.surfel_geometry import place_surfels

#: Turns products of two of the scaled e and f into those of standard deviations; and of one.
_PLAIN_SQUARE = 1.0 / layout.U_FACTOR_SQUARED
_PLAIN = 1.0 / layout.U_FACTOR


@inline
def _of_center(total, records, row, view):
    """Derivative with respect to a projected centre."""
    scale, square = vec.number(view, layout.VIEW_PIXEL_SCALE), np.float32(_PLAIN_SQUARE)
    e, f = square * vec.lane(total, surfel_layout.SUM_E), square * vec.lane(total, surfel_layout.SUM_F)
    c = vec.lane(total, surfel_layout.SUM_C)
    of_x = vec.number(records, row + surfel_layout.U_X) * e + vec.number(records, row + surfel_layout.V_X) * f
    of_y = vec.number(records, row + surfel_layout.U_Y) * e + vec.number(records, row + surfel_layout.V_Y) * f
    of_x, of_y = (
        of_x + vec.number(records, row + surfel_layout.Q_X) * c,
        of_y + vec.number(records, row + surfel_layout.Q_Y) * c,
    )
    return scale * of_x, scale * of_y


_gather = gathering(_of_center, surfel_layout.ROW_CHANNELS)


@kernel
def gather_surfels(counters, projections, bins, view, channels, entry_sums, surfel_sums, of_means2d):
    """Write ``surfel_sums`` and the derivative with respect to the projected centres."""
    _gather(counters, projections, bins, view, channels, entry_sums, surfel_sums, of_means2d)


@kernel
def project_surfels_backward(
    counters, count, surfels, tail, view, channels, own, projections, surfel_sums, given_means2d, of_surfels, of_pose
):
    """Derivatives of the loss with respect to surfels and pose: as ``projection_backward.project_backward``."""
    whole_groups, drawn = count // layout.GROUP, projections.drawn
    per_parcel = layout.PARCEL // layout.GROUP
    for parcel in pieces(counters, 0, -(-count // layout.PARCEL)):
        first = parcel * per_parcel
        last = min(first + per_parcel, whole_groups)
        pose = _project_groups_backward(
            first, last, first, vec.repeat(0.0, (0,) * 12), surfels, view, channels, drawn, surfel_sums, given_means2d,
            of_surfels,
        )  # fmt: skip
        if last * layout.GROUP < min((parcel + 1) * layout.PARCEL, count):
            pose = _project_groups_backward(
                last, last + 1, 0, pose, tail, view, channels, drawn, surfel_sums, given_means2d, of_surfels
            )
        vec.store(of_pose, layout.ROW * parcel, vec.lane_sums(pose))


@part
def _project_groups_backward(
    first, last, source, pose, surfels, view, channels, drawn, surfel_sums, given_means2d, of_surfels
):
    """Groups ``first`` to ``last``, reading from group ``source`` of the surfels on. Returns ``pose``, added to."""
    three = (0, 0, 0)
    right, down, forward = camera_axes(view)
    fx, fy = vec.broadcast(view, layout.VIEW_FX), vec.broadcast(view, layout.VIEW_FY)
    filtered = vec.mul(_PLAIN_SQUARE, vec.broadcast(view, layout.VIEW_PIXEL_SCALE))
    of_right, of_down, of_forward, of_center = pose[0:3], pose[3:6], pose[6:9], pose[9:12]
    nothing, channel = vec.repeat(0.0, three), surfel_layout.SUM_CHANNELS
    for group in range(first, last):
        shown = vec.from_bits(drawn[group])
        row = layout.GROUP * (group - first + source)
        mean, scale = vec.load_columns(surfels.means, 3 * row, three), vec.load_columns(surfels.scales, 2 * row, (0, 0))
        quat, opacity = vec.load_columns(surfels.quats, 4 * row, (0, 0, 0, 0)), vec.load(surfels.opacities, row)
        at = place_surfels(mean, quat, view)
        row = layout.GROUP * group
        sums = vec.load_columns(surfel_sums, layout.ROW * row, (0,) * 16)
        by_x, by_y = vec.load_columns(given_means2d, 2 * row, (0, 0))

        # The filter's centre moves with the surfel, and is no part of the derivative with respect to means2d.
        by_x = vec.fma(filtered, sums[surfel_layout.SUM_DX], by_x)
        by_y = vec.fma(filtered, sums[surfel_layout.SUM_DY], by_y)
        of_x, of_y = vec.mul(vec.mul(fx, by_x), at.inverse_z), vec.mul(vec.mul(fy, by_y), at.inverse_z)
        lost = vec.fma(of_x, at.x, vec.mul(of_y, at.y))
        of_z = vec.mul(vec.sub(sums[surfel_layout.SUM_C], lost), at.inverse_z)

        ee, ef, ff = vec.mul(
            _PLAIN_SQUARE,
            vec.widen((sums[surfel_layout.SUM_EE], sums[surfel_layout.SUM_EF], sums[surfel_layout.SUM_FF])),
        )
        ce, cf = vec.mul(vec.mul(_PLAIN, vec.widen((sums[surfel_layout.SUM_CE], sums[surfel_layout.SUM_CF]))), scale)
        ratio = vec.div(vec.widen(scale[0]), scale[1])
        of_scale = vec.narrow((vec.div(ee, scale[0]), vec.div(ff, scale[1])))
        of_first = vec.fma(ee, at.of_first, vec.fma(vec.mul(ef, ratio), at.of_second, vec.mul(ce, at.of_z)))
        of_second = vec.fma(vec.div(ef, ratio), at.of_first, vec.fma(ff, at.of_second, vec.mul(cf, at.of_z)))
        of_normal = vec.mul(0.0, at.normal)
        if len(channels) > 3:
            # In camera axes, turned by its sign.
            further = layout.ROW * layout.GROUP * len(drawn) + row  # the last sum is behind the rows of sixteen
            given = (sums[channel + 3], sums[channel + 4], vec.load(surfel_sums, further))
            given = vec.mul(vec.select(vec.greater(at.height, 0.0), -1.0, 1.0), given)
            of_normal = vec.fma(given[0], right, vec.fma(given[1], down, vec.mul(vec.widen(given[2]), forward)))

        of_right = _turned(of_right, right, at, of_x, of_first, of_second, of_normal, shown)
        of_down = _turned(of_down, down, at, of_y, of_first, of_second, of_normal, shown)
        of_forward = _turned(of_forward, forward, at, of_z, of_first, of_second, of_normal, shown)
        of_mean = vec.narrow(vec.fma(of_x, right, vec.fma(of_y, down, vec.mul(of_z, forward))))
        of_mean = vec.select(shown, of_mean, nothing)
        of_center = vec.sub(of_center, of_mean)

        a = (of_first[0], of_second[0], of_normal[0])
        b = (of_first[1], of_second[1], of_normal[1])
        c = (of_first[2], of_second[2], of_normal[2])
        of_quat = vec.narrow(quaternion_derivative(at, a, b, c))
        of_color = (sums[channel], sums[channel + 1], sums[channel + 2])
        vec.store_columns(of_surfels.means, 3 * row, of_mean)
        vec.store_columns(of_surfels.quats, 4 * row, vec.select(shown, of_quat, vec.repeat(0.0, (0, 0, 0, 0))))
        vec.store_columns(of_surfels.scales, 2 * row, vec.select(shown, of_scale, vec.repeat(0.0, (0, 0))))
        vec.store(of_surfels.opacities, row, vec.select(shown, vec.div(sums[surfel_layout.SUM_V], opacity), 0.0))
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
