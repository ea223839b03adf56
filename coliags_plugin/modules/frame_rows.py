"""Parameter rows per training frame."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping

from coliags_plugin.core.errors import InputError, did_you_mean
from coliags_plugin.core.scenes import Scene, View


class FrameRows:
    """Lookup of parameter rows by view.

    Args:
        scene: Scene whose training frames have one row each, in their order.
    """

    def __init__(self, scene: Scene) -> None:
        self.rows: Mapping[str, int] = {frame.name: row for row, frame in enumerate(scene.train)}
        self._held_out = {frame.name for frames in scene.test_sets.values() for frame in frames}
        by_time = sorted((float(frame.index), row) for row, frame in enumerate(scene.train))
        self._times = [time for time, _ in by_time]
        self._rows_by_time = [row for _, row in by_time]

    def __len__(self) -> int:
        return len(self.rows)

    def row(self, view: View | None) -> int | None:
        """The row of a training frame; None for other views."""
        return self.rows.get(view.name) if view is not None and view.trained else None

    def neighbours(self, time: float) -> tuple[int, int, float]:
        """Rows of the training frames before and after a time, and its relative position between them, in [0, 1].

        Beyond the ends both are the nearest frame's.
        """
        index = bisect_right(self._times, time)
        before, after = max(0, index - 1), min(index, len(self._times) - 1)
        span = self._times[after] - self._times[before]
        share = (time - self._times[before]) / span if span > 0 else 0.0
        return self._rows_by_time[before], self._rows_by_time[after], share

    def require(self, name: str, asking: str) -> int:
        """The row of a frame that settings name.

        Raises:
            InputError: No training frame has that name.
        """
        if name in self.rows:
            return self.rows[name]
        shown = ", ".join(list(self.rows)[:6]) + (", ..." if len(self.rows) > 6 else "")
        held_out = ", which is held out" if name in self._held_out else ""
        raise InputError(
            f"{asking} names frame '{name}'{held_out}",
            f"a training frame, one of {shown}",
            did_you_mean(name, self.rows),
        )
