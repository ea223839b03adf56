"""Parameter rows per training frame."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping

import torch
from jaxtyping import Float
from scipy.interpolate import Akima1DInterpolator
from torch import Tensor

from coliags_plugin.core.scenes import Scene, View


class FrameRows:
    """Lookup of parameter rows by view: one for each training frame, in their order.

    ``times`` are the frames' indices in the video, by row.
    """

    def __init__(self, scene: Scene) -> None:
        self.rows: Mapping[str, int] = {frame.name: row for row, frame in enumerate(scene.train)}
        self.times = [float(frame.index) for frame in scene.train]
        self._nearest = _nearest_rows(scene)

    def __len__(self) -> int:
        return len(self.rows)

    def row(self, view: View | None) -> int | None:
        """The row of a training frame; None for other views."""
        return self.rows.get(view.name) if view is not None and view.trained else None

    def is_beside(self, view: View) -> bool:
        """True if a view is of a test set beside the video."""
        return view.name in self._nearest

    def neighbours(self, view: View) -> tuple[int, int, float]:
        """Rows of the training frames before and after a view, and its relative position between them, in [0, 1].

        Beyond the ends both are the nearest frame's. Indices of test sets beside the video are not times in it: for
        these both are those of the training frame with the nearest camera.
        """
        if self.is_beside(view):
            row = self._nearest[view.name]
            return row, row, 0.0
        index = bisect_right(self.times, view.time)
        before, after = max(0, index - 1), min(index, len(self.times) - 1)
        span = self.times[after] - self.times[before]
        return before, after, (view.time - self.times[before]) / span if span > 0 else 0.0

    def interpolated(self, values: Float[Tensor, "F *S"], view: View) -> Float[Tensor, "*S"]:
        """Look up a training frame's values, or interpolate between those around another view in time.

        Linearly between those of its :meth:`neighbours`. [*S]
        """
        row = self.row(view)
        if row is not None:
            return values[row]
        before, after, share = self.neighbours(view)
        return (1.0 - share) * values[before] + share * values[after]

    def smoothed(self, values: Float[Tensor, "F C"], view: View) -> Float[Tensor, "C"]:
        """Look up a training frame's values, or interpolate smoothly between those around another view in time.

        By Akima's cubic splines, whose slopes are those of the nearest frames, without gradient; like
        :meth:`interpolated` beyond the ends and for views beside the video.
        """
        if self.row(view) is not None or self.neighbours(view)[2] == 0.0:
            return self.interpolated(values, view)
        curve = Akima1DInterpolator(self.times, values.detach().cpu().double().numpy())
        return torch.from_numpy(curve(view.time)).to(values)


def _nearest_rows(scene: Scene) -> dict[str, int]:
    """Row of the training frame with the nearest camera, for every view of test sets beside the video, by name."""
    video = {frame.name for frame in scene.video}
    others = {frame.name: frame for part in scene.test_sets.values() for frame in part if frame.name not in video}
    if not others or not scene.train:
        return {}
    centers = torch.stack([frame.camera.center.double() for frame in scene.train])
    return {
        name: int((centers - frame.camera.center.to(centers)).norm(dim=1).argmin()) for name, frame in others.items()
    }
