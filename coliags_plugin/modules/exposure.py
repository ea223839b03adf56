"""Gain per frame, for cameras with automatic exposure, and the response curve of a camera, shared by all frames."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import ClassVar, Literal

import torch
from jaxtyping import Float, Int
from pydantic import Field
from torch import Tensor, nn

from coliags_plugin.contracts import ViewModule
from coliags_plugin.core.json_files import JsonObject
from coliags_plugin.core.photometry import fit_light
from coliags_plugin.core.render_output import RenderOutput
from coliags_plugin.core.scenes import Scene, View
from coliags_plugin.core.settings import Rates, Settings
from coliags_plugin.core.tensors import constant
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
                depths = depth.cpu()[frame.valid.cpu()]
            else:
                depths = torch.zeros(0) if sparse is None else sparse.depth.cpu()
            depths = depths[depths > 0.0].double()  # NaN is not
            if not len(depths):
                return None
            means.append(depths.reciprocal().mean().log())
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


class FrameGainSettings(Settings):
    """Options of the gain per frame."""

    untrained: Literal["interpolate", "metered"] = "interpolate"  # between neighbours in time, or that metered
    channels: Literal[1, 3] = 1  # one gain for all colours, or one each, for a white balance that drifts
    # 1, or fitted to surface points where there is depth (docs/methods.md 4.8)
    initial: Literal["one", "points"] = "one"
    fitted_rate: float = Field(default=0.1, gt=0.0, le=1.0)  # share of the learning rate that fitted gains have
    max_gain: float = Field(default=8.0, gt=1.0)  # gains are at least 1 / max_gain and at most max_gain


class FrameGain(ViewModule[FrameGainSettings]):
    """Learned factor on the rendered colours for each training frame.

    Colours and gains are only known up to a common factor: the gains' geometric mean is 1. Free cameras have that;
    views of test sets beside the video have the gain of the training frame taken closest to them.

    Attributes:
        log_gain: Logarithm for every training frame, before the mean is subtracted: all of it, or, over ``rate``,
            what is added to the fitted one. [F, C]
        fitted: Fitted logarithm; 0 where none is. [F, C]
        rate: Share of the learning rate. []
    """

    rates: ClassVar[Rates] = {"gain": {"lr": 0.03, "final_lr": 0.001}}

    fitted: Tensor
    rate: Tensor

    def __init__(self, settings: FrameGainSettings, scene: Scene) -> None:
        super().__init__(settings, scene)
        self.frames = FrameRows(scene)
        self.metering = Metering(scene, self.frames) if settings.untrained == "metered" else None
        self.log_gain = nn.Parameter(torch.zeros(len(self.frames), settings.channels))
        self.register_buffer("fitted", torch.zeros_like(self.log_gain))
        self.register_buffer("rate", torch.ones(()))

    @torch.no_grad()
    def prepare(self, scene: Scene) -> None:
        """Start at the gains of the scene's surface points, if the settings say so."""
        fitted = fit_light(scene) if self.settings.initial == "points" else None
        if fitted is not None:
            self.fitted.copy_(fitted.log_gains[:, None].expand_as(self.fitted))
            self.rate.fill_(self.settings.fitted_rate)

    @property
    def untrained_views(self) -> str:
        """Gain of views that are not training frames."""
        corrected = "" if self.metering is None else " and corrected for their brightness, as automatic exposure does"
        return (
            f"views without training have a gain interpolated in time between the training frames around them"
            f"{corrected}; views beside the video that of the nearest training camera"
        )

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """The logarithms of the gains."""
        return {"gain": [self.log_gain]}

    @property
    def gain_curve(self) -> tuple[Sequence[float], Float[Tensor, "F C"]]:
        """Index in the video of every training frame, and the learned part of its log gain over its rate."""
        return self.frames.times, self.log_gain

    def log_gains(self) -> Float[Tensor, "F C"]:
        """Logarithm of every training frame's gain, relative to the mean, within its bounds."""
        logs = self.fitted + self.rate * self.log_gain
        return self._bounded(logs - logs.mean(0))

    def _bounded(self, log_gains: Float[Tensor, "*S"]) -> Float[Tensor, "*S"]:
        limit = math.log(self.settings.max_gain)
        return log_gains.clamp(-limit, limit)

    def gain(self, view: View | None) -> Float[Tensor, "C"]:
        """The gain of a view."""
        log_gains = self.log_gains()
        if view is None:
            return log_gains.mean(0).exp()
        return self._bounded(self.frames.smoothed(log_gains, view)).exp()

    def shade(self, output: RenderOutput, view: View | None) -> RenderOutput:
        """Multiply the colours."""
        return replace(output, rgb=output.rgb * self.gain(view) * self._metered(output.rgb, view))

    def after_step(self, view: View, output: RenderOutput) -> None:
        """Keep the brightness of a training frame, for metering."""
        row = self.frames.row(view)
        if self.metering is not None and row is not None:
            self.metering.remember(row, output.rgb)

    @torch.no_grad()
    def _metered(self, rgb: Float[Tensor, "H W 3"], view: View | None) -> float:
        """Factor on the gain of a held-out frame of the video; 1 for all other views."""
        if self.metering is None or view is None or self.frames.row(view) is not None or self.frames.is_beside(view):
            return 1.0
        return math.exp(self.metering.correction(self.log_gains(), rgb, view))

    @property
    def learned(self) -> JsonObject:
        """Gains by training frame, and the names of frames whose gain is at a bound."""
        log_gains = self.log_gains().detach()
        reached = (log_gains.abs() >= math.log(self.settings.max_gain)).any(dim=1).tolist()
        return {
            "gains": dict(zip(self.frames.rows, log_gains.exp().tolist(), strict=True)),
            "at_bound": [name for name, row in self.frames.rows.items() if reached[row]],
        }


