"""Data layout of the tables that the stages share: flat arrays and the meaning of their columns.

Gaussians are processed in groups of sixteen, one vector; tables "padded to whole groups" extend to the end of the last
group. Tiles are 16 x 16 pixels, blocks 4 x 4: one vector again.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from coliags_plugin.core.numba_kernels.compilation import Array

#: Edge of a tile, pixels.
TILE = 16
#: Edge of a block, pixels.
BLOCK = 4
#: Blocks of a tile.
BLOCKS = 16
#: Gaussians of a group, and of one parcel of work.
GROUP = 16
PARCEL = 1024

#: Numbers in a row of ``records`` and of sums.
ROW = 16

# Columns of ``records``. U is scaled so that log2(alpha) = log2(opacity) - |U d|^2 without further factors: it is
# sqrt(log2(e) / 2) times the U of docs/rendering.md.
U_XX = 0
U_YX = 1
U_YY = 2
MEAN_X = 3
MEAN_Y = 4
LOG2_OPACITY = 5
#: Colour, then as many of depth, inverse depth and the three components of the normal as are composited.
CHANNELS = 6
MAX_CHANNELS = 8
#: cov_xy / cov_xx and cov_xy / cov_yy: how the nearest point moves along an edge that is upright, or level.
SLOPE_UPRIGHT = 14
SLOPE_LEVEL = 15

#: The square of the factor in U, and the factor.
U_FACTOR_SQUARED = 0.5 / math.log(2.0)
U_FACTOR = math.sqrt(U_FACTOR_SQUARED)
#: Slack on |U d|^2 in binning, so that rounding never drops a pixel that a sweep would draw.
REACH_SLACK = 1e-2

# Columns of sums. With v the derivative of the loss with respect to ln(alpha) and (e, f) = U d they are, over pixels,
# the sums of v, v e, v f, v e e, v e f, v f f, and of weight times the derivative with respect to each channel.
SUM_V = 0
SUM_E = 1
SUM_F = 2
SUM_EE = 3
SUM_EF = 4
SUM_FF = 5
SUM_CHANNELS = 6

#: Integers for each entry of ``cells``: the index of the Gaussian; which of the tile's blocks it touches, one bit each;
#: and the number of the entry when they are counted by Gaussian, nearest first.
CELL = 3

# Indices into ``view``, the camera and the options as float32.
VIEW_RIGHT = 0  # the camera's axes and centre in the world
VIEW_DOWN = 3
VIEW_FORWARD = 6
VIEW_CENTER = 9
VIEW_FX = 12
VIEW_FY = 13
VIEW_CX = 14
VIEW_CY = 15
VIEW_SLOPE_LIMITS = 16  # least and largest x / z, then y / z: where the Jacobian is clamped
VIEW_NEAR = 20
VIEW_LOW_PASS = 21
VIEW_WIDTH = 22
VIEW_HEIGHT = 23
VIEW_LOG2_ALPHA_MIN = 24  # the cuts
VIEW_ALPHA_MAX = 25
VIEW_TRANSMITTANCE_MIN = 26
VIEW_BACKGROUND = 27
VIEW_PIXEL_SCALE = 30  # U_FACTOR over the standard deviation of the surfels' filter, per pixel
VIEW_DISTORTION = 31  # factor of squared differences of reciprocal depths in the distortion


class Parameters(NamedTuple):
    """The Gaussians, or the derivatives with respect to them: 3, 4 (w first), 3 (surfels: 2), 1 and 3 numbers for each."""

    means: Array
    quats: Array
    scales: Array
    opacities: Array
    colors: Array


class Extras(NamedTuple):
    """Channels composited besides colour, in this order; ``median`` has one element where its depth is wanted, else none."""

    depth: bool
    inverse_depth: bool
    normals: bool
    median: tuple[int, ...]


#: Channels of a sweep over features, where all outputs are in the first one, whose kernels serve.
FEATURES = Extras(depth=True, inverse_depth=True, normals=True, median=(0,))


class Grid(NamedTuple):
    """The image in pixels and its tiles, which are counted row by row; ``columns`` of them are side by side."""

    width: int
    height: int
    columns: int
    tiles: int


class Projections(NamedTuple):
    """Output of the projection, padded to whole groups."""

    records: Array  # one row for each Gaussian; anything where it is not drawn
    outlines: Array  # the same for binning: of surfels see surfel_layout, of 3D Gaussians the records
    remainders: Array  # what float32 leaves of the projected centres, pixels; 2 for each surfel, none for 3D Gaussians
    depths: Array  # z-depths; 1 where not in front of the camera
    bounds: Array  # first and last column, first and last row of the tiles within reach; 4 for each Gaussian
    drawn: Array  # one bit for each Gaussian of a group
    parcels: Array  # Gaussians drawn, -1 where one cannot be used, and tiles within their bounds; 2 for each parcel


class Pairs(NamedTuple):
    """Pairs of a Gaussian and a tile that it touches, by stretches of the list of Gaussians.

    ``blocks`` are those touched, one bit each; a stretch's pairs are from ``begins`` to ``ends``; ``tile_counts`` tells how
    many there are of each stretch and tile.
    """

    gaussian: Array
    tile: Array
    blocks: Array
    begins: Array
    ends: Array
    tile_counts: Array


class Bins(NamedTuple):
    """Pairs of a Gaussian and a tile by tile and front to back; they are called entries here."""

    keys: Array  # Gaussians drawn, nearest first; the index of the Gaussian is in the lower 32 bits
    entry_counts: Array  # entries of each of them
    stretch_entries: Array  # number of the first entry of each stretch of keys, and at the end how many there are
    cells: Array  # see CELL; 3 for each entry
    starts: Array  # first entry of each tile, and at the end how many there are
    order: Array  # tiles, long lists first
    reached: Array  # end of the entries of each tile that any pixel gets to see; known after the forward sweep


class Images(NamedTuple):
    """Images, or the derivatives with respect to them; empty where there are none.

    ``rgb`` and ``normals`` have 3 numbers for each pixel, the others 1; ``expected`` is depth over alpha, and only surfels
    have a distortion.
    """

    rgb: Array
    alpha: Array
    depth: Array
    inverse_depth: Array
    expected: Array
    normals: Array
    median: Array
    distortion: Array


class Scratch(NamedTuple):
    """Working memory of the sweeps, per thread."""

    numbers: Array
    integers: Array
