"""Geometry shared by projection and its derivative: camera axes, rotations, and the rows of V.

Sixteen Gaussians at a time; a vector in space is a tuple of three lanes.
"""

from __future__ import annotations

from typing import NamedTuple

from coliags_plugin.core.numba_compilation import inline
from coliags_plugin.renderers.numba_kernels import layout
from coliags_plugin.renderers.numba_kernels.lanes import (
    LaneMask,
    Vector,
    add,
    at_least,
    at_most,
    both,
    broadcast,
    broadcast_all,
    div,
    dot,
    fma,
    greater,
    larger,
    less,
    mul,
    neg,
    select,
    smaller,
    sqrt,
    sub,
)


class Projected(NamedTuple):
    """Sixteen Gaussians in camera coordinates; those not ``in_front`` have a stand-in position.

    Attributes:
        in_front: Whether beyond the near plane.
        offset: From the camera's centre, world axes.
        x, y, z: The same in camera axes.
        inverse_z: 1 / z
        slope_x, slope_y: x / z and y / z, clamped.
        follows_x, follows_y: Where they are not.
        rotation: Rows of the rotation matrix.
        quaternion: Normalised, w first.
        inverse_norm: 1 / length of the quaternion given.
        squared_norm: Its length, squared.
        image_x, image_y: Rows of J C^T: pixels moved along x or y for a step in the world.
        local_x, local_y: The same for a step along the local axes: rows of J C^T R.
    """

    in_front: LaneMask
    offset: tuple[Vector, ...]
    x: Vector
    y: Vector
    z: Vector
    inverse_z: Vector
    slope_x: Vector
    slope_y: Vector
    follows_x: LaneMask
    follows_y: LaneMask
    rotation: tuple[tuple[Vector, ...], ...]
    quaternion: tuple[Vector, ...]
    inverse_norm: Vector
    squared_norm: Vector
    image_x: tuple[Vector, ...]
    image_y: tuple[Vector, ...]
    local_x: tuple[Vector, ...]
    local_y: tuple[Vector, ...]


@inline
def camera_axes(view):
    """The camera's axes in the world: right, down, forward."""
    three = (0, 0, 0)
    right, down = broadcast_all(view, layout.VIEW_RIGHT, three), broadcast_all(view, layout.VIEW_DOWN, three)
    return right, down, broadcast_all(view, layout.VIEW_FORWARD, three)


@inline
def project_axes(mean, quat, view):
    """Everything but scales. ``mean`` and ``quat`` are tuples of lanes, ``view`` the table ``layout`` describes."""
    right, down, forward = camera_axes(view)
    # Subtracting the centre before rotating keeps float32 accurate far from the world's origin.
    offset = sub(mean, broadcast_all(view, layout.VIEW_CENTER, (0, 0, 0)))
    z = dot(offset, forward, 0.0)
    in_front = greater(z, broadcast(view, layout.VIEW_NEAR))
    x = select(in_front, dot(offset, right, 0.0), 0.0)
    y = select(in_front, dot(offset, down, 0.0), 0.0)
    z = select(in_front, z, 1.0)
    inverse_z = div(1.0, z)
    free_x, free_y = mul(x, inverse_z), mul(y, inverse_z)
    slope_x_min, slope_x_max = broadcast(view, layout.VIEW_SLOPE_X_MIN), broadcast(view, layout.VIEW_SLOPE_X_MAX)
    slope_y_min, slope_y_max = broadcast(view, layout.VIEW_SLOPE_Y_MIN), broadcast(view, layout.VIEW_SLOPE_Y_MAX)
    slope_x = larger(smaller(free_x, slope_x_max), slope_x_min)
    slope_y = larger(smaller(free_y, slope_y_max), slope_y_min)
    follows_x = both(at_least(free_x, slope_x_min), at_most(free_x, slope_x_max))
    follows_y = both(at_least(free_y, slope_y_min), at_most(free_y, slope_y_max))

    squared_norm = dot(quat, quat, 0.0)
    inverse_norm = div(1.0, sqrt(squared_norm))
    quaternion = mul(quat, inverse_norm)
    rotation = rotation_rows(quaternion)

    per_x = mul(broadcast(view, layout.VIEW_FX), inverse_z)
    per_y = mul(broadcast(view, layout.VIEW_FY), inverse_z)
    image_x = mul(per_x, fma(neg(slope_x), forward, right))
    image_y = mul(per_y, fma(neg(slope_y), forward, down))
    local_x, local_y = rotated_back(rotation, image_x), rotated_back(rotation, image_y)
    return Projected(
        in_front, offset, x, y, z, inverse_z, slope_x, slope_y, follows_x, follows_y, rotation, quaternion,
        inverse_norm, squared_norm, image_x, image_y, local_x, local_y,
    )  # fmt: skip


