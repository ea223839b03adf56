"""Projection of surfels and its gradients, in float64: the formulas of ``docs/rendering.md``, section "Surfels".

The gradient of ``means2d`` is one of its own (``ProjectedSurfels``), so the centres are projected first, and what
depends on their direction is computed from them.
"""

from __future__ import annotations

import triton
import triton.language as tl

from coliags_plugin.renderers.triton_kernels.geometry import (
    OUTLINE_COLUMNS,
    chosen,
    combined,
    cross,
    dot,
    filtered,
    in_camera,
    load_pose,
    load_quaternion,
    load_rows,
    plus,
    rotation_columns,
    squared_distance_to_box,
    store_pose_sums,
    store_quaternion_gradient,
    store_rows,
    store_tiles,
    times,
)

#: Columns of the shapes: slopes of U, V and W (6), W at the centre, and D.
SHAPE_COLUMNS = tl.constexpr(8)


@triton.jit
def _double(a):
    return a[0].to(tl.float64), a[1].to(tl.float64), a[2].to(tl.float64)


@triton.jit
def _single(a):
    return a[0].to(tl.float32), a[1].to(tl.float32), a[2].to(tl.float32)


@triton.jit
def _into(axes, a):
    """A vector of the world in camera axes."""
    return dot(axes[0], a), dot(axes[1], a), dot(axes[2], a)


@triton.jit
def _place(means, pose, row, here, view):
    """The camera's axes; whether in front; offset in world axes and place in camera axes."""
    axes = load_pose(pose, tl.float64)
    in_front, offset, place = in_camera(_double(load_rows(means, row, here)), axes, view.near_plane, here)
    return axes, in_front, offset, place


@triton.jit
def _scales(scales, row, here):
    """Standard deviations, 1 where they are 0, and whether they are not."""
    first, second = tl.load(scales + 2 * row, here, 1.0), tl.load(scales + 2 * row + 1, here, 1.0)
    some = (first != 0.0, second != 0.0)
    return tl.where(some[0], first, 1.0).to(tl.float64), tl.where(some[1], second, 1.0).to(tl.float64), some


@triton.jit
def centers(means, pose, means2d, view, BLOCK: tl.constexpr):
    """Project the centres of surfels to pixels."""
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = row < view.count
    _, _, _, place = _place(means, pose, row, here, view)
    tl.store(means2d + 2 * row, (view.fx * place[0] / place[2] + view.cx).to(tl.float32), here)
    tl.store(means2d + 2 * row + 1, (view.fy * place[1] / place[2] + view.cy).to(tl.float32), here)


@triton.jit
def centers_backward(means, pose, of_means2d, of_means, of_pose, view, BLOCK: tl.constexpr):
    """Gradients of the means, and sums of those of the pose."""
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = row < view.count
    axes, in_front, offset, place = _place(means, pose, row, here, view)
    fx, fy = view.fx, view.fy
    x, y, z = place
    of_x = tl.where(in_front, fx * tl.load(of_means2d + 2 * row, here, 0.0).to(tl.float64) / z, 0.0)
    of_y = tl.where(in_front, fy * tl.load(of_means2d + 2 * row + 1, here, 0.0).to(tl.float64) / z, 0.0)
    of_z = -(of_x * x + of_y * y) / z
    of_mean = combined((of_x, of_y, of_z), axes[0], axes[1], axes[2])
    store_rows(of_means, row, here, _single(of_mean))
    of_right, of_down, of_forward = times(of_x, offset), times(of_y, offset), times(of_z, offset)
    store_pose_sums(of_pose, of_right, of_down, of_forward, times(-1.0, of_mean))


