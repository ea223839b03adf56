"""Pose correction per frame, for inaccurate camera poses, and displacement of its image, for tissue that moves."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import ClassVar, Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from coliags_plugin.contracts import ViewModule
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.json_files import JsonObject
from coliags_plugin.core.render_output import RenderOutput
from coliags_plugin.core.scenes import Scene, View
from coliags_plugin.core.settings import Rates, Settings
from coliags_plugin.core.tensors import bilinear, constant
from coliags_plugin.modules.frame_rows import FrameRows

#: Approximate number of scene points that the median depth is computed from.
_DEPTH_POINTS = 4096
#: What becomes of views where corrections do not apply.
_UNCORRECTED = "no view is corrected, as the depth of the scene is not estimated"


class CorrectionSettings(Settings):
    """Options of corrections per frame."""

    # which scenes are corrected: all, or those whose depth was estimated, and their poses as a rule, from the images
    scenes: Literal["all", "estimated"] = "all"

    def apply_to(self, scene: Scene) -> bool:
        """True if frames of a scene are corrected."""
        return self.scenes == "all" or scene.has_estimated_depth


class PoseCorrection(ViewModule[CorrectionSettings]):
    """Learned rotation and translation of each training camera, in world axes.

    It turns about the point on its optical axis at the median depth of the scene's points in view (its pivot).

    All poses and the field could move together without any image changing: the mean rotation and translation are
    subtracted.

    Held-out frames of the video are corrected as the training frames around them are, since errors of tracked poses
    change slowly; no pixel of theirs is used. Views beside the video take the correction of the nearest training
    camera. Free cameras stay.
    """

    rates: ClassVar[Rates] = {
        "rotation": {"lr": 0.0001, "final_lr": 0.00001},  # radians
        "translation": {"lr": 0.003, "final_lr": 0.0003},  # scene units, at depths of about 30
    }

    def __init__(self, settings: CorrectionSettings, scene: Scene) -> None:
        super().__init__(settings, scene)
        self.frames, self._applies = FrameRows(scene), settings.apply_to(scene)
        corrected = scene.train if self._applies else []
        self._pivot_depths = [_median_depth(frame.camera, scene) for frame in corrected]
        self.rotation = nn.Parameter(torch.zeros(len(self.frames), 3), requires_grad=self._applies)
        self.translation = nn.Parameter(torch.zeros(len(self.frames), 3), requires_grad=self._applies)

    @property
    def untrained_views(self) -> str:
        """Treatment of views that are not training frames."""
        if not self._applies:
            return _UNCORRECTED
        return (
            "views without training have their poses corrected by what is interpolated between the corrections of the "
            "training frames before and after them; views beside the video by that of the nearest training camera"
        )

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Rotation vectors in radians and translations in scene units, which need rates of their own."""
        return {"rotation": [self.rotation], "translation": [self.translation]}

    def adjust_camera(self, camera: Camera, view: View | None) -> Camera:
        """The camera with the correction of its frame, or of the training frames around it."""
        if view is None or not self._applies:
            return camera
        row = self.frames.row(view)
        before, after, share = self.frames.neighbours(view) if row is None else (row, row, 0.0)
        rotation, translation = (torch.lerp(values[before], values[after], share) for values in self.corrections())
        depth = (1.0 - share) * self._pivot_depths[before] + share * self._pivot_depths[after]
        return camera.moved(rotation, translation, depth)

    def corrections(self) -> tuple[Float[Tensor, "F 3"], Float[Tensor, "F 3"]]:
        """Rotation vectors (radians) and translations (scene units) of the training frames, zero on average."""
        return self.rotation - self.rotation.mean(0), self.translation - self.translation.mean(0)

    @property
    def learned(self) -> JsonObject:
        """Root mean square of the corrections over the training frames."""
        if not self._applies:
            return {}
        rotation, translation = (values.detach().square().sum(1).mean().sqrt() for values in self.corrections())
        return {"rotation_degrees": math.degrees(rotation), "translation": float(translation)}


def _median_depth(camera: Camera, scene: Scene) -> float:
    """Median z-depth of some of the scene's points in view, scene units; 0 where none is."""
    points = scene.points.positions[:: max(1, len(scene.points) // _DEPTH_POINTS)]
    pixels, depths = camera.project(points.to(camera.camera_to_world))
    inside = ((pixels >= 0) & (pixels <= constant((camera.width, camera.height), pixels))).all(dim=1) & (depths > 0)
    return float(depths[inside].median()) if inside.any() else 0.0


class ImageWarpSettings(CorrectionSettings):
    """Options of the displacement of images."""

    cells: int = Field(default=8, ge=1)  # cells of the grid along either side of the image


class ImageWarp(ViewModule[ImageWarpSettings]):
    """Learned smooth displacement of the rendered colours of each training frame.

    What a living wall has moved by since the other frames is, in one image, a displacement of its pixels. Depth and
    alpha stay those of the rigid wall. The mean displacement over the frames is subtracted, since geometry and poses
    explain it as well.

    Held-out frames of the video are displaced as the training frames around them; free cameras are not.
    """

    whole_image: ClassVar[bool] = True
    rates: ClassVar[Rates] = {"displacement": {"lr": 0.01, "final_lr": 0.001}}  # percent of the image's width

    def __init__(self, settings: ImageWarpSettings, scene: Scene) -> None:
        super().__init__(settings, scene)
        self.frames, self._applies = FrameRows(scene), settings.apply_to(scene)
        nodes = settings.cells + 1
        self.displacement = nn.Parameter(torch.zeros(len(self.frames), 2, nodes, nodes), requires_grad=self._applies)

    @property
    def untrained_views(self) -> str:
        """Displacement of views that are not training frames."""
        if not self._applies:
            return _UNCORRECTED
        return (
            "views without training are displaced by what is interpolated between the training frames before and "
            "after them; views beside the video as the nearest training camera"
        )

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Displacements of the grid's nodes, percent of the image's width."""
        return {"displacement": [self.displacement]}

    def shade(self, output: RenderOutput, view: View | None) -> RenderOutput:
        """Displace the colours."""
        if view is None or not self._applies:
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
        if not self._applies:
            return {}
        return {"displacement": float(self.displacements().detach().square().sum(1).mean().sqrt())}
