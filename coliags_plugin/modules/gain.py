"""Gain per frame, for cameras with automatic exposure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar, Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn
from typing_extensions import Self

from coliags_plugin.contracts import GainModule
from coliags_plugin.core.json_files import JsonObject
from coliags_plugin.core.render_output import RenderOutput
from coliags_plugin.core.scenes import Scene, View
from coliags_plugin.core.settings import Settings
from coliags_plugin.lighting.photometry import fit_light
from coliags_plugin.modules.frame_rows import FrameRows
from coliags_plugin.modules.metering import Metering


class FrameGainSettings(Settings):
    """Options of the gain per frame."""

    reference: str | None = None  # training frame whose gain is 1; None: the gains' geometric mean is 1
    # between the neighbours in time, that corrected for brightness, or the mean gain
    untrained: Literal["interpolate", "metered", "mean"] = "interpolate"
    channels: Literal[1, 3] = 1  # one gain for all colours, or one each, for a white balance that drifts
    # 1, or fitted to surface points where there is depth (docs/methods.md 4.8)
    initial: Literal["one", "points"] = "one"
    fitted_rate: float = Field(default=0.1, gt=0.0, le=1.0)  # share of the learning rate that fitted gains have
    max_gain: float = Field(default=8.0, gt=1.0)  # gains are at least 1 / max_gain and at most max_gain


class FrameGain(GainModule[FrameGainSettings]):
    """Learned factor on the rendered colours for each training frame.

    Colours and gains are only known up to a common factor, which ``reference`` settles. Free cameras have the mean
    gain; views of test sets beside the video have that of the training frame taken closest to them.

    Attributes:
        log_gain: Logarithm for every training frame, before the reference is subtracted: all of it, or, over ``rate``,
            what is added to the fitted one. [F, C]
        fitted: Fitted logarithm; 0 where none is. [F, C]
        rate: Share of the learning rate. []
    """

    Settings: ClassVar[type[Settings]] = FrameGainSettings

    fitted: Tensor
    rate: Tensor

    def __init__(self, settings: FrameGainSettings, scene: Scene) -> None:
        super().__init__()
        self.settings = settings
        self.frames = FrameRows(scene)
        self._reference = None if settings.reference is None else self.frames.require(settings.reference, "gain")
        self.metering = Metering(scene, self.frames) if settings.untrained == "metered" else None
        self.log_gain = nn.Parameter(torch.zeros(len(self.frames), settings.channels))
        self.register_buffer("fitted", torch.zeros_like(self.log_gain))
        self.register_buffer("rate", torch.ones(()))

    @classmethod
    def from_scene(cls, scene: Scene, settings: FrameGainSettings, generator: torch.Generator) -> Self:
        """Module with gains of 1."""
        return cls(settings, scene)

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
        if self.settings.untrained == "mean":
            return "views without training have the mean gain of the training frames"
        corrected = "" if self.metering is None else " and corrected for their brightness, as automatic exposure does"
        return (
            f"views without training have a gain interpolated in time between the training frames around them"
            f"{corrected}; views beside the video that of the nearest training camera"
        )

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """The logarithms of the gains."""
        return {"gain": [self.log_gain]}

    @property
    def times(self) -> Sequence[float]:
        """Index in the video of every training frame."""
        return self.frames.times

    def log_gains(self) -> Float[Tensor, "F C"]:
        """Logarithm of every training frame's gain, relative to the reference, within its bounds."""
        logs = self.fitted + self.rate * self.log_gain
        zero = logs.mean(0) if self._reference is None else logs[self._reference]
        return self._bounded(logs - zero)

    def _bounded(self, log_gains: Float[Tensor, "*S"]) -> Float[Tensor, "*S"]:
        limit = math.log(self.settings.max_gain)
        return log_gains.clamp(-limit, limit)

    def gains(self) -> Float[Tensor, "F C"]:
        """The gain of every training frame, in their order."""
        return self.log_gains().exp()

    def gain(self, view: View | None) -> Float[Tensor, "C"]:
        """The gain of a view."""
        log_gains = self.log_gains()
        if view is None or (self.frames.row(view) is None and self.settings.untrained == "mean"):
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
