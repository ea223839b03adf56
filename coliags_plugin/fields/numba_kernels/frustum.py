"""Frustum culling of anchors with their children."""

from __future__ import annotations

import math

import numpy as np

from coliags_plugin.core.numba_kernels.compilation import kernel
from coliags_plugin.core.numba_kernels.threads import pieces

#: Anchors that a thread takes at a time.
PARCEL = 1024


@kernel
def find_visible(counters, children, sigmas, positions, offsets, sizes, center, planes, near_plane, visible):
    """Write which anchors have a child that may overlap the image: one in a sphere that ``spheres_in_frustum`` finds inside.

    ``positions`` [M, 3], ``offsets`` [M, K, 3] and ``sizes``, the exponentials of the scalings [M, 6], are flat float32 tables;
    ``sigmas`` is the reach of a Gaussian in standard deviations, and ``planes`` are those of ``frustum_planes``. [5, 3]
    """
    for parcel in pieces(counters, 0, -(-len(visible) // PARCEL)):
        for m in range(parcel * PARCEL, min((parcel + 1) * PARCEL, len(visible))):
            size_x, size_y, size_z = sizes[6 * m], sizes[6 * m + 1], sizes[6 * m + 2]
            farthest = np.float32(0.0)
            for at in range(3 * children * m, 3 * children * (m + 1), 3):
                x, y, z = offsets[at] * size_x, offsets[at + 1] * size_y, offsets[at + 2] * size_z
                farthest = max(farthest, x * x + y * y + z * z)
            largest = max(sizes[6 * m + 3], sizes[6 * m + 4], sizes[6 * m + 5])
            radius = math.sqrt(farthest) + sigmas * largest
            x, y, z = positions[3 * m] - center[0], positions[3 * m + 1] - center[1], positions[3 * m + 2] - center[2]
            inside = planes[0] * x + planes[1] * y + planes[2] * z + radius > near_plane
            for i in range(3, 15, 3):
                inside = inside and planes[i] * x + planes[i + 1] * y + planes[i + 2] * z + radius > 0.0
            visible[m] = inside
