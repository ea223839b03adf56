"""Geometry shared by the stages of surfels. That of projection and its derivative is in float64.

Seen nearly edge-on, a disc magnifies the rounding of its position and axes by the reciprocal of the angle; in float64
that of the projection does not matter. Sixteen surfels at a time; a vector in space is a tuple of three double lanes.
"""

from __future__ import annotations

from typing import NamedTuple

from coliags_plugin.core.numba_kernels import lanes as vec
from coliags_plugin.core.numba_kernels.compilation import inline
from coliags_plugin.renderers.numba_kernels import layout
from coliags_plugin.renderers.numba_kernels.geometry import cross, rotation_rows

#: More than rounding can be of a sum of products, relative to the sum of their magnitudes.
_ROUNDING = 1e-5


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
    """Whether the part of a disc beyond the near plane may be seen in a box of the image. Never False where it is.

    The square around the disc and the near plane bound it by lines: it is not seen in a box beyond one of these. ``slopes``
    are the columns of ``surfel_layout`` from U_X to Q_Y, ``rim`` is the length of (e, f) at the disc's rim, ``largest_q``
    is q at the near plane; the box's middle, from the projected centre, and half its edges are in scaled pixels.
    """
    u_x, u_y, v_x, v_y, q_x, q_y = slopes
    u = (vec.fma(u_x, x, vec.mul(u_y, y)), u_x, u_y, vec.add(_size(vec.mul(u_x, x)), _size(vec.mul(u_y, y))))
    v = (vec.fma(v_x, x, vec.mul(v_y, y)), v_x, v_y, vec.add(_size(vec.mul(v_x, x)), _size(vec.mul(v_y, y))))
    magnitude = vec.add(vec.add(_size(vec.mul(q_x, x)), _size(vec.mul(q_y, y))), 1.0)
    q = (vec.fma(q_x, x, vec.fma(q_y, y, 1.0)), q_x, q_y, magnitude)
    end = (vec.sub(largest_q, q[0]), vec.neg(q_x), vec.neg(q_y), vec.add(largest_q, magnitude))
    edge = vec.mul(rim, q)
    found = vec.both(_reaches_zero(q, half_x, half_y), _reaches_zero(end, half_x, half_y))
    for side in (u, v):
        size = vec.add(edge[3], side[3])
        over = (vec.sub(edge[0], side[0]), vec.sub(edge[1], side[1]), vec.sub(edge[2], side[2]), size)
        under = (vec.add(edge[0], side[0]), vec.add(edge[1], side[1]), vec.add(edge[2], side[2]), size)
        found = vec.both(found, vec.both(_reaches_zero(over, half_x, half_y), _reaches_zero(under, half_x, half_y)))
    return found


@inline
def _size(a):
    return vec.larger(a, vec.neg(a))


@inline
def _reaches_zero(function, half_x, half_y):
    """Whether a linear function is at least 0 anywhere in a box: value in the middle, slopes, and size of its terms."""
    value, slope_x, slope_y, magnitude = function
    most = vec.add(value, vec.fma(_size(slope_x), half_x, vec.mul(_size(slope_y), half_y)))
    return vec.at_least(vec.fma(magnitude, _ROUNDING, most), 0.0)
