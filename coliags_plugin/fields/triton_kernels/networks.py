"""Device functions of the networks, forward and backward, for a tile of anchors.

A network of one hidden layer is part of a flat table: weights [units, columns] and biases of the first layer, then
weights [children * outputs, units] and biases of the last, as in PyTorch. Its gradients are the same part of another
table. What it sees are columns: the anchor's features, the given inputs of its head, and sines and cosines of the last
of these. Blocks have R anchors, C columns, U units, and K slots of children.
"""

from __future__ import annotations

from typing import NamedTuple

import triton
import triton.language as tl

#: Anchors of a tile, hidden units of a block, and columns of a block of inputs.
ROWS, UNITS, COLUMNS = tl.constexpr(32), tl.constexpr(32), tl.constexpr(16)
#: Precision of products of matrices: float32 throughout.
PRECISION = tl.constexpr("ieee")
#: Outputs of a child in all: opacity, three logits of scales, a quaternion, a colour.
OUTPUTS = tl.constexpr(11)
#: 2 / pi, and pi / 2 in three parts, of which the first two times a small whole number are exact.
_TURNS = tl.constexpr(0.6366197723675814)
_RIGHT_ANGLE = tl.constexpr((1.5703125, 0.000483751296996, 7.54978995489e-08))


class Network(NamedTuple):
    """Sizes of a network, and where in the table it begins."""

    start: int
    units: int
    outputs: int  # of each child
    children: int
    features: int
    plain_inputs: int
    embedded: int  # how many of the given inputs, the last ones
    columns: int  # in all

    @property
    def end(self) -> int:
        """Address at which the next network begins."""
        return self.start + self.units * (self.columns + 1) + self.outputs * self.children * (self.units + 1)


@triton.jit
def sine(x, quadrant):
    """Sine of x plus a number of right angles, to 2e-7 for numbers below some thousands; not a number stays so."""
    turns = tl.floor(x * _TURNS + 0.5)
    rest = x - turns * _RIGHT_ANGLE[0] - turns * _RIGHT_ANGLE[1] - turns * _RIGHT_ANGLE[2]
    square = rest * rest
    odd = (-1.9515295891e-4 * square + 8.3321608736e-3) * square - 1.6666654611e-1
    even = (2.443315711809948e-5 * square - 1.388731625493765e-3) * square + 4.166664568298827e-2
    quarters = turns.to(tl.int32) + quadrant
    value = tl.where(quarters & 1 == 1, even * square * square - 0.5 * square + 1.0, odd * square * rest + rest)
    return tl.where(quarters & 2 == 2, -value, value)


@triton.jit
def tanh(x):
    """Hyperbolic tangent, to 1e-7."""
    return 2.0 * tl.sigmoid(2.0 * x) - 1.0


