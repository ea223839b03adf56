"""Length of a run, and values that change over it."""

from __future__ import annotations

from dataclasses import dataclass

#: Steps between two events where a run is so short that its share would be less: in long runs and in the shortest ones.
_LEAST_INTERVAL, _LEAST_OF_SHORTEST = 32, 4


@dataclass(frozen=True)
class Schedule:
    """Length of a run, and the run length for which the step numbers in its config were written.

    The one rule for every method (docs/configs.md): step numbers and intervals in a config keep their share of the run,
    so a run of more or fewer steps moves them, and a shorter run has as many events.

    Attributes:
        steps: Steps of this run.
        written_for: Steps of the run that the config's step numbers mean.
    """

    steps: int
    written_for: int

    def at(self, step: int) -> int:
        """The step of this run at which the config's ``step`` falls."""
        return round(step * self.steps / self.written_for)

    def interval(self, steps: int) -> int:
        """The steps of this run between events that the config places ``steps`` apart.

        Of a shortened run they are at least 32, or a fifth of the run but 4: fewer views say too little of what is to
        be done (docs/configs.md 5).
        """
        least = min(_LEAST_INTERVAL, max(self.steps // 5, _LEAST_OF_SHORTEST))
        return max(min(steps, least), self.at(steps))

    def events(self, after: int, until: int, every: int) -> range:
        """Steps of this run at which something happens: multiples of an interval, between two steps.

        Args:
            after: Step of the config after which it happens.
            until: Step of the config before which it happens.
            every: Interval, in steps of the config.
        """
        interval = self.interval(every)
        return range((self.at(after) // interval + 1) * interval, self.at(until), interval)


def steps_text(steps: range) -> str:
    """Name steps in a sentence: "never", "at step 330" or "at 24 steps, from 96 to 832"."""
    if len(steps) < 2:
        return f"at step {steps[0]}" if steps else "never"
    return f"at {len(steps)} steps, from {steps[0]} to {steps[-1]}"


def log_linear(start: float, end: float, progress: float) -> float:
    """``start`` to ``end`` on a straight line in the logarithm; progress is clipped to [0, 1] (docs/methods.md 2.3).

    An end that is not above 0 has no logarithm: ValueError.
    """
    if not (start > 0.0 and end > 0.0):
        raise ValueError(f"log_linear({start}, {end}): expected both ends above 0")
    u = min(max(progress, 0.0), 1.0)
    return float(start ** (1.0 - u) * end**u)
