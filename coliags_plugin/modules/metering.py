"""How automatic exposure answers the brightness of what a camera sees, learned from the training frames."""

from __future__ import annotations

from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from coliags_plugin.core.scenes import Scene, View
from coliags_plugin.modules.frame_rows import FrameRows

#: Frames on either side of those that the response is fitted on, at least.
_FEWEST = 3
#: Least F statistic of how depth tells brightness, below which an instrument is weak (Staiger & Stock 1997).
_STRONG = 10.0
#: Least brightness, of encoded colours in [0, 1]; more than 0, which stands for none.
_DARKEST = 1e-3


class Metering(nn.Module):
    """Correction of gains interpolated in time, from the brightness of a rendered view (docs/methods.md 4.7).

    Brightness is that of renderings before gain and response curve, of training frames too: what these recorded is
    compressed where it is bright, and clipped. It is measured where all masks of the training frames are True.

    Attributes:
        brightness: Mean colour of every training frame when it was last rendered in training; 0 before that. [F]
    """

    brightness: Tensor

    def __init__(self, scene: Scene, frames: FrameRows) -> None:
        super().__init__()
        self._scene, self._frames = scene, frames
        self.register_buffer("brightness", torch.zeros(len(frames)))

    @cached_property
    def _common(self) -> tuple[torch.Size, Int[Tensor, "P"]] | None:
        """Size of the training frames, and which pixels, row by row, are valid in all of them.

        None where these are all or none, or the sizes differ. The pixels are on the device of ``brightness``.
        """
        masks = [frame.mask.cpu() for frame in self._scene.train if frame.mask is not None]
        if not masks or any(mask.shape != masks[0].shape for mask in masks):
            return None
        common = torch.stack(masks).all(0)
        pixels = common.flatten().nonzero().squeeze(1)
        return (common.shape, pixels.to(self.brightness.device)) if len(pixels) else None

    @torch.no_grad()
    def remember(self, row: int, rgb: Float[Tensor, "H W 3"]) -> None:
        """Keep the brightness of a training frame, rendered before its gain."""
        self.brightness[row] = self._measure(rgb)

    def _measure(self, rgb: Float[Tensor, "H W 3"]) -> Float[Tensor, ""]:
        """Mean colour over the pixels that are valid in every training frame."""
        colors, common = rgb, self._common
        if common is not None and common[0] == rgb.shape[:2]:
            colors = rgb.reshape(-1, 3).index_select(0, common[1].to(rgb.device))
        return colors.mean().clamp_min(_DARKEST)

    def correction(self, log_gains: Float[Tensor, "F C"], rgb: Float[Tensor, "H W 3"], view: View) -> float:
        """Correction of the log gain of a held-out view, to add to the one interpolated in time.

        A view, before its gain, that is brighter than interpolation in time would make it has a smaller gain, by as
        much as training frames had that lie as far from others. 0 until every training frame has been rendered in
        training.
        """
        if not self.brightness.all():
            return 0.0
        before, after, _ = self._frames.neighbours(view)
        expected = self._frames.smoothed(self._log_brightness[:, None], view)[0]
        gains = log_gains.detach().cpu().double().mean(1)
        return self.response(gains, before, after) * float(self._measure(rgb).cpu().double().log() - expected)

    @property
    def _log_brightness(self) -> Float[Tensor, "F"]:
        return self.brightness.cpu().double().log()

    @cached_property
    def _log_nearness(self) -> Float[Tensor, "F"] | None:
        """Logarithm of the mean inverse depth of every training frame's data; None where a frame has none."""
        means = []
        for frame in self._scene.train:
            sparse, depth = frame.sparse_depth, frame.depth
            if depth is not None:
                known = depth.cpu()[frame.valid.cpu()]
            else:
                known = torch.zeros(0) if sparse is None else sparse.depth.cpu()
            known = known[known > 0.0].double()  # NaN is not
            if not len(known):
                return None
            means.append(known.reciprocal().mean().log())
        return torch.stack(means)

    def response(self, gains: Float[Tensor, "F"], before: int, after: int) -> float:
        """Change of the log gain per change of log brightness over the gap between two frames, from -1 to 0.

        Over the training frames, each against what its neighbours at half the gap on either side predict. A fitted gain
        and the brightness that it multiplies have errors, partly opposite ones, that least squares takes for a
        response. The depth of the data, which they have no part in, is the instrument: covariance of the gain with log
        inverse depth over that of the brightness. 0 where the video is too short, without depth, or depth tells too
        little of the brightness.
        """
        nearness = self._log_nearness
        if nearness is None:
            return 0.0
        times = torch.tensor(self._frames.times, dtype=torch.float64)
        gap = float(times[after] - times[before])
        levels = torch.stack([gains, self._log_brightness, nearness])
        most = (len(times) - _FEWEST) // 2
        if most < 1:
            return 0.0
        reach = min(max(1, round(0.5 * gap / float(times.diff().median()))), most)
        middle = slice(reach, len(times) - reach)
        first, last = times[: -2 * reach], times[2 * reach :]
        expected = torch.lerp(levels[:, : -2 * reach], levels[:, 2 * reach :], (times[middle] - first) / (last - first))
        gain, brightness, near = levels[:, middle] - expected
        common = brightness @ near
        explained = common**2 / ((brightness @ brightness) * (near @ near)).clamp_min(1e-24)
        # Frames nearer to each other than the reach share neighbours.
        if not len(near) / reach * explained >= _STRONG * (1.0 - explained):
            return 0.0
        return float((gain @ near / common).clamp(-1.0, 0.0))
