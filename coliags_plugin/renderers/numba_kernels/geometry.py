"""Geometry shared by projection and its derivative: camera axes, rotations, and the rows of V.

Sixteen Gaussians at a time; a vector in space is a tuple of three lanes.
"""

from __future__ import annotations

from typing import NamedTuple

from coliags_plugin.core.numba_kernels import lanes as vec
from coliags_plugin.core.numba_kernels.compilation import inline
from coliags_plugin.renderers.numba_kernels import layout


class Projected(NamedTuple):
    """Sixteen Gaussians in camera coordinates; those not ``in_front`` have a stand-in position."""

    in_front: vec.LaneMask  # whether beyond the near plane
    offset: tuple[vec.Vector, ...]  # from the camera's centre, world axes
    x: vec.Vector  # the same in camera axes
    y: vec.Vector
    z: vec.Vector
    inverse_z: vec.Vector
    slope_x: vec.Vector  # x / z, clamped
    slope_y: vec.Vector  # y / z, clamped
    follows_x: vec.LaneMask  # where it is not
    follows_y: vec.LaneMask
    rotation: tuple[tuple[vec.Vector, ...], ...]  # rows of the rotation matrix
    quaternion: tuple[vec.Vector, ...]  # normalised, w first
    inverse_norm: vec.Vector  # 1 / length of the quaternion given
    squared_norm: vec.Vector  # its length, squared
    image_x: tuple[vec.Vector, ...]  # rows of J C^T: pixels moved along x or y for a step in the world
    image_y: tuple[vec.Vector, ...]
    local_x: tuple[vec.Vector, ...]  # the same for a step along the local axes: rows of J C^T R
    local_y: tuple[vec.Vector, ...]


@inline
def camera_axes(view):
    """The camera's axes in the world: right, down, forward."""
    three = (0, 0, 0)
    right, down = vec.broadcast_all(view, layout.VIEW_RIGHT, three), vec.broadcast_all(view, layout.VIEW_DOWN, three)
    return right, down, vec.broadcast_all(view, layout.VIEW_FORWARD, three)


@inline
def project_axes(mean, quat, view):
    """Everything but scales. ``mean`` and ``quat`` are tuples of lanes, ``view`` the table ``layout`` describes."""
    right, down, forward = camera_axes(view)
    # Subtracting the centre before rotating keeps float32 accurate far from the world's origin.
    offset = vec.sub(mean, vec.broadcast_all(view, layout.VIEW_CENTER, (0, 0, 0)))
    z = vec.dot(offset, forward, 0.0)
    in_front = vec.greater(z, vec.broadcast(view, layout.VIEW_NEAR))
    x = vec.select(in_front, vec.dot(offset, right, 0.0), 0.0)
    y = vec.select(in_front, vec.dot(offset, down, 0.0), 0.0)
    z = vec.select(in_front, z, 1.0)
    inverse_z = vec.div(1.0, z)
    free_x, free_y = vec.mul(x, inverse_z), vec.mul(y, inverse_z)
    limits = vec.broadcast_all(view, layout.VIEW_SLOPE_LIMITS, (0, 0, 0, 0))
    slope_x_min, slope_x_max, slope_y_min, slope_y_max = limits
    slope_x = vec.larger(vec.smaller(free_x, slope_x_max), slope_x_min)
    slope_y = vec.larger(vec.smaller(free_y, slope_y_max), slope_y_min)
    follows_x = vec.both(vec.at_least(free_x, slope_x_min), vec.at_most(free_x, slope_x_max))
    follows_y = vec.both(vec.at_least(free_y, slope_y_min), vec.at_most(free_y, slope_y_max))

    squared_norm = vec.dot(quat, quat, 0.0)
    inverse_norm = vec.div(1.0, vec.sqrt(squared_norm))
    quaternion = vec.mul(quat, inverse_norm)
    rotation = rotation_rows(quaternion)

    per_x = vec.mul(vec.broadcast(view, layout.VIEW_FX), inverse_z)
    per_y = vec.mul(vec.broadcast(view, layout.VIEW_FY), inverse_z)
    image_x = vec.mul(per_x, vec.fma(vec.neg(slope_x), forward, right))
    image_y = vec.mul(per_y, vec.fma(vec.neg(slope_y), forward, down))
    local_x, local_y = rotated_back(rotation, image_x), rotated_back(rotation, image_y)
    return Projected(
        in_front, offset, x, y, z, inverse_z, slope_x, slope_y, follows_x, follows_y, rotation, quaternion,
        inverse_norm, squared_norm, image_x, image_y, local_x, local_y,
    )  # fmt: skip


