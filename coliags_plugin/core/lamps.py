"""Lamp of an endoscope, for rendering a scene under another light than it was recorded with."""

from __future__ import annotations

import math
from typing import Annotated

import torch
from jaxtyping import Float
from pydantic import Field as Option
from torch import Tensor

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.settings import Settings

_Finite = Annotated[float, Option(allow_inf_nan=False)]


class Lamp(Settings):
    """Point light that moves with the camera; by default at its optical centre, alike in all directions.

    Light towards a direction at an angle t to the lamp's axis is multiplied by max(cos t, 0)^power.
    """

    offset: tuple[_Finite, _Finite, _Finite] = (0.0, 0.0, 0.0)  # from the optical centre, camera axes, scene units (mm)
    turn: tuple[_Finite, _Finite] = (0.0, 0.0)  # of its axis from the optical axis, about camera x, then y, degrees
    power: float = Option(default=0.0, ge=0.0, allow_inf_nan=False)  # see above; 0: alike in all directions
    intensity: float = Option(default=1.0, ge=0.0, allow_inf_nan=False)  # factor of the trained intensity

    @property
    def at_camera(self) -> bool:
        """Whether it is at the optical centre."""
        return not any(self.offset)

    def position(self, camera: Camera) -> Float[Tensor, "3"]:
        """Position of the lamp in the world, scene units. [3]"""
        return camera.center + camera.camera_to_world[:3, :3] @ camera.camera_to_world.new_tensor(self.offset)

    def axis(self, camera: Camera) -> Float[Tensor, "3"]:
        """Axis of the lamp, the direction of most light, as a unit vector in the world. [3]

        Turned by (a, b) degrees it is (sin b cos a, -sin a, cos b cos a) in camera axes: a > 0 turns it up (towards
        -y), b > 0 to the right (towards +x).
        """
        up, right = (math.radians(angle) for angle in self.turn)
        local = (math.sin(right) * math.cos(up), -math.sin(up), math.cos(right) * math.cos(up))
        return camera.camera_to_world[:3, :3] @ camera.camera_to_world.new_tensor(local)

    def spread(self, directions: Float[Tensor, "N 3"], camera: Camera) -> Float[Tensor, "N"]:
        """Share of its light that goes in each direction, intensity included. [N]

        Args:
            directions: Unit vectors from the lamp, world frame. [N, 3]
            camera: The camera that it moves with.
        """
        cosines = (directions @ self.axis(camera)).clamp_min(0.0)
        return torch.as_tensor(self.intensity * cosines.pow(self.power))