@triton.jit
def forward(surfels, projected, extents, view, cuts, grid, SIZE: tl.constexpr, BLOCK: tl.constexpr):
    """Project surfels with the ``means2d`` of :func:`centers`; arguments as of ``projection.forward``."""
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = row < view.count
    fx, fy, width, height = view.fx, view.fy, grid.width, grid.height
    axes, in_front, _, place = _place(surfels.means, surfels.pose, row, here, view)
    quaternion, _ = load_quaternion(surfels.quats, row, here, tl.float64)
    first, second, third = rotation_columns(quaternion)
    first, second, third = _into(axes, first), _into(axes, second), _into(axes, third)
    scale_u, scale_v, some = _scales(surfels.scales, row, here)
    u, v, w = cross(second, place), cross(place, first), cross(first, second)
    distance = dot(w, place)
    shape = projected.shapes + SHAPE_COLUMNS * row
    tl.store(shape, (u[0] / (scale_u * fx)).to(tl.float32), here)
    tl.store(shape + 1, (u[1] / (scale_u * fy)).to(tl.float32), here)
    tl.store(shape + 2, (v[0] / (scale_v * fx)).to(tl.float32), here)
    tl.store(shape + 3, (v[1] / (scale_v * fy)).to(tl.float32), here)
    tl.store(shape + 4, (w[0] / fx).to(tl.float32), here)
    tl.store(shape + 5, (w[1] / fy).to(tl.float32), here)
    # As they are read, so that a depth at the centre is exactly the centre's.
    single_distance, z = distance.to(tl.float32), place[2].to(tl.float32)
    tl.store(shape + 6, single_distance / z, here)
    tl.store(shape + 7, single_distance, here)
    tl.store(projected.depths + row, z, here)
    store_rows(projected.normals, row, here, _single(times(tl.where(dot(third, place) > 0.0, -1.0, 1.0), third)))

    opacity = tl.load(surfels.opacities + row, here, 0.0)
    tau = 2.0 * tl.log(opacity / cuts.alpha_min)
    visible = in_front & some[0] & some[1] & (distance != 0.0) & (tau >= 0.0)
    level = tl.maximum(tau, 0.0) + cuts.slack
    root = tl.sqrt(level)
    means2d = projected.means2d + 2 * row
    mean_x, mean_y = tl.load(means2d, here, 0.0), tl.load(means2d + 1, here, 0.0)
    slope_x, slope_y = (place[0] / place[2]).to(tl.float32), (place[1] / place[2]).to(tl.float32)
    rim_u = times(root, _single(times(scale_u, first)))
    rim_v = times(root, _single(times(scale_v, second)))
    # With a point of the rim at z (x/z, y/z, 1) + rim^T (cos, sin), the image is a conic: an ellipse if its z-depths,
    # within z +- |rise|, are positive.
    rise_u, rise_v = rim_u[2], rim_v[2]
    spread = tl.sqrt(rise_u * rise_u + rise_v * rise_v)
    everywhere = z - spread <= view.near_plane
    span = tl.where(everywhere, 1.0, (z - spread) * (z + spread))
    x_u, x_v = fx * (rim_u[0] - slope_x * rise_u), fx * (rim_v[0] - slope_x * rise_v)
    y_u, y_v = fy * (rim_u[1] - slope_y * rise_u), fy * (rim_v[1] - slope_y * rise_v)
    along_x, along_y = (x_u * rise_u + x_v * rise_v) / span, (y_u * rise_u + y_v * rise_v) / span
    inverse, bend = 1.0 / tl.sqrt(span), 1.0 / (z + tl.sqrt(span))
    bend_u, bend_v = rise_u * bend, rise_v * bend
    row_x = (x_u * inverse + along_x * bend_u, x_v * inverse + along_x * bend_v, 0.0 * z)
    row_y = (y_u * inverse + along_y * bend_u, y_v * inverse + along_y * bend_v, 0.0 * z)
    outline, xx, yy = filtered(row_x, row_y, cuts.low_pass)
    center_x, center_y = mean_x - along_x, mean_y - along_y
    half_x, half_y, radius = tl.sqrt(xx), tl.sqrt(yy), root * cuts.surfel_filter
    left, right = tl.minimum(center_x - half_x, mean_x - radius), tl.maximum(center_x + half_x, mean_x + radius)
    top, bottom = tl.minimum(center_y - half_y, mean_y - radius), tl.maximum(center_y + half_y, mean_y + radius)
    left, right = tl.where(everywhere, 0.0, left), tl.where(everywhere, width, right)
    top, bottom = tl.where(everywhere, 0.0, top), tl.where(everywhere, height, bottom)

    nearest = squared_distance_to_box(
        outline, 0.5 - center_x, width - 0.5 - center_x, 0.5 - center_y, height - 0.5 - center_y
    )
    out_x = tl.maximum(0.5 - mean_x, 0.0) + tl.minimum(width - 0.5 - mean_x, 0.0)
    out_y = tl.maximum(0.5 - mean_y, 0.0) + tl.minimum(height - 0.5 - mean_y, 0.0)
    squared_radius = level * cuts.surfel_filter * cuts.surfel_filter
    reached = everywhere | (nearest <= 1.0) | (out_x * out_x + out_y * out_y <= squared_radius)
    drawn = visible & reached
    half = tl.ceil(0.5 * tl.maximum(right - left, bottom - top))
    tl.store(extents.radii + row, tl.where(drawn, half, 0.0), here)
    tl.store(projected.log_opacities + row, tl.log(tl.where(drawn, opacity, 1.0)), here)
    store_tiles(extents.boxes, row, here, drawn, (left, right, top, bottom), grid, SIZE)
    entry = extents.outlines + OUTLINE_COLUMNS * row
    tl.store(entry, center_x, here)
    tl.store(entry + 1, center_y, here)
    for column in tl.static_range(5):
        # Everywhere: without extent in standard deviations, whatever the distance.
        tl.store(entry + 2 + column, tl.where(everywhere, 0.0, outline[column]), here)
    tl.store(entry + 7, tl.full([BLOCK], 1.0, tl.float32), here)
    tl.store(entry + 8, mean_x, here)
    tl.store(entry + 9, mean_y, here)
    tl.store(entry + 10, squared_radius, here)


