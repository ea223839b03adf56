"""Sums over entries -> derivatives of the loss with respect to the Gaussians and the camera's pose.

``gather`` adds up the entries of each Gaussian, in the order of its tiles, and finds the derivative with respect to
means2d; ``project_backward`` takes it from there through the formulas of ``docs/rendering.md``, section "Projection".
"""

from __future__ import annotations

import numba
import numpy as np

from coliags_plugin.renderers.numba_kernels import layout
from coliags_plugin.renderers.numba_kernels.compilation import inline, part, region_kernel
from coliags_plugin.renderers.numba_kernels.geometry import project_axes, shortest_axes, shortest_column
from coliags_plugin.renderers.numba_kernels.lanes import (
    add,
    broadcast,
    broadcast_all,
    div,
    dot,
    fma,
    from_bits,
    greater,
    lane,
    lane_sums,
    load,
    load_columns,
    lowest_bit,
    mul,
    neg,
    prefetch,
    prefetch_to_write,
    repeat,
    select,
    splat,
    store,
    store_columns,
    sub,
)
from coliags_plugin.renderers.numba_kernels.projection import PARCEL
from coliags_plugin.renderers.numba_kernels.sorting import NUMBER
from coliags_plugin.renderers.numba_kernels.threads import take

#: Turns products of two (or four) factors of the scaled U into those of the plain one.
_PLAIN_SQUARE = 1.0 / layout.U_FACTOR_SQUARED
_PLAIN_FOURTH = _PLAIN_SQUARE * _PLAIN_SQUARE
#: How many Gaussians before its turn memory is asked for.
_AHEAD = 16


@region_kernel
def gather(
    workers,
    counters,
    keys,
    records,
    drawn,
    stretch_entries,
    entry_counts,
    entry_sums,
    gaussian_sums,
    of_means2d,
):  # type: ignore[no-untyped-def]
    """Add up the sums of each Gaussian's entries.

    Args:
        workers: Threads to share the work.
        counters: For sharing; entries 1 and 2 must be 0.
        keys: Numbers of the Gaussians drawn, as sorted. [Gaussians drawn]
        records, drawn: What projection wrote.
        stretch_entries, entry_counts: What binning wrote.
        entry_sums: What the backward sweep wrote.
        gaussian_sums: Out: see ``layout``; 0 where not drawn. [16 for each Gaussian, groups filled up]
        of_means2d: Out: derivative with respect to the projected centres. [2 for each Gaussian, groups filled up]
    """
    stretches = len(stretch_entries) - 1
    count = len(keys)
    parcel_groups = PARCEL // 16
    for _ in numba.prange(workers):
        while True:
            parcel = take(counters, 1, 1)
            if parcel * parcel_groups >= len(drawn):
                break
            last = min((parcel + 1) * parcel_groups, len(drawn))
            _clear_undrawn(parcel * parcel_groups, last, drawn, gaussian_sums, of_means2d)
        while True:
            stretch = take(counters, 2, 1)
            if stretch >= stretches:
                break
            first, last = count * stretch // stretches, count * (stretch + 1) // stretches
            _gather_stretch(
                first,
                last,
                stretch_entries[stretch],
                keys,
                records,
                entry_counts,
                entry_sums,
                gaussian_sums,
                of_means2d,
            )


@part
def _clear_undrawn(first, last, drawn, gaussian_sums, of_means2d):  # type: ignore[no-untyped-def]
    """Write zeros for the Gaussians of groups ``first`` to ``last`` that are not drawn."""
    for group in range(first, last):
        flags = drawn[group] ^ 0xFFFF
        while flags:
            index = 16 * group + lowest_bit(flags)
            flags &= flags - 1
            store(gaussian_sums, layout.ROW * index, 0.0)
            of_means2d[2 * index] = 0.0
            of_means2d[2 * index + 1] = 0.0