@inline
def rotation_rows(quaternion):
    """Rows of the rotation matrix of a unit quaternion, w first."""
    w, x, y, z = quaternion
    two_x, two_y, two_z = add(x, x), add(y, y), add(z, z)
    xx, yy, zz = mul(x, two_x), mul(y, two_y), mul(z, two_z)
    xy, xz, yz = mul(x, two_y), mul(x, two_z), mul(y, two_z)
    wx, wy, wz = mul(w, two_x), mul(w, two_y), mul(w, two_z)
    return (
        (sub(1.0, add(yy, zz)), sub(xy, wz), add(xz, wy)),
        (add(xy, wz), sub(1.0, add(xx, zz)), sub(yz, wx)),
        (sub(xz, wy), add(yz, wx), sub(1.0, add(xx, yy))),
    )


@inline
def rotated_back(rotation, vector):
    """The transposed rotation times a vector: world axes -> local axes."""
    a, b, c = rotation
    return fma(vector[2], c, fma(vector[1], b, mul(vector[0], a)))


@inline
def cross(a, b):
    """Cross product."""
    return (
        fma(a[1], b[2], neg(mul(a[2], b[1]))),
        fma(a[2], b[0], neg(mul(a[0], b[2]))),
        fma(a[0], b[1], neg(mul(a[1], b[0]))),
    )


@inline
def squared_distance_to_box(u_xx, u_yx, u_yy, slope_upright, slope_level, left, right, top, bottom):
    """Smallest |U d|^2 of an offset d in a box; the box's sides are given as offsets from the Gaussian's centre.

    A convex quadratic has its minimum over a box at the centre if that is inside, else on an edge that faces it; along
    an upright edge at dx the best dy is dx cov_xy / cov_xx, clamped to the edge's ends (and likewise for level edges).
    """
    facing_x = add(larger(left, 0.0), smaller(right, 0.0))
    facing_y = add(larger(top, 0.0), smaller(bottom, 0.0))
    along_y = smaller(larger(mul(facing_x, slope_upright), top), bottom)
    along_x = smaller(larger(mul(facing_y, slope_level), left), right)
    upright_e, upright_f = mul(u_xx, facing_x), fma(u_yx, facing_x, mul(u_yy, along_y))
    level_e, level_f = mul(u_xx, along_x), fma(u_yx, along_x, mul(u_yy, facing_y))
    upright = fma(upright_e, upright_e, mul(upright_f, upright_f))
    level = fma(level_e, level_e, mul(level_f, level_f))
    return smaller(upright, level)


@inline
def shortest_axes(scale):
    """Whether the second, and whether the third axis is the shortest; where neither is, the first. Ties go forwards."""
    return less(scale[1], scale[0]), less(scale[2], smaller(scale[0], scale[1]))


@inline
def shortest_column(rotation, second, third):
    """The column of the rotation that :func:`shortest_axes` chose: the shortest axis in the world."""
    a, b, c = rotation
    return select(third, (a[2], b[2], c[2]), select(second, (a[1], b[1], c[1]), (a[0], b[0], c[0])))
