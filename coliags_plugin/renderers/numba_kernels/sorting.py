"""Stable radix sort of the drawn Gaussians by depth, nearest first.

Least significant digit first. The list is divided into stretches that threads count and move independently; their
counts are summed in order, so the result does not depend on their number.
"""

from __future__ import annotations

from coliags_plugin.core.numba_kernels import lanes as vec
from coliags_plugin.core.numba_kernels.compilation import kernel
from coliags_plugin.core.numba_kernels.threads import pieces
from coliags_plugin.renderers.numba_kernels import layout

#: Largest number of bits of a digit.
DIGIT_BITS = 11
#: Number of counters of one stretch.
DIGITS = 1 << DIGIT_BITS
#: Mask of the Gaussian's index in a key.
NUMBER = (1 << 32) - 1


@kernel
def collect(counters, depth_bits, drawn, places, keys, lowest, highest):
    """Write the sort keys: depth bits in the upper half, index of the Gaussian in the lower.

    The bits of positive floats order as the numbers do. ``places`` is the offset of the first key of each parcel; ``lowest``
    and ``highest`` are written: the range of depth bits in each parcel.
    """
    per_parcel = layout.PARCEL // layout.GROUP
    for parcel in pieces(counters, 0, len(places)):
        low, high = NUMBER, 0
        place = places[parcel]
        for group in range(parcel * per_parcel, min((parcel + 1) * per_parcel, len(drawn))):
            flags = drawn[group]
            while flags:
                index = layout.GROUP * group + vec.lowest_bit(flags)
                flags &= flags - 1
                depth = int(depth_bits[index])
                keys[place] = depth << 32 | index
                place += 1
                low, high = min(low, depth), max(high, depth)
        lowest[parcel], highest[parcel] = low, high


@kernel
def count_digits(counters, stretches, keys, lowest, shift, mask, digits):
    """Histogram of the digits, ``mask`` after ``shift`` of depth bits less ``lowest``. [DIGITS for each stretch]"""
    for stretch in pieces(counters, 0, stretches):
        start = stretch * DIGITS
        for digit in range(mask + 1):
            digits[start + digit] = 0
        for place in range(len(keys) * stretch // stretches, len(keys) * (stretch + 1) // stretches):
            digits[start + (((keys[place] >> 32) - lowest) >> shift & mask)] += 1


@kernel
def place_digits(stretches, mask, digits):
    """Turn the histograms into offsets of the first key of each digit and stretch."""
    total = 0
    for digit in range(mask + 1):
        for stretch in range(stretches):
            at = stretch * DIGITS + digit
            total, digits[at] = total + digits[at], total


@kernel
def move_by_digit(counters, stretches, keys, lowest, shift, mask, digits, moved):
    """Scatter the keys into ``moved`` by digit; the offsets in ``digits`` are incremented."""
    for stretch in pieces(counters, 1, stretches):
        start = stretch * DIGITS
        for place in range(len(keys) * stretch // stretches, len(keys) * (stretch + 1) // stretches):
            key = keys[place]
            at = start + (((key >> 32) - lowest) >> shift & mask)
            moved[digits[at]] = key
            digits[at] += 1
