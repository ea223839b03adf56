"""The tables the stages hand on, and what is in their columns.

``records``: one row of 16 numbers for each Gaussian, written by projection, read by binning and by both sweeps.

The whitening U here is scaled so that log2(alpha) = log2(opacity) - |U d|^2, without further factors:
U = sqrt(log2(e) / 2) times the U of ``docs/rendering.md``.

``cells``: three integers for each entry, which is a pair of a Gaussian and a tile that it touches, by tile and front
to back: the number of the Gaussian; which of the tile's blocks it touches, one bit each; and the number of the entry
when they are counted by Gaussian, nearest first, and by tile.

``entry_sums`` and ``gaussian_sums``: one row of 16 numbers for each entry, counted by Gaussian and tile, and
their sum over the entries of a Gaussian. With v the derivative of the loss with respect to ln(alpha) and (e, f) = U d they are the sums over pixels of
v, v e, v f, v e e, v e f, v f f, and of weight times the derivative with respect to each composited channel.
"""

from __future__ import annotations

import math

#: Pixels along the edge of a tile.
TILE = 16
#: Pixels along the edge of a block; its 16 pixels are what one vector holds.
BLOCK = 4
#: Blocks of a tile.
BLOCKS = 16

#: Numbers in a row of any table.
ROW = 16

# Columns of ``records``.
U_XX = 0
U_YX = 1
U_YY = 2
MEAN_X = 3
MEAN_Y = 4
LOG2_OPACITY = 5
#: Colour, then as many of depth, inverse depth and the three components of the normal as are composited.
CHANNELS = 6
#: cov_xy / cov_xx and cov_xy / cov_yy: how the nearest point moves along an edge that is upright, or level.
SLOPE_UPRIGHT = 14
SLOPE_LEVEL = 15

#: Integers in ``cells`` for each entry.
CELL = 3

# Columns of the sums.
SUM_V = 0
SUM_E = 1
SUM_F = 2
SUM_EE = 3
SUM_EF = 4
SUM_FF = 5
SUM_CHANNELS = 6

#: Most channels that fit.
MAX_CHANNELS = 8

# Entries of ``view``, the camera and the options as float32.
VIEW_RIGHT = 0  # the camera's axes in the world
VIEW_DOWN = 3
VIEW_FORWARD = 6
VIEW_CENTER = 9
VIEW_FX = 12
VIEW_FY = 13
VIEW_CX = 14
VIEW_CY = 15
VIEW_SLOPE_X_MIN = 16
VIEW_SLOPE_X_MAX = 17
VIEW_SLOPE_Y_MIN = 18
VIEW_SLOPE_Y_MAX = 19
VIEW_NEAR = 20
VIEW_LOW_PASS = 21
VIEW_LOG2_ALPHA_MIN = 22
VIEW_WIDTH = 23
VIEW_HEIGHT = 24
VIEW_SIZE = 25

#: The square of the factor in U: half of log2(e).
U_FACTOR_SQUARED = 0.5 / math.log(2.0)
U_FACTOR = math.sqrt(U_FACTOR_SQUARED)
#: Slack on squared distances (in units of log2), so that rounding never drops a pixel that a sweep would draw.
REACH_SLACK = 1e-2
