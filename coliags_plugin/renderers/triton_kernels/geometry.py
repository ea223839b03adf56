"""Arguments and device functions of projection: vectors, cameras, rotations, and pairs with the tiles that are touched.

A vector of a block of Gaussians is a tuple of its coordinates.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import triton
import triton.language as tl

#: Gaussians of a program, and its warps.
BLOCK = 64
WARPS = 2
#: Columns of the outlines that binning reads: an ellipse's centre, its whitening (u_xx, u_yx, u_yy), cov_xy / cov_xx
#: and cov_xy / cov_yy, the squared Mahalanobis distance at its rim; centre and squared radius of a circle.
OUTLINE_COLUMNS = tl.constexpr(11)


class Tables(NamedTuple):
    """Gaussians or surfels and the pose they are seen from, or the gradients of these."""

    means: Any  # [N, 3]
    quats: Any  # w first [N, 4]
    scales: Any  # [N, 3], surfels [N, 2]
    opacities: Any  # [N]
    pose: Any  # camera_to_world [4, 4]; of gradients one sum for each program [programs, 3, 4]


class Projected(NamedTuple):
    """Outputs of the projection with gradients, or these gradients."""

    means2d: Any  # pixels [N, 2]
    shapes: Any  # whitenings of 3D Gaussians [N, 3]; of surfels see ``projection.SHAPE_COLUMNS`` [N, 8]
    depths: Any  # z-depths [N]
    log_opacities: Any  # 0 where not drawn [N]
    normals: Any  # camera axes, towards the camera; unused without WITH_NORMALS [N, 3]


class Extents(NamedTuple):
    """Outputs of the projection without gradients, for binning."""

    radii: Any  # pixels; 0 where not drawn [N]
    outlines: Any  # see OUTLINE_COLUMNS [N, 11]
    boxes: Any  # first and last column, first and last row of tiles, int32; none where not drawn [N, 4]


class View(NamedTuple):
    """Number of Gaussians, intrinsics in pixels, and z-depth of the near plane."""

    count: Any
    fx: Any
    fy: Any
    cx: Any
    cy: Any
    near_plane: Any


class Grid(NamedTuple):
    """Size of the image in pixels, and in tiles."""

    width: Any
    height: Any
    columns: Any
    rows: Any


class Cuts(NamedTuple):
    """Thresholds of the projection; ``low_pass`` is added to an ellipse's variances, ``slack`` to its reach."""

    low_pass: Any  # square pixels
    alpha_min: Any
    slack: Any  # squared standard deviations
    surfel_filter: Any = 0.0  # pixels


@triton.jit
def dot(a, b):
    """Inner product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@triton.jit
def cross(a, b):
    """Cross product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@triton.jit
def times(factor, a):
    """Vector times a number."""
    return factor * a[0], factor * a[1], factor * a[2]


@triton.jit
def multiplied(a, b):
    """Products of the coordinates."""
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]


@triton.jit
def plus(a, b):
    """Sum of vectors."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@triton.jit
def combined(weights, a, b, c):
    """Sum of three vectors with weights: a matrix of these columns times a vector."""
    return plus(times(weights[0], a), plus(times(weights[1], b), times(weights[2], c)))


@triton.jit
def chosen(condition, a, b):
    """The first vector where a condition holds, else the second."""
    return tl.where(condition, a[0], b[0]), tl.where(condition, a[1], b[1]), tl.where(condition, a[2], b[2])


@triton.jit
def load_rows(table, row, here):
    """Rows of a table of three columns, 0 where not ``here``."""
    return (
        tl.load(table + 3 * row, here, 0.0),
        tl.load(table + 3 * row + 1, here, 0.0),
        tl.load(table + 3 * row + 2, here, 0.0),
    )


@triton.jit
def store_rows(table, row, here, values):
    """Write rows of a table of three columns."""
    tl.store(table + 3 * row, values[0], here)
    tl.store(table + 3 * row + 1, values[1], here)
    tl.store(table + 3 * row + 2, values[2], here)


@triton.jit
def load_pose(pose, DTYPE: tl.constexpr):
    """The camera's axes right, down and forward, and its centre, in the world, from ``camera_to_world``."""
    right = (tl.load(pose).to(DTYPE), tl.load(pose + 4).to(DTYPE), tl.load(pose + 8).to(DTYPE))
    down = (tl.load(pose + 1).to(DTYPE), tl.load(pose + 5).to(DTYPE), tl.load(pose + 9).to(DTYPE))
    forward = (tl.load(pose + 2).to(DTYPE), tl.load(pose + 6).to(DTYPE), tl.load(pose + 10).to(DTYPE))
    center = (tl.load(pose + 3).to(DTYPE), tl.load(pose + 7).to(DTYPE), tl.load(pose + 11).to(DTYPE))
    return right, down, forward, center