@triton.jit
def backward(surfels, boxes, of_projected, of_means2d, of_surfels, view, BLOCK: tl.constexpr):
    """Write ``of_surfels``, of the pose sums, and gradients of their projected centres, from ``of_projected``."""
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = row < view.count
    fx, fy = view.fx, view.fy
    axes, in_front, offset, place = _place(surfels.means, surfels.pose, row, here, view)
    right, down, forward_axis, _ = axes
    quaternion, inverse_norm = load_quaternion(surfels.quats, row, here, tl.float64)
    columns = rotation_columns(quaternion)
    first, second, third = _into(axes, columns[0]), _into(axes, columns[1]), _into(axes, columns[2])
    scale_u, scale_v, some = _scales(surfels.scales, row, here)
    x, y, z = place

    shape = of_projected.shapes + SHAPE_COLUMNS * row
    of_w_center = tl.load(shape + 6, here, 0.0).to(tl.float64)
    w = cross(first, second)
    distance = dot(w, place)
    of_distance = tl.load(shape + 7, here, 0.0).to(tl.float64) + of_w_center / z
    none = 0.0 * z
    of_u = (tl.load(shape, here, 0.0) / (scale_u * fx), tl.load(shape + 1, here, 0.0) / (scale_u * fy), none)
    of_v = (tl.load(shape + 2, here, 0.0) / (scale_v * fx), tl.load(shape + 3, here, 0.0) / (scale_v * fy), none)
    of_w = (tl.load(shape + 4, here, 0.0) / fx + none, tl.load(shape + 5, here, 0.0) / fy + none, none)
    of_w = plus(of_w, times(of_distance, place))
    # c = a x b: a gets b x dL/dc, and b gets dL/dc x a.
    of_first = plus(cross(of_v, place), cross(second, of_w))
    of_second = plus(cross(place, of_u), cross(of_w, first))
    of_sight = plus(plus(cross(of_u, second), cross(first, of_v)), times(of_distance, w))
    of_scale_u = -dot(of_u, cross(second, place)) / scale_u
    of_scale_v = -dot(of_v, cross(place, first)) / scale_v
    # The sight's direction is that of the projected centre, its depth the centre's own.
    of_z = of_sight[2] + (of_sight[0] * x + of_sight[1] * y) / z - of_w_center * distance / (z * z)
    sign = tl.where(dot(third, place) > 0.0, -1.0, 1.0)
    of_third = times(sign, _double(load_rows(of_projected.normals, row, here)))

    nothing = (0.0, 0.0, 0.0)
    of_first, of_second = chosen(in_front, of_first, nothing), chosen(in_front, of_second, nothing)
    of_third, of_z = chosen(in_front, of_third, nothing), tl.where(in_front, of_z, 0.0)
    tl.store(of_means2d + 2 * row, tl.where(in_front, of_sight[0] * z / fx, 0.0).to(tl.float32), here)
    tl.store(of_means2d + 2 * row + 1, tl.where(in_front, of_sight[1] * z / fy, 0.0).to(tl.float32), here)
    of_mean = times(of_z, forward_axis)
    store_rows(of_surfels.means, row, here, _single(of_mean))
    store_pose_sums(
        of_surfels.pose,
        combined((of_first[0], of_second[0], of_third[0]), columns[0], columns[1], columns[2]),
        combined((of_first[1], of_second[1], of_third[1]), columns[0], columns[1], columns[2]),
        plus(
            combined((of_first[2], of_second[2], of_third[2]), columns[0], columns[1], columns[2]), times(of_z, offset)
        ),
        times(-1.0, of_mean),
    )
    store_quaternion_gradient(
        of_surfels.quats, row, here, quaternion, inverse_norm, combined(of_first, right, down, forward_axis),
        combined(of_second, right, down, forward_axis), combined(of_third, right, down, forward_axis),
    )  # fmt: skip
    tl.store(of_surfels.scales + 2 * row, tl.where(in_front & some[0], of_scale_u, 0.0).to(tl.float32), here)
    tl.store(of_surfels.scales + 2 * row + 1, tl.where(in_front & some[1], of_scale_v, 0.0).to(tl.float32), here)
    drawn = tl.load(boxes + 4 * row, here, 0) <= tl.load(boxes + 4 * row + 1, here, -1)
    of_log_opacity = tl.load(of_projected.log_opacities + row, here, 0.0)
    of_opacity = tl.where(drawn, of_log_opacity / tl.load(surfels.opacities + row, here, 1.0), 0.0)
    tl.store(of_surfels.opacities + row, of_opacity, here)
