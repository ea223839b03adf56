"""Response curve of the camera, shared by all frames."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn
from typing_extensions import Self

from coliags_plugin.contracts import ViewModule
from coliags_plugin.core.json_files import JsonObject
from coliags_plugin.core.render_output import RenderOutput
from coliags_plugin.core.scenes import Scene, View
from coliags_plugin.core.settings import Settings
from coliags_plugin.core.tensors import constant

#: Brightest colour, relative to full scale, up to which the slope changes; glints and near walls lie beyond 1.
_TOP = 1.5
#: Slopes are at least this and at most its inverse, so that the curve rises and colours get gradients.
_LEAST_SLOPE = 0.02


class ResponseSettings(Settings):
    """Options of the response curve."""

    knee: float = Field(default=0.5, ge=0.05, lt=1.0)  # below it, colours stay as they are, which fixes the gauge
    segments: int = Field(default=8, ge=1, le=64)  # of equal length between the knee and 1.5, each of one slope


class CameraResponse(ViewModule[ResponseSettings]):
    """Learned increasing curve from colours to pixel values, one for all frames and colours (docs/methods.md 4.9).

    Cameras compress what is bright. A gain of a frame multiplies colours before that, so in a method config this module
    comes after ``gain``. The curve, gains and colours are only known up to a common factor and a common power, which
    the identity below the knee settles.

    Attributes:
        log_slope: Logarithm of the slope of every segment. [K]
    """

    def __init__(self, settings: ResponseSettings) -> None:
        super().__init__()
        self.settings = settings
        self.log_slope = nn.Parameter(torch.zeros(settings.segments))

    @classmethod
    def from_scene(cls, scene: Scene, settings: ResponseSettings, generator: torch.Generator) -> Self:
        """A response module that starts as the identity curve."""
        return cls(settings)

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
