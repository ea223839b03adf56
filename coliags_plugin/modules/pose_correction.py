"""A small rigid motion per frame, for poses that are not quite right."""

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


class PoseCorrectionSettings(Settings):
    """Options of the pose correction."""

    fixed: tuple[str, ...] = ()  # training frames whose poses are right; none: the first, in the order of the video


class PoseCorrection(ViewModule):
    """Moves each training camera by a learnt rotation and translation in its own axes.

    All poses and the field could move together without any picture changing; the ``fixed`` frames hold them.
    """

    Settings: ClassVar[type[Settings]] = PoseCorrectionSettings

    free: Tensor

    def __init__(self, settings: Any, scene: Scene) -> None:
        super().__init__()
        self.settings = settings
        self.frames = FrameRows(scene)
        names = settings.fixed or (min(scene.train, key=lambda frame: frame.index).name,)
        free = torch.ones(len(self.frames), 1)
        for name in names:
            free[self.frames.require(name, "pose-correction")] = 0.0
        self.register_buffer("free", free)
        self.delta = nn.Parameter(torch.zeros(len(self.frames), 6))

    @classmethod
    def from_scene(cls, scene: Scene, settings: Any, generator: torch.Generator) -> Self:
        """No correction yet.

        Raises:
            InputError: A frame in ``fixed`` is no training frame.
        """
        return cls(settings, scene)

    @property
    def untrained_views(self) -> str:
        """What other views get."""
        return "views without training keep their poses as given"

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Rotation vectors in radians and translations in scene units."""
        return {"delta": [self.delta]}

    def adjust_camera(self, camera: Camera, view: View | None) -> Camera:
        """The camera with its frame's correction."""
        row = self.frames.row(view)
        if row is None:
            return camera
        delta = (self.delta[row] * self.free[row]).to(camera.camera_to_world)
        return replace(camera, camera_to_world=camera.camera_to_world @ rigid_motion(delta))


def rigid_motion(delta: Float[Tensor, "6"]) -> Float[Tensor, "4 4"]:
    """The rigid motion of a rotation vector (radians) and a translation, smooth about zero. [4, 4]

    Args:
        delta: Rotation vector, then translation. [6]
    """
    x, y, z = delta[:3].unbind()
    zero = torch.zeros_like(x)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).view(3, 3)
    upper = torch.cat([torch.linalg.matrix_exp(skew), delta[3:, None]], dim=1)
    return torch.cat([upper, upper.new_tensor([[0.0, 0.0, 0.0, 1.0]])])
