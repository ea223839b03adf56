"""How automatic exposure answers the brightness of what a camera sees, learned from the training frames."""

from __future__ import annotations

from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from coliags_plugin.core.scenes import Scene
from coliags_plugin.modules.frame_rows import FrameRows

#: Frames on either side of those that the response is fitted on, at least.
_FEWEST = 3
#: Least brightness, of encoded colours in [0, 1].
_DARKEST = 1e-3


class Metering:
    """Correction of gains interpolated in time, from the brightness of a rendered view (docs/methods.md 4.7).

    Args:
        scene: The scene, of whose training frames the brightness is measured, where all of their masks are True.
        frames: Rows of the training frames.
    """

    def __init__(self, scene: Scene, frames: FrameRows) -> None:
        self._scene, self._frames = scene, frames

    @cached_property
    def _valid(self) -> Bool[Tensor, "H W"] | None:
        return _common_valid(self._scene)

    @cached_property
    def _recorded(self) -> Float[Tensor, "F"]:
        """Log brightness of the training frames' images, computed on first use. [F]"""
        return torch.stack([self.log_brightness(frame.rgb) for frame in self._scene.train])

    def log_brightness(self, rgb: Float[Tensor, "H W 3"]) -> Float[Tensor, ""]:
        """Logarithm of the mean colour, where all training frames are valid. []"""
        colors = rgb.cpu() if self._valid is None or self._valid.shape != rgb.shape[:2] else rgb.cpu()[self._valid]
        return colors.double().mean().clamp_min(_DARKEST).log()

    def correction(
        self, log_gains: Float[Tensor, "F C"], rgb: Float[Tensor, "H W 3"], before: int, after: int, share: float
    ) -> float:
        """What to add to log gains interpolated between two training frames.

        A view that is brighter than interpolation between the two frames would make it has a smaller gain, by as much
        as training frames had that lie as far from others.

        Args:
            log_gains: Of the training frames. [F, C]
            rgb: The view before its gain.
            before: Row of the frame before.
            after: Row of the frame after.
            share: Place of the view between them, in [0, 1].
        """
        gains = log_gains.detach().cpu().double().mean(1)
        seen = self._recorded - gains
        expected = torch.lerp(seen[before], seen[after], share)
        return float(self.response(gains, before, after) * (self.log_brightness(rgb) - expected))

    def response(self, gains: Float[Tensor, "F"], before: int, after: int) -> float:
        """Change of the log gain per change of log brightness over a gap in time, from -1 to 0.

        Least squares over the training frames, each against what its neighbours at half the gap on either side
        predict; 0 where the video is too short for that.

        Args:
            gains: Logarithms, of the training frames. [F]
            before: Row of the frame at the gap's start.
            after: Row of the frame at its end.
        """
        times = torch.tensor(self._frames.times, dtype=torch.float64)
        gap = float(times[after] - times[before])
        levels = torch.stack([gains, self._recorded - gains])
        most = (len(times) - _FEWEST) // 2
        if most < 1:
            return 0.0
        reach = min(max(1, round(0.5 * gap / float(times.diff().median()))), most)
        middle = slice(reach, len(times) - reach)
        first, last = times[: -2 * reach], times[2 * reach :]
        expected = torch.lerp(levels[:, : -2 * reach], levels[:, 2 * reach :], (times[middle] - first) / (last - first))
        gain, brightness = levels[:, middle] - expected
        return float((gain @ brightness / (brightness @ brightness).clamp_min(1e-12)).clamp(-1.0, 0.0))


def _common_valid(scene: Scene) -> Bool[Tensor, "H W"] | None:
    """Where all training frames are valid; None where that is everywhere, nowhere, or their sizes differ."""
    masks = [frame.mask.cpu() for frame in scene.train if frame.mask is not None]
    if not masks or any(mask.shape != masks[0].shape for mask in masks):
        return None
    common = torch.stack(masks).all(0)
    return common if common.any() else None
