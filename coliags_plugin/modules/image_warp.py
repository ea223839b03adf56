"""Displacement of the image per frame, for tissue that moves."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar, Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from coliags_plugin.contracts import ViewModule
from coliags_plugin.core.json_files import JsonObject
from coliags_plugin.core.render_output import RenderOutput
from coliags_plugin.core.scenes import Scene, View
from coliags_plugin.core.settings import Settings
from coliags_plugin.core.tensors import bilinear
from coliags_plugin.modules.frame_rows import FrameRows


class ImageWarpSettings(Settings):
    """Options of the displacement of images."""

    cells: int = Field(default=8, ge=1)  # of the grid, along either side of the image
    # held-out frames: displacements interpolated in time between those of the training frames, or none
    untrained: Literal["interpolate", "none"] = "interpolate"


class ImageWarp(ViewModule[ImageWarpSettings]):
    """Learned smooth displacement of the rendered colours of each training frame.

    What a living wall has moved by since the other frames is, in one image, a displacement of its pixels. Depth and
    alpha stay those of the rigid wall. The mean displacement over the frames is subtracted, since geometry and poses
    explain it as well.

    Held-out frames of the video are displaced as the training frames around them; free cameras are not.
    """

    whole_image: ClassVar[bool] = True

    def __init__(self, settings: ImageWarpSettings, scene: Scene) -> None:
        super().__init__()
        self.settings = settings
        self.frames = FrameRows(scene)
        nodes = settings.cells + 1
        self.displacement = nn.Parameter(torch.zeros(len(self.frames), 2, nodes, nodes))

    @property
    def untrained_views(self) -> str:
        """Displacement of views that are not training frames."""
        if self.settings.untrained == "none":
            return "views without training are not displaced"
        return (
            "views without training are displaced by what is interpolated between the training frames before and "
            "after them; views beside the video as the nearest training camera"
        )

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Displacements of the grid's nodes, percent of the image's width."""
        return {"displacement": [self.displacement]}

    def shade(self, output: RenderOutput, view: View | None) -> RenderOutput:
        """Displace the colours."""
        if view is None or (self.frames.row(view) is None and self.settings.untrained == "none"):
            return output
        nodes = self.frames.interpolated(self.displacements(), view)
        height, width = output.rgb.shape[:2]
        shift = nn.functional.interpolate(nodes[None], (height, width), mode="bicubic", align_corners=True)[0]
        rows, columns = (torch.arange(size, device=shift.device) + 0.5 for size in (height, width))
        centers = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), dim=-1)
        return replace(output, rgb=bilinear(output.rgb, centers + shift.permute(1, 2, 0) * (width / 100.0)))

    def displacements(self) -> Float[Tensor, "F 2 N N"]:
        """Displacements (x, y) of the grid's nodes in the training frames, percent of the width; zero on average."""
        return self.displacement - self.displacement.mean(0)

    @property
    def learned(self) -> JsonObject:
        """Root mean square of the displacements over the training frames, percent of the image's width."""
        return {"displacement": float(self.displacements().detach().square().sum(1).mean().sqrt())}
