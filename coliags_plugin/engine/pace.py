"""Remaining time of a long job, from how long its recent units took."""

from __future__ import annotations

import time
from collections.abc import Sequence
from statistics import median

#: Seconds over which the time of a unit is averaged at least, as units may end in bursts.
_LEAST_SECONDS = 0.5
#: Averages kept of the whole job, and from how many on growth is estimated.
_MOST, _FOR_GROWTH = 120, 30
#: Averages before anything is said, and units of a job so short that one is enough.
_LEAST, _SHORT = 3, 10
#: By how much units to come may be thought slower or faster than the present ones, on average.
_MOST_GROWTH = 1.5


class Pace:
    """Seconds to go of a job of ``total`` units, ``start`` of which were done before.

    The present time of a unit is the median over the last third of the job so far. Its growth since the first third,
    as of training whose Gaussians become more, is taken to go on, up to a factor. The first average counts for nothing:
    caches are empty and kernels compiled then.
    """

    def __init__(self, total: int, start: int = 0) -> None:
        self._total, self._done = total, start
        self._averaged, self._since = start, time.monotonic()  # units up to the last average, and when they were done
        self._averages: list[tuple[float, float]] = []  # place in units, and seconds of a unit there
        self._least_seconds, self._is_first = _LEAST_SECONDS, True

    def update(self, done: int) -> None:
        """Take note of how much is done now."""
        self._done, now = done, time.monotonic()
        units, seconds = done - self._averaged, now - self._since
        if units <= 0 or seconds < self._least_seconds:
            return
        if not self._is_first:
            self._averages.append(((done + self._averaged) / 2, seconds / units))
        self._is_first, self._averaged, self._since = False, done, now
        if len(self._averages) > _MOST:  # the whole job, in half as many
            pairs = zip(self._averages[::2], self._averages[1::2], strict=False)
            self._averages = [((a[0] + b[0]) / 2, (a[1] + b[1]) / 2) for a, b in pairs]
            self._least_seconds *= 2

    @property
    def left(self) -> float | None:
        """Seconds to go; None: not known yet."""
        averages, units = self._averages, self._total - self._done
        if len(averages) < (1 if self._total <= _SHORT else _LEAST):
            return None
        here, present = _middle(averages[-max(1, len(averages) // 3) :])
        expected = present
        if len(averages) >= _FOR_GROWTH:
            then, before = _middle(averages[: len(averages) // 3])
            expected += (present - before) / (here - then) * (self._done + units / 2 - here)
        return units * min(max(expected, present / _MOST_GROWTH), present * _MOST_GROWTH)


def _middle(averages: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Medians of place and of seconds."""
    places, seconds = zip(*averages, strict=True)
    return median(places), median(seconds)
