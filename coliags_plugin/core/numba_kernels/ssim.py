"""Structural similarity of images and its derivative, a row of pixels at a time.

Images are flat float32 tables in row-major order, with interleaved channels; ``row`` is the length of a row in numbers, at least
that of a vector. The last vector of a row overlaps the one before.
"""

from __future__ import annotations

import numpy as np

from coliags_plugin.core.numba_kernels import lanes as vec
from coliags_plugin.core.numba_kernels.compilation import inline, kernel, part
from coliags_plugin.core.numba_kernels.threads import pieces


@kernel
def compare(counters, row, channels, weights, constants, a, b, gain, result, derivatives):
    """Write SSIM, and its derivatives with respect to the windows' mean of a, mean of a^2 + b^2 and mean of a b.

    ``weights`` are those of the window along one axis, ``constants`` C1 and C2; ``gain`` is a factor of all three means, one for
    each number of the image, or empty.
    """
    c1, c2 = vec.broadcast(constants, 0), vec.broadcast(constants, 1)
    border = len(weights) // 2 * channels
    lines = np.zeros(4 * (row + 2 * border), np.float32)
    length = row + 2 * border
    height = len(a) // row
    for y in pieces(counters, 0, height):
        first, last = _taps(y, height, weights)
        for step in range(0, row, vec.WIDTH):
            x = min(step, row - vec.WIDTH)
            total = vec.repeat(0.0, (0, 0, 0, 0))
            for tap in range(first, last):
                at = (y + tap - len(weights) // 2) * row + x
                of_a, of_b = vec.load(a, at), vec.load(b, at)
                values = (of_a, of_b, vec.fma(of_a, of_a, vec.mul(of_b, of_b)), vec.mul(of_a, of_b))
                total = vec.fma(values, vec.broadcast(weights, tap), total)
            for i in range(4):
                vec.store(lines, i * length + border + x, total[i])
        for step in range(0, row, vec.WIDTH):
            x = min(step, row - vec.WIDTH)
            mean_a, mean_b, squares, products = _along(lines, length, x, channels, weights, (0, 0, 0, 0))
            at = y * row + x
            factor = vec.load(gain, at) if len(gain) else vec.splat(1.0)
            mean_a, mean_b = vec.mul(mean_a, factor), vec.mul(mean_b, factor)
            squares, products = vec.mul(squares, factor), vec.mul(products, factor)
            product_of_means = vec.mul(mean_a, mean_b)
            squared_means = vec.fma(mean_a, mean_a, vec.mul(mean_b, mean_b))
            means, likeness = vec.fma(product_of_means, 2.0, c1), vec.fma(vec.sub(products, product_of_means), 2.0, c2)
            energy, variances = vec.add(squared_means, c1), vec.add(vec.sub(squares, squared_means), c2)
            inverse = vec.div(1.0, vec.mul(energy, variances))
            value = vec.mul(vec.mul(means, likeness), inverse)
            vec.store(result, at, value)
            if len(derivatives):
                # S (1 / variances - 1 / energy) 2 mean_a, both of which the product of the denominators gives.
                of_squares = vec.neg(vec.mul(vec.mul(value, inverse), energy))
                difference = vec.mul(vec.mul(value, inverse), vec.sub(energy, variances))
                of_mean = vec.mul(vec.mul(mean_b, vec.sub(likeness, means)), inverse)
                of_mean = vec.mul(vec.fma(mean_a, difference, of_mean), 2.0)
                of_products = vec.mul(vec.mul(means, inverse), 2.0)
                vec.store(derivatives, at, vec.mul(of_mean, factor))
                vec.store(derivatives, len(a) + at, vec.mul(of_squares, factor))
                vec.store(derivatives, 2 * len(a) + at, vec.mul(of_products, factor))


@kernel
def compare_backward(counters, row, channels, weights, a, b, given, derivatives, of_a):
    """Write the derivative with respect to a, given that with respect to the result of :func:`compare`."""
    border = len(weights) // 2 * channels
    lines = np.zeros(3 * (row + 2 * border), np.float32)
    length = row + 2 * border
    height, size = len(a) // row, len(a)
    for y in pieces(counters, 0, height):
        first, last = _taps(y, height, weights)
        for step in range(0, row, vec.WIDTH):
            x = min(step, row - vec.WIDTH)
            total = vec.repeat(0.0, (0, 0, 0))
            for tap in range(first, last):
                at = (y + tap - len(weights) // 2) * row + x
                values = (
                    vec.load(derivatives, at),
                    vec.load(derivatives, size + at),
                    vec.load(derivatives, 2 * size + at),
                )
                total = vec.fma(values, vec.mul(vec.load(given, at), vec.broadcast(weights, tap)), total)
            for i in range(3):
                vec.store(lines, i * length + border + x, total[i])
        for step in range(0, row, vec.WIDTH):
            x = min(step, row - vec.WIDTH)
            of_mean, of_squares, of_products = _along(lines, length, x, channels, weights, (0, 0, 0))
            at = y * row + x
            of_mean = vec.fma(vec.mul(vec.load(a, at), 2.0), of_squares, of_mean)
            vec.store(of_a, at, vec.fma(vec.load(b, at), of_products, of_mean))


@part
def _taps(y, height, weights):
    """The weights of a column's window that lie inside the image, from one to another."""
    reach = len(weights) // 2
    return max(reach - y, 0), min(height - y + reach, len(weights))


@inline
def _along(lines, length, x, channels, weights, like):
    """The sums along rows, of as many lines as the tuple ``like`` is long, for sixteen numbers from ``x`` on."""
    total = vec.repeat(0.0, like)
    for tap in range(len(weights)):
        values = _loaded(lines, length, x + tap * channels, like)
        total = vec.fma(values, vec.broadcast(weights, tap), total)
    return total


@inline
def _loaded(lines, length, x, like):
    first, second, third = vec.load(lines, x), vec.load(lines, length + x), vec.load(lines, 2 * length + x)
    if len(like) == 3:
        return first, second, third
    return first, second, third, vec.load(lines, 3 * length + x)
