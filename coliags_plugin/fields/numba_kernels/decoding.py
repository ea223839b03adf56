"""Anchors -> Gaussians: frustum culling, and decoding by networks of one hidden layer, forward and backward, in tiles.

Shapes: V visible anchors of M, K children each, N of V * K drawn; F features, G and A further inputs, embedded, of geometry
and appearance. Networks lie side by side in the hidden layer, opacity, covariance, colour. Tables are flat float32 arrays in
row-major order; units, outputs and embedded inputs are filled up to whole vectors with zeros.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from coliags_plugin.core.numba_kernels import lanes as vec
from coliags_plugin.core.numba_kernels.compilation import Array, inline, kernel, part
from coliags_plugin.core.numba_kernels.threads import pieces

#: Anchors of a tile, and anchors culled at a time.
TILE, PARCEL = 48, 1024
#: Rows of a product computed at a time: a register for each, and one for the other factor.
ROWS = 8
#: Parts of the tiles whose sums over anchors are kept apart, so that they do not depend on the number of threads.
SLABS = 32
#: Shortest quaternion, and smallest scale, that is divided by.
SHORTEST = np.float32(1e-12)
ONE = np.float32(1.0)
_LOG2_E = 1.0 / math.log(2.0)
_TURNS = 2.0 / math.pi


class Widths(NamedTuple):
    """Numbers of columns: hidden units of the three networks, their outputs, inputs, children.

    The outputs of covariance are the logits of all children's scales, filled up to ``logits``, then all quaternions.
    """

    opacity_units: int
    covariance_units: int
    color_units: int
    opacities: int
    covariances: int
    colors: int
    logits: int
    features: int
    children: int


class Inputs(NamedTuple):
    """Inputs of networks besides the features, some of which are embedded by sine and cosine.

    A column of the embedded inputs is one of ``values``, or the sine of the sum of the last of ``values``, each times its row
    of ``octaves``, plus as many right angles as its number in ``quadrants``.
    """

    plain: int  # R
    values: Array  # [V, R]
    octaves: Array  # [D, columns], 0 in the first R columns
    quadrants: Array  # [columns]


class Networks(NamedTuple):
    """Weights with inputs as rows and outputs as columns, then biases."""

    of_features: Array  # of the first layers, [F, units]
    of_geometry: Array  # [G, units of opacity and covariance]
    of_appearance: Array  # [A, units of colour]
    opacity: Array  # of the last layers, [units, columns]
    covariance: Array
    color: Array
    first_bias: Array
    opacity_bias: Array
    covariance_bias: Array
    color_bias: Array


class Anchors(NamedTuple):
    """Positions and parameters of the anchors; ``sizes`` are the exponentials of the scalings."""

    visible: Array  # int64, ascending [V]
    positions: Array  # [M, 3]
    offsets: Array  # [M, K, 3]
    sizes: Array  # [M, 6]
    features: Array  # of the visible ones [V, F]


class Drawn(NamedTuple):
    """Output Gaussians, and of their quaternions what the backward pass needs."""

    means: Array
    quats: Array
    scales: Array
    opacities: Array
    colors: Array
    sources: Array  # int64, in M * K
    inverse_lengths: Array  # of the quaternions decoded


class Found(NamedTuple):
    """Gradients with respect to the anchors' parameters and to the networks' embedded inputs, these where not empty."""

    offsets: Array  # [M, K, 3]
    scalings: Array  # [M, 6]
    features: Array  # filled up to whole vectors and with zeros, as all below [V, columns]
    geometry: Array
    appearance: Array


@kernel
def decode_opacities(counters, widths, anchors, geometry, appearance, networks, hidden, opacities, counts):
    """Write the hidden layer [V, units] and the opacities [V, columns], and count the positive ones of each tile."""
    units, geometry_units = _units(widths)
    geometry_columns, appearance_columns = len(geometry.quadrants), len(appearance.quadrants)
    geometry_inputs, appearance_inputs = _tile_of(geometry_columns), _tile_of(appearance_columns)
    for tile in pieces(counters, 0, len(counts)):
        first = TILE * tile
        rows = min(TILE, len(anchors.visible) - first)
        start, at = first * units, first * widths.opacities
        _fill(hidden, start, rows, networks.first_bias)
        a = (anchors.features, first * widths.features, widths.features, 1)
        multiply((rows, units, widths.features), a, (networks.of_features, 0, units), (hidden, start, units))
        _embed(geometry_inputs, geometry, first, rows)
        a, b = (geometry_inputs, 0, geometry_columns, 1), (networks.of_geometry, 0, geometry_units)
        multiply((rows, geometry_units, geometry_columns), a, b, (hidden, start, units))
        _embed(appearance_inputs, appearance, first, rows)
        a, b = (appearance_inputs, 0, appearance_columns, 1), (networks.of_appearance, 0, widths.color_units)
        c = (hidden, start + geometry_units, units)
        multiply((rows, widths.color_units, appearance_columns), a, b, c)
        for i in range(start, start + rows * units, vec.WIDTH):
            vec.store(hidden, i, vec.larger(0.0, vec.load(hidden, i)))

        _fill(opacities, at, rows, networks.opacity_bias)
        b, c = (networks.opacity, 0, widths.opacities), (opacities, at, widths.opacities)
        multiply((rows, widths.opacities, widths.opacity_units), (hidden, start, units, 1), b, c)
        positive = 0
        for i in range(at, at + rows * widths.opacities, vec.WIDTH):
            value = _tanh(vec.load(opacities, i))
            vec.store(opacities, i, value)
            positive += vec.bit_count(vec.bits(vec.greater(value, 0.0)))
        counts[tile] = positive


@kernel
def draw(counters, widths, anchors, networks, hidden, opacities, starts, drawn):
    """Decode further, and write, the children of positive opacity; ``starts`` are the numbers of those before each tile."""
    units, geometry_units = _units(widths)
    covariances, colors = _tile_of(widths.covariances), _tile_of(widths.colors)
    for tile in pieces(counters, 0, len(starts)):
        first = TILE * tile
        rows = min(TILE, len(anchors.visible) - first)
        start = first * units
        _fill(covariances, 0, rows, networks.covariance_bias)
        a, b = (hidden, start + widths.opacity_units, units, 1), (networks.covariance, 0, widths.covariances)
        shape = (rows, widths.covariances, widths.covariance_units)
        multiply(shape, a, b, (covariances, 0, widths.covariances))
        _fill(colors, 0, rows, networks.color_bias)
        a, b = (hidden, start + geometry_units, units, 1), (networks.color, 0, widths.colors)
        multiply((rows, widths.colors, widths.color_units), a, b, (colors, 0, widths.colors))
        for i in range(0, rows * widths.colors, vec.WIDTH):
            vec.store(colors, i, _sigmoid(vec.load(colors, i)))
        for row in range(rows):
            for i in range(row * widths.covariances, row * widths.covariances + widths.logits, vec.WIDTH):
                vec.store(covariances, i, _sigmoid(vec.load(covariances, i)))
        _draw_tile(starts[tile], first, rows, widths, anchors, opacities, covariances, colors, drawn)


@part
def _draw_tile(n, first, rows, widths, anchors, opacities, covariances, colors, drawn):
    """Write the children of positive opacity of a tile, the first as number ``n``."""
    for row in range(rows):
        m = anchors.visible[first + row]
        for k in range(widths.children):
            opacity = opacities[(first + row) * widths.opacities + k]
            if not opacity > 0.0:
                continue
            source = m * widths.children + k
            drawn.sources[n], drawn.opacities[n] = source, opacity
            logit, color = row * widths.covariances + 3 * k, row * widths.colors + 3 * k
            for i in range(3):
                shift = anchors.offsets[3 * source + i] * anchors.sizes[6 * m + i]
                drawn.means[3 * n + i] = anchors.positions[3 * m + i] + shift
                drawn.scales[3 * n + i] = anchors.sizes[6 * m + 3 + i] * covariances[logit + i]
                drawn.colors[3 * n + i] = colors[color + i]
            quat = row * widths.covariances + widths.logits + 4 * k
            squares = np.float32(0.0)
            for i in range(4):
                squares += covariances[quat + i] * covariances[quat + i]
            inverse = np.float32(1.0) / max(math.sqrt(squares), SHORTEST)
            drawn.inverse_lengths[n] = inverse
            for i in range(4):
                drawn.quats[4 * n + i] = covariances[quat + i] * inverse
            n += 1


@kernel
def decode_backward(
    counters,
    widths,
    anchors,
    geometry,
    appearance,
    transposed,
    hidden,
    opacities,
    starts,
    drawn,
    of_drawn,
    of_anchors,
    sums,
):
    """Derivatives of :func:`decode_opacities` and :func:`draw`.

    ``of_drawn`` has those with respect to the output Gaussians in their places. ``transposed`` are networks whose weights have
    outputs as rows, and inputs and units, filled up to whole vectors, as columns. Written are ``of_anchors``, and in ``sums`` the
    derivatives with respect to the networks, for each slab one behind the other.
    """
    units, geometry_units = _units(widths)
    outputs = (_tile_of(widths.opacities), _tile_of(widths.covariances), _tile_of(widths.colors))
    of_hidden = _tile_of(units)
    geometry_columns, appearance_columns = len(geometry.quadrants), len(appearance.quadrants)
    geometry_inputs, appearance_inputs = _tile_of(geometry_columns), _tile_of(appearance_columns)
    slab_tiles = -(-len(starts) // SLABS)
    for slab in pieces(counters, 0, SLABS):
        total = _networks_in(sums[slab], widths, geometry_columns, appearance_columns)
        for tile in range(slab * slab_tiles, min((slab + 1) * slab_tiles, len(starts))):
            first = TILE * tile
            rows = min(TILE, len(anchors.visible) - first)
            start = first * units
            _outputs_backward(
                starts[tile], first, rows, widths, anchors, opacities, drawn, of_drawn, outputs, of_anchors
            )
            _last_layers_backward(rows, widths, transposed, hidden, start, outputs, of_hidden, total)
            for i in range(0, rows * units, vec.WIDTH):
                active = vec.greater(vec.load(hidden, start + i), 0.0)
                vec.store(of_hidden, i, vec.select(active, vec.load(of_hidden, i), 0.0))
            _add_rows(total.first_bias, of_hidden, rows)

            a, b = (anchors.features, first * widths.features, 1, widths.features), (of_hidden, 0, units)
            multiply((widths.features, units, rows), a, b, (total.of_features, 0, units))
            _embed(geometry_inputs, geometry, first, rows)
            a, c = (geometry_inputs, 0, 1, geometry_columns), (total.of_geometry, 0, geometry_units)
            multiply((geometry_columns, geometry_units, rows), a, b, c)
            _embed(appearance_inputs, appearance, first, rows)
            a, b = (appearance_inputs, 0, 1, appearance_columns), (of_hidden, geometry_units, units)
            c = (total.of_appearance, 0, widths.color_units)
            multiply((appearance_columns, widths.color_units, rows), a, b, c)

            columns = len(transposed.of_features) // units
            a, b = (of_hidden, 0, units, 1), (transposed.of_features, 0, columns)
            multiply((rows, columns, units), a, b, (of_anchors.features, first * columns, columns))
            if len(of_anchors.geometry):
                b = (transposed.of_geometry, 0, geometry_columns)
                c = (of_anchors.geometry, first * geometry_columns, geometry_columns)
                multiply((rows, geometry_columns, geometry_units), a, b, c)
            if len(of_anchors.appearance):
                a, b = (of_hidden, geometry_units, units, 1), (transposed.of_appearance, 0, appearance_columns)
                c = (of_anchors.appearance, first * appearance_columns, appearance_columns)
                multiply((rows, appearance_columns, widths.color_units), a, b, c)


@part
def _outputs_backward(n, first, rows, widths, anchors, opacities, drawn, of_drawn, outputs, of_anchors):
    """Derivatives with respect to the outputs of the networks, and to the rows of offsets and scalings, of a tile."""
    of_opacities, of_covariances, of_colors = outputs
    of_opacities[:] = 0.0
    of_covariances[:] = 0.0
    of_colors[:] = 0.0
    for row in range(rows):
        m = anchors.visible[first + row]
        # Nothing is found for the anchors since the visible one before, and behind the last visible one.
        begin = anchors.visible[first + row - 1] + 1 if first + row else 0
        end = m + 1 if first + row + 1 < len(anchors.visible) else len(anchors.sizes) // 6
        of_anchors.scalings[6 * begin : 6 * end] = 0.0
        of_anchors.offsets[3 * widths.children * begin : 3 * widths.children * end] = 0.0
        for k in range(widths.children):
            source = m * widths.children + k
            opacity = opacities[(first + row) * widths.opacities + k]
            if not opacity > 0.0:
                continue
            of_opacities[row * widths.opacities + k] = of_drawn.opacities[n] * (ONE - opacity * opacity)
            logit, color = row * widths.covariances + 3 * k, row * widths.colors + 3 * k
            for i in range(3):
                of_offset = of_drawn.means[3 * n + i] * anchors.sizes[6 * m + i]
                of_anchors.offsets[3 * source + i] = of_offset
                of_anchors.scalings[6 * m + i] += of_offset * anchors.offsets[3 * source + i]
                # With respect to the logarithm of the scale.
                of_log = of_drawn.scales[3 * n + i] * drawn.scales[3 * n + i]
                of_anchors.scalings[6 * m + 3 + i] += of_log
                share = drawn.scales[3 * n + i] / max(anchors.sizes[6 * m + 3 + i], SHORTEST)
                of_covariances[logit + i] = of_log * (ONE - share)
                value = drawn.colors[3 * n + i]
                of_colors[color + i] = of_drawn.colors[3 * n + i] * value * (ONE - value)
            quat = row * widths.covariances + widths.logits + 4 * k
            along = np.float32(0.0)
            for i in range(4):
                along += drawn.quats[4 * n + i] * of_drawn.quats[4 * n + i]
            for i in range(4):
                across = of_drawn.quats[4 * n + i] - drawn.quats[4 * n + i] * along
                of_covariances[quat + i] = across * drawn.inverse_lengths[n]
            n += 1


@part
def _last_layers_backward(rows, widths, transposed, hidden, start, outputs, of_hidden, total):
    """Derivatives with respect to the last layers and to their inputs, before ReLU, of a tile."""
    units, geometry_units = _units(widths)
    of_opacities, of_covariances, of_colors = outputs
    of_hidden[:] = 0.0

    a, b = (hidden, start, 1, units), (of_opacities, 0, widths.opacities)
    multiply((widths.opacity_units, widths.opacities, rows), a, b, (total.opacity, 0, widths.opacities))
    _add_rows(total.opacity_bias, of_opacities, rows)
    a, b = (of_opacities, 0, widths.opacities, 1), (transposed.opacity, 0, widths.opacity_units)
    multiply((rows, widths.opacity_units, widths.children), a, b, (of_hidden, 0, units))

    a, b = (hidden, start + widths.opacity_units, 1, units), (of_covariances, 0, widths.covariances)
    multiply((widths.covariance_units, widths.covariances, rows), a, b, (total.covariance, 0, widths.covariances))
    _add_rows(total.covariance_bias, of_covariances, rows)
    a, b = (of_covariances, 0, widths.covariances, 1), (transposed.covariance, 0, widths.covariance_units)
    multiply((rows, widths.covariance_units, widths.covariances), a, b, (of_hidden, widths.opacity_units, units))

    a, b = (hidden, start + geometry_units, 1, units), (of_colors, 0, widths.colors)
    multiply((widths.color_units, widths.colors, rows), a, b, (total.color, 0, widths.colors))
    _add_rows(total.color_bias, of_colors, rows)
    a, b = (of_colors, 0, widths.colors, 1), (transposed.color, 0, widths.color_units)
    multiply((rows, widths.color_units, 3 * widths.children), a, b, (of_hidden, geometry_units, units))


@inline
def _units(widths):
    """Hidden units in all, and of geometry."""
    geometry = widths.opacity_units + widths.covariance_units
    return geometry + widths.color_units, geometry


@inline
def _tile_of(columns):
    return np.empty(TILE * columns, np.float32)


@part
def _networks_in(table, widths, geometry_columns, appearance_columns):
    """The networks of which a table has all numbers, one behind the other."""
    units, geometry = _units(widths)
    a = widths.features * units
    b = a + geometry_columns * geometry
    c = b + appearance_columns * widths.color_units
    d = c + widths.opacity_units * widths.opacities
    e = d + widths.covariance_units * widths.covariances
    f = e + widths.color_units * widths.colors
    g = f + units
    h = g + widths.opacities
    i = h + widths.covariances
    return Networks(
        table[:a],
        table[a:b],
        table[b:c],
        table[c:d],
        table[d:e],
        table[e:f],
        table[f:g],
        table[g:h],
        table[h:i],
        table[i:],
    )


@part
def _embed(table, inputs, first, rows):
    """Write the embedded inputs of a tile."""
    columns = len(inputs.quadrants)
    count, plain = len(inputs.octaves) // columns, inputs.plain
    for row in range(rows):
        at = (first + row) * plain
        for column in range(0, columns, vec.WIDTH):
            phase = vec.splat(0.0)
            for d in range(count):
                value = vec.broadcast(inputs.values, at + plain - count + d)
                phase = vec.fma(value, vec.load(inputs.octaves, d * columns + column), phase)
            vec.store(table, row * columns + column, _sine(phase, vec.load(inputs.quadrants, column)))
        for column in range(plain):
            table[row * columns + column] = inputs.values[at + column]


@inline
def _sine(x, quadrant):
    """Sine of x plus a number of right angles, to 2e-7 for numbers below some thousands; not a number stays so."""
    turns = vec.floor(vec.fma(x, _TURNS, 0.5))
    # The right angle in three parts, of which the first two times the turns are exact.
    rest = vec.fma(turns, -1.5703125, x)
    rest = vec.fma(turns, -0.000483751296996, rest)
    rest = vec.fma(turns, -7.54978995489e-08, rest)
    square = vec.mul(rest, rest)
    sine = vec.fma(vec.fma(-1.9515295891e-4, square, 8.3321608736e-3), square, -1.6666654611e-1)
    sine = vec.fma(vec.mul(sine, square), rest, rest)
    cosine = vec.fma(vec.fma(2.443315711809948e-5, square, -1.388731625493765e-3), square, 4.166664568298827e-2)
    cosine = vec.fma(vec.mul(cosine, square), square, vec.fma(square, -0.5, 1.0))
    quarters = vec.add(turns, quadrant)
    halves = vec.floor(vec.mul(quarters, 0.5))
    is_odd = vec.greater(vec.fma(halves, -2.0, quarters), 0.5)
    value = vec.select(is_odd, cosine, sine)
    is_negative = vec.greater(vec.fma(vec.floor(vec.mul(halves, 0.5)), -2.0, halves), 0.5)
    return vec.select(is_negative, vec.neg(value), value)


@part
def _fill(table, start, rows, bias):
    """Set rows to the biases."""
    for row in range(rows):
        for i in range(0, len(bias), vec.WIDTH):
            vec.store(table, start + row * len(bias) + i, vec.load(bias, i))


@part
def _add_rows(total, table, rows):
    """Add up the rows of a table."""
    for i in range(0, len(total), vec.WIDTH):
        value = vec.load(total, i)
        for row in range(rows):
            value = vec.add(value, vec.load(table, row * len(total) + i))
        vec.store(total, i, value)


# Written so that what is not a number stays so.
@inline
def _sigmoid(x):
    return vec.quick_div(1.0, vec.add(1.0, vec.exp2(vec.mul(vec.larger(-80.0, vec.smaller(80.0, x)), -_LOG2_E))))


@inline
def _tanh(x):
    power = vec.exp2(vec.mul(vec.larger(-20.0, vec.smaller(20.0, x)), 2.0 * _LOG2_E))
    return vec.sub(1.0, vec.quick_div(2.0, vec.add(1.0, power)))


# --- products of small matrices that stay in a core's cache -----------------------------------------------------------


@part
def multiply(shape, a, b, c):
    """Add the product of two matrices to a third: C += A B.

    ``shape`` is (rows of A and C, columns of B and C, a multiple of the lanes' width, columns of A and rows of B). A matrix is
    its table, the place of its first element, the step to the next row and, of A, the step to the next column.
    """
    rows, columns, depth = shape
    left, a_start, a_row, a_column = a
    right, b_start, b_row = b
    result, c_start, c_row = c
    whole = rows - rows % ROWS
    for column in range(0, columns, vec.WIDTH):
        at_b = b_start + column
        for row in range(0, whole, ROWS):
            at_c, at_a = c_start + row * c_row + column, a_start + row * a_row
            total = (
                vec.load(result, at_c),
                vec.load(result, at_c + c_row),
                vec.load(result, at_c + 2 * c_row),
                vec.load(result, at_c + 3 * c_row),
                vec.load(result, at_c + 4 * c_row),
                vec.load(result, at_c + 5 * c_row),
                vec.load(result, at_c + 6 * c_row),
                vec.load(result, at_c + 7 * c_row),
            )
            for d in range(depth):
                total = vec.fma(_column(left, at_a + d * a_column, a_row), vec.load(right, at_b + d * b_row), total)
            for r in range(ROWS):
                vec.store(result, at_c + r * c_row, total[r])
        for row in range(whole, rows):
            at_c, at_a = c_start + row * c_row + column, a_start + row * a_row
            single = vec.load(result, at_c)
            for d in range(depth):
                single = vec.fma(vec.broadcast(left, at_a + d * a_column), vec.load(right, at_b + d * b_row), single)
            vec.store(result, at_c, single)


@inline
def _column(a, start, step):
    """Eight numbers, ``step`` apart, each in all lanes of its vector."""
    return (
        vec.broadcast(a, start),
        vec.broadcast(a, start + step),
        vec.broadcast(a, start + 2 * step),
        vec.broadcast(a, start + 3 * step),
        vec.broadcast(a, start + 4 * step),
        vec.broadcast(a, start + 5 * step),
        vec.broadcast(a, start + 6 * step),
        vec.broadcast(a, start + 7 * step),
    )


# --- frustum culling --------------------------------------------------------------------------------------------------


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