@triton.jit
def _sources(column, NETWORK: tl.constexpr):
    """The given input of a column, factor and right angles of its phase, and whether it is a sine of that. [C] each"""
    EMBEDDED: tl.constexpr = max(NETWORK.embedded, 1)
    input_column = column - NETWORK.features
    wave = input_column - NETWORK.plain_inputs
    place = tl.maximum(wave, 0)
    source = tl.where(wave < 0, input_column, NETWORK.plain_inputs - NETWORK.embedded + place % EMBEDDED)
    return source, (1 << (place // (2 * EMBEDDED))).to(tl.float32), place // EMBEDDED % 2, wave >= 0


@triton.jit
def _given(inputs, rows, visible, column, source, NETWORK: tl.constexpr):
    """The given inputs of columns, 0 of features. [R, C]"""
    here = (column >= NETWORK.features) & (column < NETWORK.columns)
    return tl.load(
        inputs + rows[:, None] * NETWORK.plain_inputs + source[None, :], visible[:, None] & here[None, :], 0.0
    )


@triton.jit
def _seen_by(features, inputs, rows, visible, column, NETWORK: tl.constexpr):
    """Inputs of the first layer. [R, C]"""
    source, octave, quadrant, is_wave = _sources(column, NETWORK)
    here = visible[:, None] & (column < NETWORK.features)[None, :]
    of_anchors = tl.load(features + rows[:, None] * NETWORK.features + column[None, :], here, 0.0)
    plain_inputs = _given(inputs, rows, visible, column, source, NETWORK)
    values = tl.where(is_wave[None, :], sine(plain_inputs * octave[None, :], quadrant[None, :]), plain_inputs)
    return tl.where((column < NETWORK.features)[None, :], of_anchors, values)


@triton.jit
def _first_weights(unit, column, NETWORK: tl.constexpr):
    """Places of weights of the first layer in its table, and which there are. [U, C] each"""
    here = (unit < NETWORK.units)[:, None] & (column < NETWORK.columns)[None, :]
    return NETWORK.start + unit[:, None] * NETWORK.columns + column[None, :], here


@triton.jit
def _last_weights(child, unit, output, NETWORK: tl.constexpr):
    """Places of one output's weights in the table, and which there are. [K, U] each"""
    FIRST: tl.constexpr = NETWORK.start + NETWORK.units * (NETWORK.columns + 1)
    here = (child < NETWORK.children)[:, None] & (unit < NETWORK.units)[None, :]
    return FIRST + (child[:, None] * NETWORK.outputs + output) * NETWORK.units + unit[None, :], here


@triton.jit
def _last_biases(child, output, NETWORK: tl.constexpr):
    """Places of one output's biases in the table. [K]"""
    LAST: tl.constexpr = NETWORK.outputs * NETWORK.children
    FIRST: tl.constexpr = NETWORK.start + NETWORK.units * (NETWORK.columns + 1 + LAST)
    return FIRST + child * NETWORK.outputs + output


@triton.jit
def _hidden(table, features, inputs, rows, visible, unit, NETWORK: tl.constexpr):
    """Hidden units, behind ReLU. [R, U]"""
    bias = tl.load(table + NETWORK.start + NETWORK.units * NETWORK.columns + unit, unit < NETWORK.units, 0.0)
    sums = tl.zeros([ROWS, UNITS], tl.float32) + bias[None, :]
    for first in range(0, NETWORK.columns, COLUMNS):
        column = first + tl.arange(0, COLUMNS)
        place, here = _first_weights(unit, column, NETWORK)
        values = _seen_by(features, inputs, rows, visible, column, NETWORK)
        weights = tl.trans(tl.load(table + place, here, 0.0))
        sums = tl.dot(values, weights, sums, input_precision=PRECISION)
    return tl.where(sums < 0.0, 0.0, sums)


@triton.jit
def outputs(table, features, inputs, rows, visible, child, NETWORK: tl.constexpr):
    """The outputs of the children, one block [R, K] each."""
    COUNT: tl.constexpr = NETWORK.outputs  # before triton 3.9, the field itself is no constexpr
    results = ()
    for output in tl.static_range(COUNT):
        bias = tl.load(table + _last_biases(child, output, NETWORK), child < NETWORK.children, 0.0)
        results += (tl.zeros([ROWS, child.shape[0]], tl.float32) + bias[None, :],)
    for first in range(0, NETWORK.units, UNITS):
        unit = first + tl.arange(0, UNITS)
        hidden = _hidden(table, features, inputs, rows, visible, unit, NETWORK)
        sums = ()
        for output in tl.static_range(COUNT):
            place, here = _last_weights(child, unit, output, NETWORK)
            weights = tl.trans(tl.load(table + place, here, 0.0))
            sums += (tl.dot(hidden, weights, results[output], input_precision=PRECISION),)
        results = sums
    return results


@triton.jit
def outputs_backward(
    table, features, inputs, rows, visible, child, number, drawn, of_outputs, of_table, of_features, of_inputs,
    NETWORK: tl.constexpr, WITH_INPUTS: tl.constexpr,
):  # fmt: skip
    """Derivative of :func:`outputs`: added to the table's and the features'; returned, added up, of the inputs. [R, I]

    ``of_outputs`` are those of the children drawn, by number, one behind the other. [N, OUTPUTS]
    """
    # One program adds to a place, and the same thread each time: the order of sums is fixed.
    tl.debug_barrier()
    for first_unit in range(0, NETWORK.units, UNITS):
        unit = first_unit + tl.arange(0, UNITS)
        hidden = _hidden(table, features, inputs, rows, visible, unit, NETWORK)
        of_hidden = tl.zeros([ROWS, UNITS], tl.float32)
        for output in range(NETWORK.outputs):
            of_output = tl.load(of_outputs + OUTPUTS * number + output, drawn, 0.0)
            if first_unit == 0:
                of_bias = of_table + _last_biases(child, output, NETWORK)
                tl.atomic_add(of_bias, tl.sum(of_output, axis=0), child < NETWORK.children, sem="relaxed")
            last, is_last = _last_weights(child, unit, output, NETWORK)
            of_last = tl.dot(tl.trans(of_output), hidden, input_precision=PRECISION)
            tl.atomic_add(of_table + last, of_last, is_last, sem="relaxed")
            weights = tl.load(table + last, is_last, 0.0)
            of_hidden = tl.dot(of_output, weights, of_hidden, input_precision=PRECISION)
        of_hidden = tl.where(hidden > 0.0, of_hidden, 0.0)
        of_first_bias = of_table + NETWORK.start + NETWORK.units * NETWORK.columns + unit
        tl.atomic_add(of_first_bias, tl.sum(of_hidden, axis=0), unit < NETWORK.units, sem="relaxed")
        for block in range(0, NETWORK.columns, COLUMNS):
            column = block + tl.arange(0, COLUMNS)
            first, is_first = _first_weights(unit, column, NETWORK)
            values = _seen_by(features, inputs, rows, visible, column, NETWORK)
            of_first = tl.dot(tl.trans(of_hidden), values, input_precision=PRECISION)
            tl.atomic_add(of_table + first, of_first, is_first, sem="relaxed")
            of_values = tl.dot(of_hidden, tl.load(table + first, is_first, 0.0), input_precision=PRECISION)
            is_feature = visible[:, None] & (column < NETWORK.features)[None, :]
            place = of_features + rows[:, None] * NETWORK.features + column[None, :]
            tl.atomic_add(place, of_values, is_feature, sem="relaxed")
            if WITH_INPUTS:
                source, octave, quadrant, is_wave = _sources(column, NETWORK)
                phase = _given(inputs, rows, visible, column, source, NETWORK) * octave[None, :]
                slope = octave[None, :] * sine(phase, quadrant[None, :] + 1)
                of_values *= tl.where(is_wave[None, :], slope, 1.0)
                # The columns that an input is in, added up by a product.
                is_source = tl.arange(0, of_inputs.shape[1])[None, :] == source[:, None]
                is_source &= (column < NETWORK.columns)[:, None]
                of_inputs = tl.dot(of_values, is_source.to(tl.float32), of_inputs, input_precision=PRECISION)
    return of_inputs
