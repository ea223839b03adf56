"""Pictures of a frame beside the browser view, made by the run's own renderer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import UInt8

from coliags_plugin.core.render_output import RenderOutput
from coliags_plugin.core.scenes import Frame
from coliags_plugin.engine.rendering import RGB_ERROR_LIMIT, depth_picture, render_view
from coliags_plugin.engine.trained import TrainedRun
from coliags_plugin.outputs.colormaps import (
    DEPTH_ERROR_LIMIT_MM,
    colorize_depth_error,
    colorize_rgb_error,
    depth_limits,
)
from coliags_plugin.outputs.image_files import as_array, eight_bit

#: Frames that the scale of depth is taken from.
_SAMPLED = 4


@dataclass(frozen=True)
class Picture:
    """An RGB image, and what its colours mean in plain text."""

    image: UInt8[np.ndarray, "H W 3"]
    caption: str


class FramePictures:
    """What can be shown of a frame: its render, errors and depth, as far as the run and its scene have them."""

    def __init__(self, trained: TrainedRun) -> None:
        self._trained = trained
        self._unit = trained.scene.length_unit
        self._makers: dict[str, Callable[[Frame, RenderOutput], Picture]] = {"render": self._colour}
        if trained.lamp is None:
            self._makers["colour error"] = self._colour_error
        if "depth_expected" in trained.model.outputs:
            self._makers["depth"] = self._depth
            if trained.scene.video[0].true_depth is not None:
                self._makers["depth error"] = self._depth_error

    @property
    def kinds(self) -> tuple[str, ...]:
        """Names of the pictures that this run has, the render first."""
        return tuple(self._makers)

    def of(self, frame: Frame, kind: str) -> Picture:
        """A picture of a frame of the run's scene, of one of the :attr:`kinds`."""
        return self._makers[kind](frame, self._render(frame))

    def _render(self, frame: Frame) -> RenderOutput:
        wants = ("rgb", "alpha", "depth_expected") if "depth" in self._makers else ("rgb", "alpha")
        return render_view(self._trained, frame, wants)

    def _colour(self, frame: Frame, output: RenderOutput) -> Picture:
        return Picture(as_array(eight_bit(output.rgb)), "render")

    def _colour_error(self, frame: Frame, output: RenderOutput) -> Picture:
        image = colorize_rgb_error(output.rgb.cpu(), frame.image, frame.valid.cpu(), RGB_ERROR_LIMIT)
        return Picture(image, f"colour error, 0 to {RGB_ERROR_LIMIT:g} of full scale")

    def _depth(self, frame: Frame, output: RenderOutput) -> Picture:
        low, high = self._depth_limits
        image = depth_picture(output, "depth_expected", (low, high))
        return Picture(image, f"expected depth, {low:g} to {high:g} {self._unit}")

    def _depth_error(self, frame: Frame, output: RenderOutput) -> Picture:
        true = frame.true_depth
        true = torch.full_like(output.alpha, torch.nan) if true is None else true
        rendered = output["depth_expected"].cpu()
        image = colorize_depth_error(rendered, true.cpu(), frame.valid.cpu(), DEPTH_ERROR_LIMIT_MM)
        return Picture(image, f"error of expected depth, 0 to {DEPTH_ERROR_LIMIT_MM:g} {self._unit}")

    @cached_property
    def _depth_limits(self) -> tuple[float, float]:
        """One scale for the whole video."""
        frames = self._trained.scene.video
        sample = frames[:: max(1, len(frames) // _SAMPLED)][:_SAMPLED]
        return depth_limits([as_array(self._render(frame)["depth_expected"]) for frame in sample], self._unit)
