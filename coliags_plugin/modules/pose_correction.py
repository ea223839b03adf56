"""Pose correction per frame, for inaccurate camera poses."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn
from typing_extensions import Self

from coliags_plugin.contracts import ViewModule
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.scenes import Scene, View
from coliags_plugin.core.settings import Settings
from coliags_plugin.modules.frame_rows import FrameRows

#: Approximate number of scene points that the median depth is computed from.
_DEPTH_POINTS = 4096


class PoseCorrectionSettings(Settings):
    """Options of the pose correction."""

    fixed: tuple[str, ...] = ()  # training frames whose poses are right; none: corrections average to zero


class PoseCorrection(ViewModule):
    """Learned rotation and translation of each training camera, in world axes.

    It turns about the point on its optical axis at the median depth of the scene's points in view. About its own
    centre, a small rotation would shift the image almost as a translation does, and gradient descent could hardly tell
    the two apart.

    All poses and the field could move together without any image changing. The ``fixed`` frames hold them; without any,
    the mean rotation and translation are subtracted.
    """

    Settings: ClassVar[type[Settings]] = PoseCorrectionSettings

    def __init__(self, settings: Any, scene: Scene) -> None:
        super().__init__()
        self.settings = settings
        self.frames = FrameRows(scene)
        self._fixed = {self.frames.require(name, "pose-correction") for name in settings.fixed}
        self._pivot_depths = [_median_depth(frame.camera, scene) for frame in scene.train]
        self.rotation = nn.Parameter(torch.zeros(len(self.frames), 3))
        self.translation = nn.Parameter(torch.zeros(len(self.frames), 3))

    @classmethod
    def from_scene(cls, scene: Scene, settings: Any, generator: torch.Generator) -> Self:
        """Module with zero corrections.

        Raises:
            InputError: A frame in ``fixed`` is no training frame.
        """
        return cls(settings, scene)

    @property
    def untrained_views(self) -> str:
        """Treatment of views that are not training frames."""
        return "views without training keep their poses as given"

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Rotation vectors in radians and translations in scene units, which need rates of their own."""
        return {"rotation": [self.rotation], "translation": [self.translation]}

    def adjust_camera(self, camera: Camera, view: View | None) -> Camera:
        """The camera with its frame's correction."""
        row = self.frames.row(view)
        if row is None or row in self._fixed:
            return camera
        pose = camera.camera_to_world
        rotation, translation = (
            (values[row] if self._fixed else values[row] - values.mean(0)).to(pose)
            for values in (self.rotation, self.translation)
        )
        turn, arm = rotation_matrix(rotation), self._pivot_depths[row] * pose[:3, 2]
        center = pose[:3, 3] + translation + arm - turn @ arm
        upper = torch.cat([turn @ pose[:3, :3], center[:, None]], dim=1)
        return replace(camera, camera_to_world=torch.cat([upper, pose[3:]]))


def _median_depth(camera: Camera, scene: Scene) -> float:
    """Median z-depth of some of the scene's points in view, scene units; 0 where none is."""
    points = scene.points.positions[:: max(1, len(scene.points) // _DEPTH_POINTS)]
    pixels, depths = camera.project(points.to(camera.camera_to_world))
    inside = ((pixels >= 0) & (pixels <= pixels.new_tensor([camera.width, camera.height]))).all(dim=1) & (depths > 0)
    return float(depths[inside].median()) if inside.any() else 0.0


def rotation_matrix(vector: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """The rotation of a rotation vector (axis times angle, radians), smooth about zero. [3, 3]"""
    x, y, z = vector.unbind()
    zero = torch.zeros_like(x)
    return torch.linalg.matrix_exp(torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).view(3, 3))
