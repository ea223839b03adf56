"""When to compute again for a camera that moves."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable


class Pace:
    """Decides when work wanted by a moving camera is due: once it rests, and not too often.

    Thread-safe.

    Args:
        rest: Seconds without a movement after which the camera rests.
        every: Least seconds between the end of one piece of work and the start of the next.
        clock: Seconds, ascending.
    """

    def __init__(self, rest: float, every: float, clock: Callable[[], float] = time.monotonic) -> None:
        self.rest = rest
        self.every = every
        self._clock = clock
        self._lock = threading.Lock()
        self._wanted_from: float | None = None
        self._ended = -float("inf")

    def moved(self) -> None:
        """The camera has moved: the work is wanted, once it rests."""
        with self._lock:
            self._wanted_from = self._clock() + self.rest

    def want(self) -> None:
        """The work is wanted without a movement, as after a change of options."""
        with self._lock:
            if self._wanted_from is None:
                self._wanted_from = self._clock()

    def wait(self) -> float | None:
        """Seconds until the work is due, 0 if it is; None where none is wanted."""
        with self._lock:
            if self._wanted_from is None:
                return None
            return max(0.0, max(self._wanted_from, self._ended + self.every) - self._clock())

    def begin(self) -> None:
        """The work begins: what is wanted from now on is wanted anew."""
        with self._lock:
            self._wanted_from = None

    def end(self) -> None:
        """The work has ended."""
        with self._lock:
            self._ended = self._clock()
