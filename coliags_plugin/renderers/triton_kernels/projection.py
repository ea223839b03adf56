"""Projection of 3D Gaussians and surfels, and its gradients: the formulas of ``docs/rendering.md``.

Surfels are projected in float64. The gradient of their ``means2d`` is one of its own (``ProjectedSurfels``), so the
centres are projected first, and what depends on their direction is computed from them.
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
    multiplied,
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

# --- 3D Gaussians -----------------------------------------------------------------------------------------------------


@triton.jit
def _project(gaussians, axes, row, here, view, slope_limits):
    """All that does not depend on opacity.

    Returns whether in front; offset in world axes and place in camera axes; x / z and y / z, clamped, and whether they
    are not; quaternion, its inverse length and the columns of its rotation; scales; the rows of J C^T, and of J C^T R.
    """
    right, down, forward, _ = axes
    fx, fy = view.fx, view.fy
    in_front, offset, place = in_camera(load_rows(gaussians.means, row, here), axes, view.near_plane, here)
    x, y, z = place
    x_min, x_max, y_min, y_max = slope_limits
    slope_x = tl.minimum(tl.maximum(x / z, x_min), x_max)
    slope_y = tl.minimum(tl.maximum(y / z, y_min), y_max)
    free = (slope_x == x / z, slope_y == y / z)
    image_x = times(fx / z, plus(right, times(-slope_x, forward)))
    image_y = times(fy / z, plus(down, times(-slope_y, forward)))
    quaternion, inverse_norm = load_quaternion(gaussians.quats, row, here, tl.float32)
    first, second, third = rotation_columns(quaternion)
    local_x = (dot(image_x, first), dot(image_x, second), dot(image_x, third))
    local_y = (dot(image_y, first), dot(image_y, second), dot(image_y, third))
    scale = load_rows(gaussians.scales, row, here)
    turned = (quaternion, inverse_norm, (first, second, third))
    return in_front, offset, place, (slope_x, slope_y), free, turned, scale, (image_x, image_y), (local_x, local_y)


@triton.jit
def _shortest(columns, scale, offset):
    """Masks of where the second or third axis is the shortest; the shortest in the world, its sign to the camera."""
    second, third = scale[1] < scale[0], scale[2] < tl.minimum(scale[0], scale[1])
    axis = chosen(third, columns[2], chosen(second, columns[1], columns[0]))
    return second, third, axis, tl.where(dot(axis, offset) > 0.0, -1.0, 1.0)


@triton.jit
def forward(
    gaussians, projected, extents, view, slope_limits, cuts, grid,
    WITH_NORMALS: tl.constexpr, SIZE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Project 3D Gaussians; log(opacity) and radius are 0 where nothing is drawn.

    Arguments are ``Tables``, ``Projected`` and ``Extents`` to write, ``View``, least and largest x / z, then y / z, and
    ``Cuts`` and ``Grid`` of ``geometry``.
    """
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = row < view.count
    axes = load_pose(gaussians.pose, tl.float32)
    in_front, offset, place, _, _, turned, scale, _, local = _project(gaussians, axes, row, here, view, slope_limits)
    x, y, z = place
    mean_x, mean_y = view.fx * x / z + view.cx, view.fy * y / z + view.cy
    outline, xx, yy = filtered(multiplied(local[0], scale), multiplied(local[1], scale), cuts.low_pass)

    opacity = tl.load(gaussians.opacities + row, here, 0.0)
    tau = 2.0 * tl.log(opacity / cuts.alpha_min)
    left, right, top, bottom = 0.5 - mean_x, grid.width - 0.5 - mean_x, 0.5 - mean_y, grid.height - 0.5 - mean_y
    nearest = squared_distance_to_box(outline, left, right, top, bottom)
    drawn = in_front & (tau >= 0.0) & (nearest <= tau)
    radius = tl.ceil(tl.sqrt(tl.maximum(tau, 0.0) * tl.maximum(xx, yy)))
    tl.store(extents.radii + row, tl.where(drawn, radius, 0.0), here)
    tl.store(projected.log_opacities + row, tl.log(tl.where(drawn, opacity, 1.0)), here)
    tl.store(projected.depths + row, z, here)
    tl.store(projected.means2d + 2 * row, mean_x, here)
    tl.store(projected.means2d + 2 * row + 1, mean_y, here)
    store_rows(projected.shapes, row, here, (outline[0], outline[1], outline[2]))
    if WITH_NORMALS:
        _, _, axis, sign = _shortest(turned[2], scale, offset)
        normal = times(sign, (dot(axis, axes[0]), dot(axis, axes[1]), dot(axis, axes[2])))
        store_rows(projected.normals, row, here, normal)

    reach = tl.maximum(tau, 0.0) + cuts.slack
    half_x, half_y = tl.sqrt(reach * xx), tl.sqrt(reach * yy)
    box = (mean_x - half_x, mean_x + half_x, mean_y - half_y, mean_y + half_y)
    store_tiles(extents.boxes, row, here, drawn, box, grid, SIZE)
    entry = extents.outlines + OUTLINE_COLUMNS * row
    tl.store(entry, mean_x, here)
    tl.store(entry + 1, mean_y, here)
    for column in tl.static_range(5):
        tl.store(entry + 2 + column, outline[column], here)
    tl.store(entry + 7, reach, here)
    tl.store(entry + 10, tl.full([BLOCK], -1.0, tl.float32), here)