@triton.jit
def store_pose_sums(of_pose, right, down, forward, center):
    """Write a program's sums of the gradients of the upper rows of ``camera_to_world``."""
    row = of_pose + 12 * tl.program_id(0)
    tl.store(row, tl.sum(right[0]))
    tl.store(row + 4, tl.sum(right[1]))
    tl.store(row + 8, tl.sum(right[2]))
    tl.store(row + 1, tl.sum(down[0]))
    tl.store(row + 5, tl.sum(down[1]))
    tl.store(row + 9, tl.sum(down[2]))
    tl.store(row + 2, tl.sum(forward[0]))
    tl.store(row + 6, tl.sum(forward[1]))
    tl.store(row + 10, tl.sum(forward[2]))
    tl.store(row + 3, tl.sum(center[0]))
    tl.store(row + 7, tl.sum(center[1]))
    tl.store(row + 11, tl.sum(center[2]))


@triton.jit
def in_camera(mean, axes, near_plane, here):
    """Mask of what is beyond the near plane; offset from the camera in world and in its axes, (0, 0, 1) where not."""
    right, down, forward, center = axes
    # Subtracting the centre before rotating keeps float32 accurate far from the world's origin.
    offset = plus(mean, times(-1.0, center))
    z = dot(offset, forward)
    in_front = here & (z > near_plane)
    x, y = tl.where(in_front, dot(offset, right), 0.0), tl.where(in_front, dot(offset, down), 0.0)
    return in_front, offset, (x, y, tl.where(in_front, z, 1.0))


@triton.jit
def load_quaternion(quats, row, here, DTYPE: tl.constexpr):
    """Normalised quaternions, w first, and one over the lengths of those given; (0, 0, 0, 0) where that is 0."""
    w, x = tl.load(quats + 4 * row, here, 0.0).to(DTYPE), tl.load(quats + 4 * row + 1, here, 0.0).to(DTYPE)
    y, z = tl.load(quats + 4 * row + 2, here, 0.0).to(DTYPE), tl.load(quats + 4 * row + 3, here, 0.0).to(DTYPE)
    inverse = 1.0 / tl.maximum(tl.sqrt(w * w + x * x + y * y + z * z), 1e-12)
    return (w * inverse, x * inverse, y * inverse, z * inverse), inverse


@triton.jit
def rotation_columns(quaternion):
    """Local axes in the world: columns of the rotation matrix."""
    w, x, y, z = quaternion
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    )


@triton.jit
def store_quaternion_gradient(of_quats, row, here, quaternion, inverse_norm, first, second, third):
    """Write gradients of the quaternions as given, from those of the columns of their rotations."""
    w, x, y, z = quaternion
    turn_x, turn_y, turn_z = second[2] - third[1], third[0] - first[2], first[1] - second[0]
    xy, xz, yz = first[1] + second[0], first[2] + third[0], second[2] + third[1]
    of_w = 2 * (x * turn_x + y * turn_y + z * turn_z)
    of_x = 2 * (w * turn_x + y * xy + z * xz - 2 * x * (second[1] + third[2]))
    of_y = 2 * (w * turn_y + x * xy + z * yz - 2 * y * (first[0] + third[2]))
    of_z = 2 * (w * turn_z + x * xz + y * yz - 2 * z * (first[0] + second[1]))
    along = of_w * w + of_x * x + of_y * y + of_z * z  # the length does not matter
    tl.store(of_quats + 4 * row, (of_w - along * w) * inverse_norm, here)
    tl.store(of_quats + 4 * row + 1, (of_x - along * x) * inverse_norm, here)
    tl.store(of_quats + 4 * row + 2, (of_y - along * y) * inverse_norm, here)
    tl.store(of_quats + 4 * row + 3, (of_z - along * z) * inverse_norm, here)


@triton.jit
def squared_distance_to_box(outline, left, right, top, bottom):
    """Smallest squared Mahalanobis distance from an ellipse's centre to a box whose sides are given as offsets from it.

    ``outline`` is u_xx, u_yx, u_yy, cov_xy / cov_xx and cov_xy / cov_yy. A convex quadratic has its minimum over a box
    at the centre if that is inside, else on an edge that faces it.
    """
    u_xx, u_yx, u_yy, upright, level = outline
    facing_x = tl.maximum(left, 0.0) + tl.minimum(right, 0.0)
    facing_y = tl.maximum(top, 0.0) + tl.minimum(bottom, 0.0)
    along_y = tl.minimum(tl.maximum(facing_x * upright, top), bottom)
    along_x = tl.minimum(tl.maximum(facing_y * level, left), right)
    upright_e, upright_f = u_xx * facing_x, u_yx * facing_x + u_yy * along_y
    level_e, level_f = u_xx * along_x, u_yx * along_x + u_yy * facing_y
    return tl.minimum(upright_e * upright_e + upright_f * upright_f, level_e * level_e + level_f * level_f)