@part
def _gather_stretch(first, last, entry, keys, records, entry_counts, entry_sums, gaussian_sums, of_means2d):  # type: ignore[no-untyped-def]
    """Gaussians in places ``first`` to ``last`` of the sorted list, whose entries are those from ``entry`` on."""
    square = np.float32(_PLAIN_SQUARE)
    for place in range(first, last):
        ahead = keys[min(place + _AHEAD, last - 1)] & NUMBER
        prefetch(records, layout.ROW * ahead)
        prefetch_to_write(gaussian_sums, layout.ROW * ahead)
        prefetch_to_write(of_means2d, 2 * ahead)
        index = keys[place] & NUMBER
        row = layout.ROW * index
        total = splat(0.0)
        for _ in range(entry_counts[place]):
            total = add(total, load(entry_sums, layout.ROW * entry))
            entry += 1
        store(gaussian_sums, row, total)
        e, f = lane(total, layout.SUM_E), lane(total, layout.SUM_F)
        of_x = records[row + layout.U_XX] * e + records[row + layout.U_YX] * f
        of_means2d[2 * index] = square * of_x
        of_means2d[2 * index + 1] = square * (records[row + layout.U_YY] * f)


@region_kernel
def project_backward(
    workers,
    counters,
    count,
    means,
    quats,
    scales,
    opacities,
    tail_means,
    tail_quats,
    tail_scales,
    tail_opacities,
    view,
    with_depth,
    with_inverse_depth,
    with_normals,
    records,
    drawn,
    gaussian_sums,
    given_means2d,
    of_means,
    of_quats,
    of_scales,
    of_opacities,
    of_colors,
    of_pose,
):  # type: ignore[no-untyped-def]
    """From the sums of each Gaussian to the derivatives of the loss.

    Args:
        workers: Threads to share the work.
        counters: For sharing; entry 0 must be 0.
        count: How many Gaussians.
        means, quats, scales, opacities: Flat.
        tail_means, tail_quats, tail_scales, tail_opacities: As for ``project``.
        view: See ``layout``.
        with_depth, with_inverse_depth, with_normals: What was composited besides colour.
        records, drawn: What projection wrote.
        gaussian_sums: What ``gather`` wrote, groups filled up.
        given_means2d: Derivative with respect to the projected centres, groups filled up. [2 for each Gaussian]
        of_means, of_quats, of_scales, of_opacities, of_colors: Out, groups filled up.
        of_pose: Out: derivative with respect to the camera's three axes and its centre, in the world, one row for each
            parcel. [16 for each parcel]
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
            pose = _project_groups_backward(
                first, last, first, repeat(0.0, (0,) * 12), means, quats, scales, opacities, view, with_depth,
                with_inverse_depth, with_normals, records, drawn, gaussian_sums, given_means2d, of_means, of_quats,
                of_scales, of_opacities, of_colors,
            )  # fmt: skip
            if last < min(first + per_parcel, groups):
                pose = _project_groups_backward(
                    last, last + 1, 0, pose, tail_means, tail_quats, tail_scales, tail_opacities, view, with_depth,
                    with_inverse_depth, with_normals, records, drawn, gaussian_sums, given_means2d, of_means, of_quats,
                    of_scales, of_opacities, of_colors,
                )  # fmt: skip
            store(of_pose, layout.ROW * parcel, lane_sums(pose))


@part
def _project_groups_backward(
    first,
    last,
    source,
    pose,
    means,
    quats,
    scales,
    opacities,
    view,
    with_depth,
    with_inverse_depth,
    with_normals,
    records,
    drawn,
    gaussian_sums,
    given_means2d,
    of_means,
    of_quats,
    of_scales,
    of_opacities,
    of_colors,
):  # type: ignore[no-untyped-def]
    """Groups ``first`` to ``last``, reading from group ``source`` of the inputs on. Returns ``pose``, added to."""
    three = (0, 0, 0)
    right = broadcast_all(view, layout.VIEW_RIGHT, three)
    down = broadcast_all(view, layout.VIEW_DOWN, three)
    forward = broadcast_all(view, layout.VIEW_FORWARD, three)
    fx, fy = broadcast(view, layout.VIEW_FX), broadcast(view, layout.VIEW_FY)
    of_right, of_down, of_forward, of_center = pose[0:3], pose[3:6], pose[6:9], pose[9:12]
    for group in range(first, last):
        shown = from_bits(drawn[group])
        from_row = 16 * (group - first + source)
        mean = load_columns(means, 3 * from_row, three)
        quat = load_columns(quats, 4 * from_row, (0, 0, 0, 0))
        scale = load_columns(scales, 3 * from_row, three)
        opacity = load(opacities, from_row)
        sums = load_columns(gaussian_sums, 16 * layout.ROW * group, (0,) * 16)
        by_x, by_y = load_columns(given_means2d, 32 * group, (0, 0))
        at = project_axes(mean, quat, view)
        row = load_columns(records, 16 * layout.ROW * group, (0,) * 16)
        u_xx, u_yx, u_yy = row[layout.U_XX], row[layout.U_YX], row[layout.U_YY]

        # (d loss / d Sigma) = U^T S U / 2 with S the sums of v w w^T, w = U d; and Sigma = V V^T + lambda I.
        sum_ee, sum_ef, sum_ff = sums[layout.SUM_EE], sums[layout.SUM_EF], sums[layout.SUM_FF]
        right_e, right_f = fma(sum_ee, u_xx, mul(sum_ef, u_yx)), fma(sum_ef, u_xx, mul(sum_ff, u_yx))
        by_xx = mul(_PLAIN_FOURTH, fma(u_xx, right_e, mul(u_yx, right_f)))
        by_xy = mul(_PLAIN_FOURTH, mul(u_yy, right_f))
        by_yy = mul(_PLAIN_FOURTH, mul(u_yy, mul(u_yy, sum_ff)))
        row_x, row_y = mul(at.local_x, scale), mul(at.local_y, scale)
        of_row_x = fma(by_xx, row_x, mul(by_xy, row_y))
        of_row_y = fma(by_xy, row_x, mul(by_yy, row_y))
        of_scale = fma(of_row_x, at.local_x, mul(of_row_y, at.local_y))
        of_local_x, of_local_y = mul(of_row_x, scale), mul(of_row_y, scale)

        # local = R^T image, so R gets image local^T and image gets R local.
        first_row, second_row, third_row = at.rotation
        of_first_row = fma(at.image_x[0], of_local_x, mul(at.image_y[0], of_local_y))
        of_second_row = fma(at.image_x[1], of_local_x, mul(at.image_y[1], of_local_y))
        of_third_row = fma(at.image_x[2], of_local_x, mul(at.image_y[2], of_local_y))
        of_image_x = (
            dot(first_row, of_local_x, 0.0),
            dot(second_row, of_local_x, 0.0),
            dot(third_row, of_local_x, 0.0),
        )
        of_image_y = (
            dot(first_row, of_local_y, 0.0),
            dot(second_row, of_local_y, 0.0),
            dot(third_row, of_local_y, 0.0),
        )

        # image_x = fx / z (right - slope_x forward), and slope_x follows x / z unless clamped.
        per_x, per_y = mul(fx, at.inverse_z), mul(fy, at.inverse_z)
        to_right, to_down = mul(per_x, of_image_x), mul(per_y, of_image_y)
        to_forward = neg(fma(at.slope_x, to_right, mul(at.slope_y, to_down)))
        of_slope_x = select(at.follows_x, neg(dot(forward, to_right, 0.0)), 0.0)
        of_slope_y = select(at.follows_y, neg(dot(forward, to_down, 0.0)), 0.0)
        of_free_x, of_free_y = fma(fx, by_x, of_slope_x), fma(fy, by_y, of_slope_y)
        of_x, of_y = mul(of_free_x, at.inverse_z), mul(of_free_y, at.inverse_z)
        lost = fma(of_x, at.x, mul(of_y, at.y))
        lost = add(lost, add(dot(at.image_x, of_image_x, 0.0), dot(at.image_y, of_image_y, 0.0)))
        of_z = neg(mul(lost, at.inverse_z))
        of_depth, of_inverse_depth, of_normal = _extra_sums(sums, with_depth, with_inverse_depth)
        of_z = add(of_z, sub(of_depth, mul(of_inverse_depth, mul(at.inverse_z, at.inverse_z))))

        if with_normals:
            # The normal is a column of R, turned by its sign, in camera axes.
            second, third = shortest_axes(scale)
            axis = shortest_column(at.rotation, second, third)
            sign = select(greater(dot(axis, at.offset, 0.0), 0.0), splat(-1.0), splat(1.0))
            turned = mul(sign, of_normal)
            to_axis = fma(turned[0], right, fma(turned[1], down, mul(turned[2], forward)))
            at_first = select(second, splat(0.0), select(third, splat(0.0), splat(1.0)))
            at_third = select(third, splat(1.0), splat(0.0))
            chosen = (at_first, sub(sub(1.0, at_first), at_third), at_third)
            of_first_row = fma(to_axis[0], chosen, of_first_row)
            of_second_row = fma(to_axis[1], chosen, of_second_row)
            of_third_row = fma(to_axis[2], chosen, of_third_row)
            to_right = fma(turned[0], axis, to_right)
            to_down = fma(turned[1], axis, to_down)
            to_forward = fma(turned[2], axis, to_forward)

        of_mean = fma(of_x, right, fma(of_y, down, mul(of_z, forward)))
        none = repeat(0.0, three)
        of_mean = select(shown, of_mean, none)
        of_right = add(of_right, select(shown, fma(of_x, at.offset, to_right), none))
        of_down = add(of_down, select(shown, fma(of_y, at.offset, to_down), none))
        of_forward = add(of_forward, select(shown, fma(of_z, at.offset, to_forward), none))
        of_center = sub(of_center, of_mean)
        of_quat = _quaternion_derivative(at.quaternion, of_first_row, of_second_row, of_third_row)
        along = dot(of_quat, at.quaternion, 0.0)
        of_quat = mul(at.inverse_norm, fma(neg(along), at.quaternion, of_quat))

        store_columns(of_means, 48 * group, of_mean)
        store_columns(of_quats, 64 * group, select(shown, of_quat, repeat(0.0, (0, 0, 0, 0))))
        store_columns(of_scales, 48 * group, select(shown, of_scale, none))
        store(of_opacities, 16 * group, select(shown, div(sums[layout.SUM_V], opacity), 0.0))
        color = (sums[layout.SUM_CHANNELS], sums[layout.SUM_CHANNELS + 1], sums[layout.SUM_CHANNELS + 2])
        store_columns(of_colors, 48 * group, select(shown, color, none))
    return of_right + of_down + of_forward + of_center


@inline
def _extra_sums(sums, with_depth, with_inverse_depth):  # type: ignore[no-untyped-def]
    """The sums of depth, inverse depth and normal, which lie without gaps behind those of colour."""
    zero = splat(0.0)
    if with_depth:
        if with_inverse_depth:
            return sums[9], sums[10], (sums[11], sums[12], sums[13])
        return sums[9], zero, (sums[10], sums[11], sums[12])
    if with_inverse_depth:
        return zero, sums[9], (sums[10], sums[11], sums[12])
    return zero, zero, (sums[9], sums[10], sums[11])


@inline
def _quaternion_derivative(quaternion, first, second, third):  # type: ignore[no-untyped-def]
    """Derivative with respect to a unit quaternion, w first, from that with respect to the rows of its rotation."""
    w, x, y, z = quaternion
    turn_x, turn_y, turn_z = sub(third[1], second[2]), sub(first[2], third[0]), sub(second[0], first[1])
    both_xy, both_xz, both_yz = add(first[1], second[0]), add(first[2], third[0]), add(second[2], third[1])
    straight_x, straight_y, straight_z = add(second[1], third[2]), add(first[0], third[2]), add(first[0], second[1])
    return mul(
        2.0,
        (
            fma(x, turn_x, fma(y, turn_y, mul(z, turn_z))),
            fma(w, turn_x, fma(y, both_xy, fma(z, both_xz, mul(x, mul(-2.0, straight_x))))),
            fma(w, turn_y, fma(x, both_xy, fma(z, both_yz, mul(y, mul(-2.0, straight_y))))),
            fma(w, turn_z, fma(x, both_xz, fma(y, both_yz, mul(z, mul(-2.0, straight_z))))),
        ),
    )