@triton.jit
def backward(
    gaussians, whitenings, boxes, of_projected, of_gaussians, view, slope_limits,
    WITH_NORMALS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write ``of_gaussians``, of the pose sums, from ``of_projected`` and the outputs of :func:`forward`."""
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = row < view.count
    fx, fy = view.fx, view.fy
    axes = load_pose(gaussians.pose, tl.float32)
    right, down, forward_axis, _ = axes
    in_front, offset, place, slopes, free, turned, scale, image, local = _project(
        gaussians, axes, row, here, view, slope_limits
    )
    quaternion, inverse_norm, columns = turned
    x, y, z = place

    # dL/dSigma from dL/dU, for Sigma = (U^T U)^-1: with A the lower triangle of dL/dU U^T, its diagonal halved, minus
    # U^T A U made symmetric.
    u_xx, u_yx, u_yy = load_rows(whitenings, row, here)
    of_u_xx, of_u_yx, of_u_yy = load_rows(of_projected.shapes, row, here)
    a_xx, a_yx, a_yy = of_u_xx * u_xx, of_u_yx * u_xx, of_u_yx * u_yx + of_u_yy * u_yy
    twice_xx = -(a_xx * u_xx * u_xx + 2.0 * a_yx * u_xx * u_yx + a_yy * u_yx * u_yx)
    of_xy = -u_yy * (a_yx * u_xx + a_yy * u_yx)
    twice_yy = -a_yy * u_yy * u_yy
    row_x, row_y = multiplied(local[0], scale), multiplied(local[1], scale)
    of_row_x = plus(times(twice_xx, row_x), times(of_xy, row_y))
    of_row_y = plus(times(of_xy, row_x), times(twice_yy, row_y))
    of_scale = plus(multiplied(of_row_x, local[0]), multiplied(of_row_y, local[1]))
    of_local_x, of_local_y = multiplied(of_row_x, scale), multiplied(of_row_y, scale)

    first, second, third = columns
    image_x, image_y = image
    of_image_x = combined(of_local_x, first, second, third)
    of_image_y = combined(of_local_y, first, second, third)
    of_first = plus(times(of_local_x[0], image_x), times(of_local_y[0], image_y))
    of_second = plus(times(of_local_x[1], image_x), times(of_local_y[1], image_y))
    of_third = plus(times(of_local_x[2], image_x), times(of_local_y[2], image_y))

    # image_x = fx / z (right - slope_x forward), where slope_x follows x / z unless it is clamped.
    to_right, to_down = times(fx / z, of_image_x), times(fy / z, of_image_y)
    to_forward = plus(times(-slopes[0], to_right), times(-slopes[1], to_down))
    of_slope_x = tl.where(free[0], -dot(forward_axis, to_right), 0.0)
    of_slope_y = tl.where(free[1], -dot(forward_axis, to_down), 0.0)
    of_x = (fx * tl.load(of_projected.means2d + 2 * row, here, 0.0) + of_slope_x) / z
    of_y = (fy * tl.load(of_projected.means2d + 2 * row + 1, here, 0.0) + of_slope_y) / z
    lost = of_x * x + of_y * y + dot(image_x, of_image_x) + dot(image_y, of_image_y)
    of_z = tl.load(of_projected.depths + row, here, 0.0) - lost / z

    if WITH_NORMALS:
        is_second, is_third, axis, sign = _shortest(columns, scale, offset)
        of_normal = times(sign, load_rows(of_projected.normals, row, here))
        of_axis = combined(of_normal, right, down, forward_axis)
        of_third = plus(of_third, times(is_third.to(tl.float32), of_axis))
        of_second = plus(of_second, times((is_second & ~is_third).to(tl.float32), of_axis))
        of_first = plus(of_first, times((~is_second & ~is_third).to(tl.float32), of_axis))
        to_right, to_down = plus(to_right, times(of_normal[0], axis)), plus(to_down, times(of_normal[1], axis))
        to_forward = plus(to_forward, times(of_normal[2], axis))

    nothing = (0.0, 0.0, 0.0)
    of_mean = chosen(in_front, combined((of_x, of_y, of_z), right, down, forward_axis), nothing)
    store_pose_sums(
        of_gaussians.pose,
        chosen(in_front, plus(times(of_x, offset), to_right), nothing),
        chosen(in_front, plus(times(of_y, offset), to_down), nothing),
        chosen(in_front, plus(times(of_z, offset), to_forward), nothing),
        times(-1.0, of_mean),
    )
    store_rows(of_gaussians.means, row, here, of_mean)
    store_rows(of_gaussians.scales, row, here, chosen(in_front, of_scale, nothing))
    store_quaternion_gradient(
        of_gaussians.quats, row, here, quaternion, inverse_norm, chosen(in_front, of_first, nothing),
        chosen(in_front, of_second, nothing), chosen(in_front, of_third, nothing),
    )  # fmt: skip
    drawn = tl.load(boxes + 4 * row, here, 0) <= tl.load(boxes + 4 * row + 1, here, -1)
    of_log_opacity = tl.load(of_projected.log_opacities + row, here, 0.0)
    of_opacity = tl.where(drawn, of_log_opacity / tl.load(gaussians.opacities + row, here, 1.0), 0.0)
    tl.store(of_gaussians.opacities + row, of_opacity, here)


# --- surfels ----------------------------------------------------------------------------------------------------------


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
def surfels_forward(surfels, projected, extents, view, cuts, grid, SIZE: tl.constexpr, BLOCK: tl.constexpr):
    """Project surfels with the ``means2d`` of :func:`centers`; arguments as of :func:`forward`."""
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
def surfels_backward(surfels, boxes, of_projected, of_means2d, of_surfels, view, BLOCK: tl.constexpr):
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
