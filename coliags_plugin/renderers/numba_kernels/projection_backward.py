"""Sums over entries -> derivatives of the loss with respect to the Gaussians and the camera's pose.

``gather`` adds up the entries of each Gaussian, in the order of its tiles, and finds the derivative with respect to
means2d; ``project_backward`` takes it from there through the formulas of ``docs/rendering.md``, section "Projection".
"""

from __future__ import annotations

import numba

from coliags_plugin.renderers.numba_kernels import layout
from coliags_plugin.renderers.numba_kernels.compilation import inline, kernel, part
from coliags_plugin.renderers.numba_kernels.geometry import project_axes, shortest_axes
from coliags_plugin.renderers.numba_kernels.lanes import (
    add,
    both,
    broadcast,
    broadcast_all,
    div,
    dot,
    flags,
    fma,
    greater,
    lane,
    lane_sums,
    load,
    load_columns,
    mul,
    neg,
    select,
    splat,
    store,
    store_columns,
    sub,
)
from coliags_plugin.renderers.numba_kernels.projection import PARCEL
from coliags_plugin.renderers.numba_kernels.threads import take

#: d ln(alpha) / d |U d|^2 is minus this, for the scaled U.
_LN_2 = 1.0 / (2.0 * layout.U_FACTOR_SQUARED)