@triton.jit
def filtered(row_x, row_y, eps2d):
    """Outline of an ellipse from the rows of V, covariance V V^T + eps2d I, and its variances xx and yy."""
    sharp_xx, sharp_yy = dot(row_x, row_x), dot(row_y, row_y)
    xx, xy, yy = sharp_xx + eps2d, dot(row_x, row_y), sharp_yy + eps2d
    # xx yy - xy^2 cancels for needles; this sum of squares is the same number (Cauchy-Binet) and does not.
    across = cross(row_x, row_y)
    determinant = dot(across, across) + eps2d * (sharp_xx + sharp_yy) + eps2d * eps2d
    u_xx, u_yy = 1.0 / tl.sqrt(xx), tl.sqrt(xx / determinant)
    return (u_xx, -u_yy * xy / xx, u_yy, xy / xx, xy / yy), xx, yy


@triton.jit
def store_tiles(boxes, row, here, drawn, box, grid, SIZE: tl.constexpr):
    """Write first and last column and row of the tiles that a box in pixels touches; none where not drawn."""
    left, right, top, bottom = box
    tl.store(boxes + 4 * row, tl.where(drawn, _tile(left, grid.columns, SIZE), 0), here)
    tl.store(boxes + 4 * row + 1, tl.where(drawn, _tile(right, grid.columns, SIZE), -1), here)
    tl.store(boxes + 4 * row + 2, tl.where(drawn, _tile(top, grid.rows, SIZE), 0), here)
    tl.store(boxes + 4 * row + 3, tl.where(drawn, _tile(bottom, grid.rows, SIZE), -1), here)


@triton.jit
def _tile(position, count, SIZE: tl.constexpr):
    return tl.minimum(tl.maximum(tl.floor(position / SIZE), 0.0), count - 1.0).to(tl.int32)


@triton.jit
def find_pairs(
    outlines, boxes, order, counts, ends, gaussian, tiles, count, columns,
    EMIT: tl.constexpr, SIZE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Count the tiles of each Gaussian; or, in the order given, write the pairs that end at ``ends``."""
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = place < count
    row = place
    if EMIT:
        row = tl.load(order + place, here, 0)
    entry = outlines + OUTLINE_COLUMNS * row
    center_x, center_y = tl.load(entry, here, 0.0), tl.load(entry + 1, here, 0.0)
    outline = (
        tl.load(entry + 2, here, 0.0),
        tl.load(entry + 3, here, 0.0),
        tl.load(entry + 4, here, 0.0),
        tl.load(entry + 5, here, 0.0),
        tl.load(entry + 6, here, 0.0),
    )
    rim = tl.load(entry + 7, here, -1.0)
    circle_x, circle_y = tl.load(entry + 8, here, 0.0), tl.load(entry + 9, here, 0.0)
    squared_radius = tl.load(entry + 10, here, -1.0)
    first, last = tl.load(boxes + 4 * row, here, 0), tl.load(boxes + 4 * row + 1, here, -1)
    upper, lower = tl.load(boxes + 4 * row + 2, here, 0), tl.load(boxes + 4 * row + 3, here, -1)
    across = last - first + 1
    area = across * (lower - upper + 1)
    pair_count = tl.zeros([BLOCK], tl.int32)
    begin = tl.zeros([BLOCK], tl.int64)
    if EMIT:
        counted = tl.load(counts + row, here, 0)
        begin = tl.load(ends + place, here, 0) - counted
    column, tile_row = first, upper
    step = 0
    most = tl.max(area)
    while step < most:
        x, y = (column * SIZE).to(tl.float32) + 0.5, (tile_row * SIZE).to(tl.float32) + 0.5
        left, top = x - center_x, y - center_y
        nearest = squared_distance_to_box(outline, left, left + (SIZE - 1), top, top + (SIZE - 1))
        out_x = tl.maximum(x - circle_x, 0.0) + tl.minimum(x + (SIZE - 1) - circle_x, 0.0)
        out_y = tl.maximum(y - circle_y, 0.0) + tl.minimum(y + (SIZE - 1) - circle_y, 0.0)
        hit = (step < area) & ((nearest <= rim) | (out_x * out_x + out_y * out_y <= squared_radius))
        if EMIT:
            # Counted by the same numbers, but maybe not rounded alike: never write more pairs than were counted.
            hit = hit & (pair_count < counted)
            tl.store(gaussian + begin + pair_count, row.to(tl.int32), hit)
            tl.store(tiles + begin + pair_count, tile_row * columns + column, hit)
        pair_count += hit.to(tl.int32)
        ends_row = column == last
        tile_row += ends_row.to(tl.int32)
        column = tl.where(ends_row, first, column + 1)
        step += 1
    if not EMIT:
        tl.store(counts + row, pair_count, here)
