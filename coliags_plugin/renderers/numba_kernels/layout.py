"""Data layout of the tables that the stages share: flat arrays and the meaning of their columns.

Gaussians are processed in groups of sixteen, one vector; tables "padded to whole groups" extend to the end of the last
group. Tiles are 16 x 16 pixels, blocks 4 x 4: one vector again.
"""

from __future__ import annotations

import math
from typing import NamedTuple, TypeAlias

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

# Columns of ``records`` of 3D Gaussians. U is scaled so that log2(alpha) = log2(opacity) - |U d|^2 without further
# factors: it is sqrt(log2(e) / 2) times the U of docs/rendering.md.
U_XX = 0
U_YX = 1
U_YY = 2
MEAN_X = 3
MEAN_Y = 4
LOG2_OPACITY = 5
#: Colour (3), depth, inverse depth, normal (3); composited are the first 3, 4, 5 or 8.
CHANNELS = 6
MAX_CHANNELS = 8
#: cov_xy / cov_xx and cov_xy / cov_yy: how the nearest point moves along an edge that is upright, or level.
SLOPE_UPRIGHT = 14
SLOPE_LEVEL = 15

# Columns of ``records`` of surfels. With d the offset of a pixel from the projected centre, in units of
# 1 / ``VIEW_PIXEL_SCALE`` pixels, the ray through it meets the disc's plane at z-depth ``SURFEL_DEPTH`` / q and at
# (e, f) = (U d, V d) / q with q = 1 + Q d. (e, f) are standard deviations times ``U_FACTOR``, and so is d for those of
# the low-pass filter, so that log2(alpha) = log2(opacity) - min(e^2 + f^2, |d|^2).
SURFEL_U_X = 0
SURFEL_U_Y = 1
SURFEL_V_X = 2
SURFEL_V_Y = 3
SURFEL_Q_X = 4
SURFEL_Q_Y = 5
SURFEL_MEAN_X = 6  # pixels
SURFEL_MEAN_Y = 7
SURFEL_LOG2_OPACITY = 8
SURFEL_DEPTH = 9
#: Colour (3), normal (3).
SURFEL_CHANNELS = 10

# Columns of ``outlines`` of surfels: as ``records`` of 3D Gaussians, of the ellipse where the disc's image ends; then
# the centre of the low-pass filter's circle, and the columns of the surfel's record from ``SURFEL_U_X`` to
# ``SURFEL_Q_Y``. Where the disc crosses the near plane its image may be no ellipse: ``U_XX`` is 0, and ``U_YY`` is the
# largest q.
CIRCLE_X = 6
CIRCLE_Y = 7
OUTLINE_SLOPES = 8
#: Stands for infinity as largest q: nothing that passes is infinite.
LARGE = 1e30

#: The square of the factor in U, and the factor.
U_FACTOR_SQUARED = 0.5 / math.log(2.0)
U_FACTOR = math.sqrt(U_FACTOR_SQUARED)
#: Slack on |U d|^2 in binning, so that rounding never drops a pixel that a sweep would draw.
REACH_SLACK = 1e-2

# Columns of sums over pixels, with v = dL / d ln(alpha); of surfels v counts in columns 1 to 5 where the disc, not the
# filter, decides alpha, and c is the derivative with respect to a factor on the intersection (u, v, z), by its logarithm.
SUM_V = 0  # v
SUM_E = 1  # v e, with (e, f) = U d
SUM_F = 2  # v f
SUM_EE = 3  # v e e
SUM_EF = 4  # v e f
SUM_FF = 5  # v f f
SUM_CHANNELS = 6  # 3D Gaussians: weight times the derivative with respect to each channel
SUM_C = 6  # surfels: c
SUM_CE = 7  # c e
SUM_CF = 8  # c f
SUM_DX = 9  # v d_x where the filter decides alpha
SUM_DY = 10  # v d_y there
#: Surfels: as SUM_CHANNELS. The sixteen of all entries, or surfels, come first, and the seventeenth of all behind.
SURFEL_SUM_CHANNELS = 11

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

#: A number that numba compiles a kernel for: the length of a tuple, whose elements do not matter.
Count: TypeAlias = tuple[int, ...]


def count(number: int) -> Count:
    """A number as its tuple."""
    return (0,) * number


class Outputs(NamedTuple):
    """Channels and per-pixel measures that a sweep composites; kernels are compiled for each combination.

    ``channels`` are numbers of the record from the colour on. The rest is 1 where wanted, and the normals 3: of surfels,
    whose depth differs from pixel to pixel, and of 3D Gaussians the median alone.
    """

    channels: Count
    normals: Count = ()
    depth: Count = ()
    inverse_depth: Count = ()
    median: Count = ()
    distortion: Count = ()


class Parameters(NamedTuple):
    """The Gaussians, or the derivatives with respect to them: 3, 4 (w first), 3 (surfels: 2), 1 and 3 numbers for each."""

    means: Array
    quats: Array
    scales: Array
    opacities: Array
    colors: Array


class Grid(NamedTuple):
    """The image in pixels and its tiles, which are counted row by row; ``columns`` of them are side by side."""

    width: int
    height: int
    columns: int
    tiles: int


class Projections(NamedTuple):
    """Output of the projection, padded to whole groups."""

    records: Array  # one row for each Gaussian; anything where it is not drawn
    outlines: Array  # the same for binning: of surfels their outlines, of 3D Gaussians the records
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
    """Tile intersections, (Gaussian, tile) pairs sorted by tile, then by depth; one pair is an "entry"."""

    nearest_first: Array  # indices of the Gaussians drawn
    entry_counts: Array  # entries of each of them
    stretch_entries: Array  # number of the first entry of each stretch of these, and at the end how many there are
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
