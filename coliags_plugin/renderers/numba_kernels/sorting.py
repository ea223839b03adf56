"""Gaussians drawn -> their numbers, nearest first. Those of equal depth keep the order they came in.

A radix sort, lowest digit first. Each thread counts and moves its own stretch of the list, and the stretches' counts are
added up in order, so the result is the same for any number of threads.
"""

from __future__ import annotations

from coliags_plugin.renderers.numba_kernels.compilation import part
from coliags_plugin.renderers.numba_kernels.projection import PARCEL

#: Bits of a digit at most.
DIGIT_BITS = 11
#: Places for the counts of one stretch.
DIGITS = 1 << DIGIT_BITS
_NUMBER = (1 << 32) - 1


@part
def collect_parcel(parcel, first, depth_bits, drawn, keys, ranges):  # type: ignore[no-untyped-def]
    """Write the keys of one parcel of Gaussians: depth above, number of the Gaussian below.

    Args:
        parcel: Which.
        first: Where in ``keys`` its own begin.
        depth_bits: The depths' bits, which order positive numbers as the numbers do.
        drawn: One bit for each Gaussian of a group.
        keys: Out.
        ranges: Out: least and greatest depth bits of each parcel. [2 for each parcel]
    """
    lowest, highest = _NUMBER, 0
    place = first
    for group in range(parcel * (PARCEL // 16), min((parcel + 1) * (PARCEL // 16), len(drawn))):
        flags = drawn[group]
        for index in range(16 * group, 16 * group + 16):
            if flags & 1:
                depth = int(depth_bits[index])
                keys[place] = depth << 32 | index
                place += 1
                lowest, highest = min(lowest, depth), max(highest, depth)
            flags >>= 1
    ranges[2 * parcel] = lowest
    ranges[2 * parcel + 1] = highest


@part
def count_digits(stretch, keys, first, last, lowest, shift, mask, counts):  # type: ignore[no-untyped-def]
    """How often each digit occurs among keys ``first`` to ``last``: row ``stretch`` of ``counts``."""
    start = stretch * DIGITS
    for digit in range(mask + 1):
        counts[start + digit] = 0
    for place in range(first, last):
        counts[start + (((keys[place] >> 32) - lowest) >> shift & mask)] += 1


@part
def turn_counts_into_places(stretches, digits, counts):  # type: ignore[no-untyped-def]
    """Where the first key of each digit and stretch goes."""
    total = 0
    for digit in range(digits):
        for stretch in range(stretches):
            at = stretch * DIGITS + digit
            total, counts[at] = total + counts[at], total


@part
def move_by_digit(stretch, keys, first, last, lowest, shift, mask, places, moved):  # type: ignore[no-untyped-def]
    """Put keys ``first`` to ``last`` where their digit belongs."""
    start = stretch * DIGITS
    for place in range(first, last):
        key = keys[place]
        at = start + (((key >> 32) - lowest) >> shift & mask)
        moved[places[at]] = key
        places[at] += 1
