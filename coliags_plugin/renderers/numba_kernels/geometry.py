"""Geometry shared by the stages: camera axes, rotations, the rows of V, and the intersections of rays with discs.

Sixteen Gaussians at a time; a vector in space is a tuple of three lanes. Surfels are placed in float64: seen nearly
edge-on, a disc magnifies the rounding of its position and axes by the reciprocal of the angle.
"""

from __future__ import annotations

from typing import NamedTuple

from coliags_plugin.core.numba_kernels import lanes as vec
from coliags_plugin.core.numba_kernels.compilation import inline
from coliags_plugin.renderers.numba_kernels import layout

#: More than rounding can be of a sum of products, relative to the sum of their magnitudes.
_ROUNDING = 1e-5


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
    """Masks of where the second, and where the third axis is the shortest; where neither is, the first. Ties go forwards."""
    return vec.less(scale[1], scale[0]), vec.less(scale[2], vec.smaller(scale[0], scale[1]))


@inline
def shortest_column(rotation, second, third):
    """The column of the rotation that :func:`shortest_axes` chose: the shortest axis in the world."""
    a, b, c = rotation
    return vec.select(third, (a[2], b[2], c[2]), vec.select(second, (a[1], b[1], c[1]), (a[0], b[0], c[0])))


# --- surfels ----------------------------------------------------------------------------------------------------------


class Placed(NamedTuple):
    """Sixteen surfels before the camera; those not ``in_front`` have a stand-in position in camera axes.

    A ray (x, y, 1), turned into the world, meets the disc's plane where its products with ``of_first``, ``of_second`` and
    ``of_z`` are the coordinates along the two axes, from the centre, and 1, all divided by the z-depth there. These three
    are infinite where edge-on.
    """

    in_front: vec.LaneMask  # whether the centre is beyond the near plane
    offset: tuple[vec.Vector, ...]  # of the centre from the camera's, world axes
    x: vec.Vector  # the same in camera axes
    y: vec.Vector
    z: vec.Vector
    inverse_z: vec.Vector
    quaternion: tuple[vec.Vector, ...]  # normalised, w first
    inverse_norm: vec.Vector  # 1 / length of the quaternion given
    first: tuple[vec.Vector, ...]  # local axes in the world: columns of the rotation
    second: tuple[vec.Vector, ...]
    normal: tuple[vec.Vector, ...]
    height: vec.Vector  # of the disc's plane above the camera, along the normal; 0 where edge-on
    of_first: tuple[vec.Vector, ...]
    of_second: tuple[vec.Vector, ...]
    of_z: tuple[vec.Vector, ...]


@inline
def place_surfels(mean, quat, view):
    """Everything but scales. ``mean`` and ``quat`` are tuples of lanes, ``view`` the table ``layout`` describes."""
    offset = vec.sub(vec.widen(mean), vec.broadcast_all(view, layout.VIEW_CENTER, (0, 0, 0)))
    z = vec.dot(offset, vec.broadcast_all(view, layout.VIEW_FORWARD, (0, 0, 0)), 0.0)
    in_front = vec.greater(z, vec.broadcast(view, layout.VIEW_NEAR))
    x = vec.select(in_front, vec.dot(offset, vec.broadcast_all(view, layout.VIEW_RIGHT, (0, 0, 0)), 0.0), 0.0)
    y = vec.select(in_front, vec.dot(offset, vec.broadcast_all(view, layout.VIEW_DOWN, (0, 0, 0)), 0.0), 0.0)
    z = vec.select(in_front, z, 1.0)

    quaternion = vec.widen(quat)
    inverse_norm = vec.div(1.0, vec.sqrt(vec.dot(quaternion, quaternion, 0.0)))
    quaternion = vec.mul(quaternion, inverse_norm)
    a, b, c = rotation_rows(quaternion)
    first, second, normal = (a[0], b[0], c[0]), (a[1], b[1], c[1]), (a[2], b[2], c[2])
    height = vec.dot(normal, offset, 0.0)
    inverse_height = vec.div(1.0, height)
    of_first, of_second = vec.mul(cross(second, offset), inverse_height), vec.mul(cross(offset, first), inverse_height)
    return Placed(
        in_front, offset, x, y, z, vec.div(1.0, z), quaternion, inverse_norm, first, second, normal, height,
        of_first, of_second, vec.mul(normal, inverse_height),
    )  # fmt: skip


@inline
def may_show(slopes, rim, largest_q, x, y, half_x, half_y):
    """Mask of the discs whose part beyond the near plane may be seen in a box of the image. Never False where it is.

    The square around the disc and the near plane bound it by lines: it is not seen in a box beyond one of these. ``slopes``
    are the columns of records from SURFEL_U_X to SURFEL_Q_Y, ``rim`` is the length of (e, f) at the disc's rim, ``largest_q``
    is q at the near plane; the box's middle, from the projected centre, and half its edges are in scaled pixels.
    """
    u_x, u_y, v_x, v_y, q_x, q_y = slopes
    u = (vec.fma(u_x, x, vec.mul(u_y, y)), u_x, u_y, vec.add(_size(vec.mul(u_x, x)), _size(vec.mul(u_y, y))))
    v = (vec.fma(v_x, x, vec.mul(v_y, y)), v_x, v_y, vec.add(_size(vec.mul(v_x, x)), _size(vec.mul(v_y, y))))
    magnitude = vec.add(vec.add(_size(vec.mul(q_x, x)), _size(vec.mul(q_y, y))), 1.0)
    q = (vec.fma(q_x, x, vec.fma(q_y, y, 1.0)), q_x, q_y, magnitude)
    end = (vec.sub(largest_q, q[0]), vec.neg(q_x), vec.neg(q_y), vec.add(largest_q, magnitude))
    edge = vec.mul(rim, q)
    may_reach = vec.both(_reaches_zero(q, half_x, half_y), _reaches_zero(end, half_x, half_y))
    for side in (u, v):
        size = vec.add(edge[3], side[3])
        over = (vec.sub(edge[0], side[0]), vec.sub(edge[1], side[1]), vec.sub(edge[2], side[2]), size)
        under = (vec.add(edge[0], side[0]), vec.add(edge[1], side[1]), vec.add(edge[2], side[2]), size)
        may_reach = vec.both(
            may_reach, vec.both(_reaches_zero(over, half_x, half_y), _reaches_zero(under, half_x, half_y))
        )
    return may_reach


@inline
def _size(a):
    return vec.larger(a, vec.neg(a))


@inline
def _reaches_zero(function, half_x, half_y):
    """True if a linear function is at least 0 anywhere in a box: value in the middle, slopes, and size of its terms."""
    value, slope_x, slope_y, magnitude = function
    most = vec.add(value, vec.fma(_size(slope_x), half_x, vec.mul(_size(slope_y), half_y)))
    return vec.at_least(vec.fma(magnitude, _ROUNDING, most), 0.0)