@inline
def rotation_rows(quaternion):
    """Rows of the rotation matrix of a unit quaternion, w first."""
    w, x, y, z = quaternion
    two_x, two_y, two_z = vec.add(x, x), vec.add(y, y), vec.add(z, z)
    xx, yy, zz = vec.mul(x, two_x), vec.mul(y, two_y), vec.mul(z, two_z)
    xy, xz, yz = vec.mul(x, two_y), vec.mul(x, two_z), vec.mul(y, two_z)
    wx, wy, wz = vec.mul(w, two_x), vec.mul(w, two_y), vec.mul(w, two_z)
    return (
        (vec.sub(1.0, vec.add(yy, zz)), vec.sub(xy, wz), vec.add(xz, wy)),
        (vec.add(xy, wz), vec.sub(1.0, vec.add(xx, zz)), vec.sub(yz, wx)),
        (vec.sub(xz, wy), vec.add(yz, wx), vec.sub(1.0, vec.add(xx, yy))),
    )


@inline
def rotated_back(rotation, vector):
    """The transposed rotation times a vector: world axes -> local axes."""
    a, b, c = rotation
    return vec.fma(vector[2], c, vec.fma(vector[1], b, vec.mul(vector[0], a)))


@inline
def cross(a, b):
    """Cross product."""
    return (
        vec.fma(a[1], b[2], vec.neg(vec.mul(a[2], b[1]))),
        vec.fma(a[2], b[0], vec.neg(vec.mul(a[0], b[2]))),
        vec.fma(a[0], b[1], vec.neg(vec.mul(a[1], b[0]))),
    )


@inline
def squared_distance_to_box(u_xx, u_yx, u_yy, slope_upright, slope_level, left, right, top, bottom):
    """Smallest |U d|^2 of an offset d in a box; the box's sides are given as offsets from the Gaussian's centre.

    A convex quadratic has its minimum over a box at the centre if that is inside, else on an edge that faces it; along
    an upright edge at dx the best dy is dx cov_xy / cov_xx, clamped to the edge's ends (and likewise for level edges).
    """
    facing_x = vec.add(vec.larger(left, 0.0), vec.smaller(right, 0.0))
    facing_y = vec.add(vec.larger(top, 0.0), vec.smaller(bottom, 0.0))
    along_y = vec.smaller(vec.larger(vec.mul(facing_x, slope_upright), top), bottom)
    along_x = vec.smaller(vec.larger(vec.mul(facing_y, slope_level), left), right)
    upright_e, upright_f = vec.mul(u_xx, facing_x), vec.fma(u_yx, facing_x, vec.mul(u_yy, along_y))
    level_e, level_f = vec.mul(u_xx, along_x), vec.fma(u_yx, along_x, vec.mul(u_yy, facing_y))
    upright = vec.fma(upright_e, upright_e, vec.mul(upright_f, upright_f))
    level = vec.fma(level_e, level_e, vec.mul(level_f, level_f))
    return vec.smaller(upright, level)


@inline
def shortest_axes(scale):
    """Whether the second, and whether the third axis is the shortest; where neither is, the first. Ties go forwards."""
    return vec.less(scale[1], scale[0]), vec.less(scale[2], vec.smaller(scale[0], scale[1]))


@inline
def shortest_column(rotation, second, third):
    """The column of the rotation that :func:`shortest_axes` chose: the shortest axis in the world."""
    a, b, c = rotation
    return vec.select(third, (a[2], b[2], c[2]), vec.select(second, (a[1], b[1], c[1]), (a[0], b[0], c[0])))
