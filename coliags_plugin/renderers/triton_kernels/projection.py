"""Projection of 3D Gaussians and its gradients: the formulas of ``docs/rendering.md``, section "Projection"."""

from __future__ import annotations

import triton
import triton.language as tl

from coliags_plugin.renderers.triton_kernels.geometry import (
    OUTLINE_COLUMNS,
    chosen,
    combined,
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
