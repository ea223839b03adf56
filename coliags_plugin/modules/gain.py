"""Gain per frame, for cameras with automatic exposure."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor, nn
from typing_extensions import Self

from coliags_plugin.contracts import ViewModule
from coliags_plugin.core.render_output import RenderOutput
from coliags_plugin.core.scenes import Scene, View
from coliags_plugin.core.settings import Settings
from coliags_plugin.modules.frame_rows import FrameRows


class FrameGainSettings(Settings):
    """Options of the gain per frame."""

    reference: str | None = None  # training frame whose gain is 1; None: the gains' geometric mean is 1
    untrained: Literal["interpolate", "mean"] = "interpolate"  # between the neighbours in time, or the mean gain


class FrameGain(ViewModule):
    """Learned factor on the rendered colours for each training frame.

    Colours and gains are only known up to a common factor, which ``reference`` settles. Free cameras have the mean
    gain.
    """

    Settings: ClassVar[type[Settings]] = FrameGainSettings

    def __init__(self, settings: Any, scene: Scene) -> None:
        super().__init__()
        self.settings = settings
        self.frames = FrameRows(scene)
        self._reference = None if settings.reference is None else self.frames.require(settings.reference, "gain")
        self.log_gain = nn.Parameter(torch.zeros(len(self.frames)))

    @classmethod
    def from_scene(cls, scene: Scene, settings: Any, generator: torch.Generator) -> Self:
        """Module with gains of 1.

        Raises:
            InputError: ``reference`` is no training frame.
        """
        return cls(settings, scene)

    @property
    def untrained_views(self) -> str:
        """Gain of views that are not training frames."""
        if self.settings.untrained == "mean":
            return "views without training have the mean gain of the training frames"
        return "views without training have a gain interpolated between the training frames before and after them"

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """The logarithms of the gains."""
        return {"gain": [self.log_gain]}

    def log_gains(self) -> Tensor:
        """Logarithm of every training frame's gain, relative to the reference. [F]"""
        zero = self.log_gain.mean() if self._reference is None else self.log_gain[self._reference]
        return self.log_gain - zero

    def gains(self) -> Tensor:
        """The gain of every training frame, in their order. [F]"""
        return self.log_gains().exp()

    def gain(self, view: View | None) -> Tensor:
        """The gain of a view. []"""
        log_gains = self.log_gains()
        row = self.frames.row(view)
        if row is not None:
            return log_gains[row].exp()
        if view is None or self.settings.untrained == "mean":
            return log_gains.mean().exp()
        before, after, share = self.frames.neighbours(view.time)
        return ((1.0 - share) * log_gains[before] + share * log_gains[after]).exp()

    def shade(self, output: RenderOutput, view: View | None) -> RenderOutput:
        """Multiply the colours."""
        return replace(output, rgb=output.rgb * self.gain(view))