#: Brightest colour, relative to full scale, up to which the slope changes; glints and near walls lie beyond 1.
_TOP = 1.5
#: Slopes are at least this and at most its inverse, so that the curve rises and colours get gradients.
_LEAST_SLOPE = 0.02


class ResponseSettings(Settings):
    """Options of the response curve."""

    knee: float = Field(default=0.5, ge=0.05, lt=1.0)  # below it, colours stay as they are, which fixes the gauge
    segments: int = Field(default=8, ge=1, le=64)  # segments of one slope and equal length between the knee and 1.5


class CameraResponse(ViewModule[ResponseSettings]):
    """Learned increasing curve from colours to pixel values, one for all frames and colours (docs/methods.md 4.9).

    Cameras compress what is bright. A gain of a frame multiplies colours before that, so in a method config this module
    comes after ``gain``. The curve, gains and colours are only known up to a common factor and a common power, which
    the identity below the knee settles.

    Attributes:
        log_slope: Logarithm of the slope of every segment. [K]
    """

    rates: ClassVar[Rates] = {"slope": {"lr": 0.03, "final_lr": 0.001}}

    def __init__(self, settings: ResponseSettings, scene: Scene) -> None:
        super().__init__(settings, scene)
        self.log_slope = nn.Parameter(torch.zeros(settings.segments))

    @property
    def untrained_views(self) -> str:
        """Response of views that are not training frames."""
        return "all views have the same response curve"

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """The logarithms of the slopes."""
        return {"slope": [self.log_slope]}

    def curve(self, colors: Float[Tensor, "*S"]) -> Float[Tensor, "*S"]:
        """Pixel values of colours, both relative to full scale: piecewise linear and increasing. [*S]"""
        knee, segments = self.settings.knee, self.settings.segments
        length = (_TOP - knee) / segments
        slopes = self.log_slope.exp().clamp(_LEAST_SLOPE, 1.0 / _LEAST_SLOPE)
        flat = colors.reshape(-1)
        if flat.device.type != "cpu":  # what lies in each segment, without a list of which colours are bright
            lengths = constant((*[length] * (segments - 1), math.inf), flat)
            edges = constant(tuple(knee + length * index for index in range(segments)), flat)
            within = (flat[:, None] - edges).relu().clamp(max=lengths)
            return torch.where(flat > knee, knee + within @ slopes, flat).view_as(colors)
        starts = torch.cat([slopes.new_tensor([knee]), (knee + length * slopes.cumsum(0))[:-1]])
        bent = (flat > knee).nonzero().squeeze(1)
        bright = flat.index_select(0, bent)
        with torch.no_grad():
            segment = ((bright - knee) / length).clamp(0, segments - 1).long()
            origins = knee + length * segment
        values = starts.index_select(0, segment) + slopes.index_select(0, segment) * (bright - origins)
        return flat.index_copy(0, bent, values).view_as(colors)

    def shade(self, output: RenderOutput, view: View | None) -> RenderOutput:
        """Apply the curve to the colours."""
        return replace(output, rgb=self.curve(output.rgb))

    @property
    def learned(self) -> JsonObject:
        """Points of the curve: colours, and the pixel values that they become."""
        colors = torch.linspace(self.settings.knee, _TOP, self.settings.segments + 1)
        values = self.curve(colors.to(self.log_slope)).detach()
        return {"colors": colors.tolist(), "values": values.tolist()}
