"""Geometry shared by the projection of surfels and its derivative, in float64.

Seen nearly edge-on, a disc magnifies the rounding of its position and axes by the reciprocal of the angle; in float64
that of the projection does not matter. Sixteen surfels at a time; a vector in space is a tuple of three double lanes.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from coliags_plugin.renderers.numba_kernels import layout
from coliags_plugin.renderers.numba_kernels.compilation import inline
from coliags_plugin.renderers.numba_kernels.geometry import cross, rotation_rows
from coliags_plugin.renderers.numba_kernels.lanes import (
    broadcast,
    broadcast_all,
    div,
    dot,
    greater,
    mul,
    select,
    sqrt,
    sub,
    widen,
)


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

    in_front: Any
    offset: Any
    x: Any
    y: Any
    z: Any
    inverse_z: Any
    quaternion: Any
    inverse_norm: Any
    first: Any
    second: Any
    normal: Any
    height: Any
    of_first: Any
    of_second: Any
    of_z: Any


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
    return Placed(
        in_front,
        offset,
        x,
        y,
        z,
        div(1.0, z),
        quaternion,
        inverse_norm,
        first,
        second,
        normal,
        height,
        mul(cross(second, offset), inverse_height),
        mul(cross(offset, first), inverse_height),
        mul(normal, inverse_height),
    )
