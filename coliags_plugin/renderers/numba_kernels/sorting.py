"""Gaussians drawn -> their numbers, nearest first. Those of equal depth keep the order they came in.

A radix sort, lowest digit first. Each thread counts and moves its own stretch of the list, and the stretches' counts
are added up in order, so the result is the same for any number of threads.
"""

from __future__ import annotations

import numba

from coliags_plugin.renderers.numba_kernels.compilation import part, region
from coliags_plugin.renderers.numba_kernels.lanes import lowest_bit
from coliags_plugin.renderers.numba_kernels.projection import PARCEL

#: Bits of a digit at most.
DIGIT_BITS = 11
#: Places for the counts of one stretch.
DIGITS = 1 << DIGIT_BITS
#: For fewer Gaussians one thread sorts: starting others several times over costs more than they gain.
_WORTH_SHARING = 1 << 17
#: Takes the number of the Gaussian out of a key.
NUMBER = (1 << 32) - 1


@part
def sort_by_depth(workers, parcels, depth_bits, drawn, keys, moved, ranges, digits):  # type: ignore[no-untyped-def]
    """Sort the Gaussians drawn.

    Args:
        workers: Threads to share the work.
        parcels: How many Gaussians of each parcel are drawn; overwritten. [2 for each parcel, the first is read]
        depth_bits: The depths' bits, which order positive numbers as the numbers do.
        drawn: One bit for each Gaussian of a group.
        keys: Out: the number of the Gaussian in the lower 32 bits. [Gaussians drawn]
        moved: Scratch. [Gaussians drawn]
        ranges: Scratch. [2 for each parcel]
        digits: Scratch. [DIGITS for each worker]

    Returns:
        How many there are.
    """
    count = 0
    parcel_count = len(parcels) // 2
    for parcel in range(parcel_count):
        count, parcels[2 * parcel] = count + parcels[2 * parcel], count
    if count < _WORTH_SHARING:
        workers = 1
    _collect(workers, parcel_count, parcels, depth_bits, drawn, keys, ranges)
    lowest, highest = ranges[0], ranges[1]
    for parcel in range(parcel_count):
        lowest, highest = min(lowest, ranges[2 * parcel]), max(highest, ranges[2 * parcel + 1])
    significant = 0
    while lowest + (1 << significant) <= highest:
        significant += 1
    passes = (significant + DIGIT_BITS - 1) // DIGIT_BITS
    width = (significant + passes - 1) // max(passes, 1)
    source, target = keys, moved
    for turn in range(passes):
        shift, mask = turn * width, (1 << width) - 1
        _count(workers, count, source, lowest, shift, mask, digits)
        _turn_counts_into_places(workers, mask + 1, digits)
        _move(workers, count, source, lowest, shift, mask, digits, target)
        source, target = target, source
    if passes & 1:
        keys[:count] = moved[:count]
    return count


@part
def _collect(workers, parcel_count, parcels, depth_bits, drawn, keys, ranges):  # type: ignore[no-untyped-def]
    """Write the keys of all parcels."""
    if workers == 1:
        for parcel in range(parcel_count):
            _collect_parcel(parcel, parcels[2 * parcel], depth_bits, drawn, keys, ranges)
    else:
        _collect_together(workers, parcel_count, parcels, depth_bits, drawn, keys, ranges)


@region
def _collect_together(workers, parcel_count, parcels, depth_bits, drawn, keys, ranges):  # type: ignore[no-untyped-def]
    for worker in numba.prange(workers):
        for parcel in range(parcel_count * worker // workers, parcel_count * (worker + 1) // workers):
            _collect_parcel(parcel, parcels[2 * parcel], depth_bits, drawn, keys, ranges)


@part
def _collect_parcel(parcel, first, depth_bits, drawn, keys, ranges):  # type: ignore[no-untyped-def]
    """Write the keys of one parcel of Gaussians, depth above and number below, from ``first`` on."""
    lowest, highest = NUMBER, 0
    place = first
    for group in range(parcel * (PARCEL // 16), min((parcel + 1) * (PARCEL // 16), len(drawn))):
        flags = drawn[group]
        while flags:
            index = 16 * group + lowest_bit(flags)
            flags &= flags - 1
            depth = int(depth_bits[index])
            keys[place] = depth << 32 | index
            place += 1
            lowest, highest = min(lowest, depth), max(highest, depth)
    ranges[2 * parcel] = lowest
    ranges[2 * parcel + 1] = highest


@part
def _count(workers, count, keys, lowest, shift, mask, digits):  # type: ignore[no-untyped-def]
    """Count the digits of all stretches."""
    if workers == 1:
        _count_stretch(0, 0, count, keys, lowest, shift, mask, digits)
    else:
        _count_together(workers, count, keys, lowest, shift, mask, digits)


@region
def _count_together(workers, count, keys, lowest, shift, mask, digits):  # type: ignore[no-untyped-def]
    for worker in numba.prange(workers):
        first, last = count * worker // workers, count * (worker + 1) // workers
        _count_stretch(worker, first, last, keys, lowest, shift, mask, digits)


@part
def _count_stretch(stretch, first, last, keys, lowest, shift, mask, digits):  # type: ignore[no-untyped-def]
    """How often each digit occurs among keys ``first`` to ``last``: row ``stretch`` of ``digits``."""
    start = stretch * DIGITS
    for digit in range(mask + 1):
        digits[start + digit] = 0
    for place in range(first, last):
        digits[start + (((keys[place] >> 32) - lowest) >> shift & mask)] += 1


@part
def _turn_counts_into_places(stretches, values, digits):  # type: ignore[no-untyped-def]
    """Where the first key of each digit and stretch goes."""
    total = 0
    for digit in range(values):
        for stretch in range(stretches):
            at = stretch * DIGITS + digit
            total, digits[at] = total + digits[at], total


@part
def _move(workers, count, keys, lowest, shift, mask, digits, moved):  # type: ignore[no-untyped-def]
    """Move the keys of all stretches."""
    if workers == 1:
        _move_stretch(0, 0, count, keys, lowest, shift, mask, digits, moved)
    else:
        _move_together(workers, count, keys, lowest, shift, mask, digits, moved)


@region
def _move_together(workers, count, keys, lowest, shift, mask, digits, moved):  # type: ignore[no-untyped-def]
    for worker in numba.prange(workers):
        first, last = count * worker // workers, count * (worker + 1) // workers
        _move_stretch(worker, first, last, keys, lowest, shift, mask, digits, moved)


@part
def _move_stretch(stretch, first, last, keys, lowest, shift, mask, digits, moved):  # type: ignore[no-untyped-def]
    """Put keys ``first`` to ``last`` where their digit belongs."""
    start = stretch * DIGITS
    for place in range(first, last):
        key = keys[place]
        at = start + (((key >> 32) - lowest) >> shift & mask)
        moved[digits[at]] = key
        digits[at] += 1
