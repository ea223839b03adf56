"""Data layout of the tables for surfels, where it differs from that for 3D Gaussians in ``layout``.

With d the offset of a pixel from the projected centre, in units of 1 / ``VIEW_PIXEL_SCALE`` pixels, the ray through
it meets the disc's plane at z-depth ``DEPTH`` / q and at (e, f) = (U d, V d) / q with q = 1 + Q d, where U, V and Q
are the pairs of columns below. (e, f) are standard deviations times ``layout.U_FACTOR``, and so is d for those of the
low-pass filter, so that log2(alpha) = log2(opacity) - min(e^2 + f^2, |d|^2).
"""

from __future__ import annotations

from typing import NamedTuple

from coliags_plugin.renderers.numba_kernels import layout

# Columns of ``records``.
U_X = 0
U_Y = 1
V_X = 2
V_Y = 3
Q_X = 4
Q_Y = 5
MEAN_X = 6  # pixels
MEAN_Y = 7
LOG2_OPACITY = 8
DEPTH = 9
#: Colour, then the normal where it is composited; or feature channels.
CHANNELS = 10
MAX_CHANNELS = 6

# Columns of ``outlines``, for binning: as those of 3D Gaussians' ``records``, of the ellipse where the disc's image ends;
# then the centre of the low-pass filter's circle, and the columns of ``records`` from ``U_X`` to ``Q_Y``. Where the disc
# crosses the near plane its image may be no ellipse: ``layout.U_XX`` is 0, and where ``layout.U_YY`` would be there is
# the largest q.
CIRCLE_X = 6
CIRCLE_Y = 7
SLOPES = 8
#: Stands for infinity as largest q: nothing that passes is infinite.
LARGE = 1e30

# Columns of sums. With v the derivative of the loss with respect to ln(alpha), and c that with respect to scaling the
# intersection (u, v, z) about the camera, in all of its coordinates but per unit of the logarithm of the scale,
# they are, over pixels, the sums of v, and where the disc and not the filter counts of v e, v f, v e e, v e f, v f f;
# of c, c e, c f; where the filter counts of v d_x, v d_y; and of weight times the derivative with respect to each
# channel. The sixteen of all entries, or surfels, come first, and the seventeenth of all, where there is one, behind.
SUM_V = 0
SUM_E = 1
SUM_F = 2
SUM_EE = 3
SUM_EF = 4
SUM_FF = 5
SUM_C = 6
SUM_CE = 7
SUM_CF = 8
SUM_DX = 9
SUM_DY = 10
SUM_CHANNELS = 11
#: Channels whose sums are among the sixteen.
ROW_CHANNELS = layout.ROW - SUM_CHANNELS


class Measures(NamedTuple):
    """Measures that differ from pixel to pixel of a surfel: tuples with one element where wanted, else none.

    ``depth`` is for the accumulated and the expected depth; ``median`` is the depth of the surfel at which transmittance falls
    to one half; ``distortion`` are squared differences of reciprocal depths.
    """

    depth: tuple[object, ...]
    inverse_depth: tuple[object, ...]
    median: tuple[object, ...]
    distortion: tuple[object, ...]


#: Measures of a sweep over feature channels.
NOTHING = Measures((), (), (), ())
