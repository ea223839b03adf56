"""Geometry shared by the stages of surfels. That of projection and its derivative is in float64.

Seen nearly edge-on, a disc magnifies the rounding of its position and axes by the reciprocal of the angle; in float64
that of the projection does not matter. Sixteen surfels at a time; a vector in space is a tuple of three double lanes.
"""

from __future__ import annotations

from typing import NamedTuple

from coliags_plugin.core.numba_compilation import inline
from coliags_plugin.renderers.numba_kernels import layout
from coliags_plugin.renderers.numba_kernels.geometry import cross, rotation_rows
from coliags_plugin.renderers.numba_kernels.lanes import (
    LaneMask,
    Vector,
    add,
    at_least,
    both,
    broadcast,
    broadcast_all,
    div,
    dot,
    fma,
    greater,
    larger,
    mul,
    neg,
    select,
    sqrt,
    sub,
    widen,
)

#: More than rounding can be of a sum of products, relative to the sum of their magnitudes.
_ROUNDING = 1e-5


class Placed(NamedTuple):
    """Sixteen surfels before the camera; those not ``in_front`` have a stand-in position in camera axes.

    Attributes:
        in_front: Whether the centre is beyond the near plane.
        offset: Of the centre from the camera's, world axes.
        x, y, z: The same in camera axes.
        inverse_z: 1 / z
        quaternion: Normalised, w first.
        inverse_norm: 1 / length of the quaternion given.
        first, second, normal: Local axes in the world: columns of the rotation.
        height: Of the disc's plane above the camera, along the normal; 0 where edge-on.
        of_first, of_second, of_z: Where a ray (x, y, 1), turned into the world, meets the plane: its products with these
            are the coordinates along the two axes, from the centre, and 1, all divided by the z-depth there. Infinite
            where edge-on.
    """

    in_front: LaneMask
    offset: tuple[Vector, ...]
    x: Vector
    y: Vector
    z: Vector
    inverse_z: Vector
    quaternion: tuple[Vector, ...]
    inverse_norm: Vector
    first: tuple[Vector, ...]
    second: tuple[Vector, ...]
    normal: tuple[Vector, ...]
    height: Vector
    of_first: tuple[Vector, ...]
    of_second: tuple[Vector, ...]
    of_z: tuple[Vector, ...]


@inline
def place_surfels(mean, quat, view):
    """Everything but scales. ``mean`` and ``quat`` are tuples of lanes, ``view`` the table ``layout`` describes."""
    offset = sub(widen(mean), broadcast_all(view, layout.VIEW_CENTER, (0, 0, 0)))
    z = dot(offset, broadcast_all(view, layout.VIEW_FORWARD, (0, 0, 0)), 0.0)
    in_front = greater(z, broadcast(view, layout.VIEW_NEAR))
    x = select(in_front, dot(offset, broadcast_all(view, layout.VIEW_RIGHT, (0, 0, 0)), 0.0), 0.0)
    y = select(in_front, dot(offset, broadcast_all(view, layout.VIEW_DOWN, (0, 0, 0)), 0.0), 0.0)
    z = select(in_front, z, 1.0)

    quaternion = widen(quat)
    inverse_norm = div(1.0, sqrt(dot(quaternion, quaternion, 0.0)))
    quaternion = mul(quaternion, inverse_norm)
    a, b, c = rotation_rows(quaternion)
    first, second, normal = (a[0], b[0], c[0]), (a[1], b[1], c[1]), (a[2], b[2], c[2])
    height = dot(normal, offset, 0.0)
    inverse_height = div(1.0, height)
    of_first, of_second = mul(cross(second, offset), inverse_height), mul(cross(offset, first), inverse_height)
    return Placed(
        in_front, offset, x, y, z, div(1.0, z), quaternion, inverse_norm, first, second, normal, height,
        of_first, of_second, mul(normal, inverse_height),
    )  # fmt: skip


@inline
def may_show(slopes, rim, largest_q, x, y, half_x, half_y):
    """Whether the part of a disc beyond the near plane may be seen in a box of the image. Never False where it is.

    The square around the disc and the near plane bound it by lines: it is not seen in a box beyond one of these.

    Args:
        slopes: The columns of ``surfel_layout`` from U_X to Q_Y.
        rim: Length of (e, f) at the disc's rim.
        largest_q: Where the disc is at the near plane.
        x, y: The box's middle from the projected centre, scaled pixels.
        half_x, half_y: Half its edges, likewise.
    """
    u_x, u_y, v_x, v_y, q_x, q_y = slopes
    u = (fma(u_x, x, mul(u_y, y)), u_x, u_y, add(_size(mul(u_x, x)), _size(mul(u_y, y))))
    v = (fma(v_x, x, mul(v_y, y)), v_x, v_y, add(_size(mul(v_x, x)), _size(mul(v_y, y))))
    magnitude = add(add(_size(mul(q_x, x)), _size(mul(q_y, y))), 1.0)
    q = (fma(q_x, x, fma(q_y, y, 1.0)), q_x, q_y, magnitude)
    end = (sub(largest_q, q[0]), neg(q_x), neg(q_y), add(largest_q, magnitude))
    edge = mul(rim, q)
    found = both(_reaches_zero(q, half_x, half_y), _reaches_zero(end, half_x, half_y))
    for side in (u, v):
        size = add(edge[3], side[3])
        over = (sub(edge[0], side[0]), sub(edge[1], side[1]), sub(edge[2], side[2]), size)
        under = (add(edge[0], side[0]), add(edge[1], side[1]), add(edge[2], side[2]), size)
        found = both(found, both(_reaches_zero(over, half_x, half_y), _reaches_zero(under, half_x, half_y)))
    return found


@inline
def _size(a):
    return larger(a, neg(a))


@inline
def _reaches_zero(function, half_x, half_y):
    """Whether a linear function is at least 0 anywhere in a box: value in the middle, slopes, and size of its terms."""
    value, slope_x, slope_y, magnitude = function
    most = add(value, fma(_size(slope_x), half_x, mul(_size(slope_y), half_y)))
    return at_least(fma(magnitude, _ROUNDING, most), 0.0)
