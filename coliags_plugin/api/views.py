"""Rendered views as arrays, shown as images in a notebook."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape

import numpy as np
from jaxtyping import Float32, UInt8

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError, check_name, did_you_mean
from coliags_plugin.core.render_output import DEPTH_KINDS
from coliags_plugin.core.scenes import Frame, Scene
from coliags_plugin.engine import rendering
from coliags_plugin.engine.trained import TrainedRun
from coliags_plugin.reporting.colormaps import (
    colorize_depth,
    colorize_error,
    depth_error,
    depth_limits,
    depth_scale_text,
    error_limit,
)
from coliags_plugin.reporting.image_files import EncodedImage, as_array, eight_bit

#: Smallest width of an image in a notebook, px on the screen.
_SHOWN_WIDTH = 200


@dataclass(frozen=True)
class RenderedView:
    """A rendered view, with the recorded one where it is of a frame.

    Attributes:
        name: Of the frame; empty for a free camera.
        camera: What it was rendered from.
        rgb: Rendered colours. [H, W, 3]
        alpha: Accumulated opacity. [H, W]
        depth: Rendered z-depth of the kind asked for, mm. [H, W]
        outputs: The other outputs asked for. [H, W] or [H, W, C] each
        true_rgb: Recorded colours; None for a free camera, and under another lamp. [H, W, 3]
        true_depth: True z-depth, mm; NaN where unknown or not to be looked at. None where there is none. [H, W]
        unit: Of depths.
    """

    name: str
    camera: Camera = field(repr=False)
    rgb: UInt8[np.ndarray, "H W 3"] = field(repr=False)
    alpha: Float32[np.ndarray, "H W"] = field(repr=False)
    depth: Float32[np.ndarray, "H W"] = field(repr=False)
    outputs: Mapping[str, np.ndarray] = field(repr=False)
    true_rgb: UInt8[np.ndarray, "H W 3"] | None = field(default=None, repr=False)
    true_depth: Float32[np.ndarray, "H W"] | None = field(default=None, repr=False)
    unit: str = "mm"

    def images(self) -> dict[str, UInt8[np.ndarray, "H W 3"]]:
        """Truth, rendering, depths on one scale, and depth error as images, by captions. [H, W, 3] each"""
        depths = [self.depth] if self.true_depth is None else [self.depth, self.true_depth]
        limits = depth_limits(depths)
        scale = depth_scale_text(limits, self.unit)
        shown = {} if self.true_rgb is None else {"truth": self.true_rgb}
        shown["rendered"] = self.rgb
        if self.true_depth is not None:
            shown[f"true depth, {scale}"] = colorize_depth(self.true_depth, limits)
        shown[f"depth, {scale}"] = colorize_depth(self.depth, limits)
        if self.true_depth is not None:
            error = depth_error(self.depth, self.true_depth)
            limit = error_limit([error])
            shown[f"depth error, 0 to {limit:g} {self.unit}, by square roots"] = colorize_error(error, limit)
        return shown

    def _repr_html_(self) -> str:
        """The images in a row with their captions; notebooks ask for it."""
        width = max(_SHOWN_WIDTH, self.camera.width)
        return (
            '<div style="display:flex;flex-wrap:wrap;gap:8px">'
            + "".join(
                f'<figure style="margin:0"><img alt="{escape(caption)}" width="{width}" '
                f'src="{EncodedImage.png(image).uri}">'
                f"<figcaption>{escape(caption)}</figcaption></figure>"
                for caption, image in self.images().items()
            )
            + "</div>"
        )


def view_of(trained: TrainedRun, of: str | Camera, depth: str, outputs: Sequence[str]) -> RenderedView:
    """Render a view of a run; see :meth:`coliags_plugin.api.runs.Run.render`."""
    check_name("kind of depth", depth, DEPTH_KINDS)
    wants = ("rgb", "alpha", depth, *outputs)
    trained.model.check_outputs(wants, "this view")
    frame, camera = (None, of) if isinstance(of, Camera) else _frame(trained.scene, of)
    output = rendering.render_view(trained, frame or camera, wants)
    return RenderedView(
        name="" if frame is None else frame.name,
        camera=camera,
        rgb=as_array(eight_bit(output.rgb)),
        alpha=as_array(output.alpha),
        depth=as_array(output[depth]),
        outputs={name: as_array(output[name]) for name in outputs},
        true_rgb=None if frame is None or trained.lamp is not None else as_array(frame.image),
        true_depth=None if frame is None else _true_depth(frame),
        unit=trained.scene.length_unit,
    )


def _frame(scene: Scene, name: str) -> tuple[Frame, Camera]:
    frames = {frame.name: frame for part in (scene.train, *scene.test_sets.values()) for frame in part}
    if name not in frames:
        raise InputError(
            f"scene '{scene.name}' has no frame '{name}'",
            "the name of a frame, see Run.frame_names(), or a camera",
            did_you_mean(name, frames),
        )
    return frames[name], frames[name].camera


def _true_depth(frame: Frame) -> Float32[np.ndarray, "H W"] | None:
    true = frame.true_depth
    if true is None:
        return None
    return as_array(true.masked_fill(~frame.valid, math.nan).float())
