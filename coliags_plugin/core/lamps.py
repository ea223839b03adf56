"""Lamps of endoscopes, for rendering a scene under another light than it was recorded with."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, TypeAlias

import torch
from jaxtyping import Float
from pydantic import Field as Option
from torch import Tensor

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.json_files import JsonObject
from coliags_plugin.core.settings import Settings
from coliags_plugin.core.tensors import constant

#: Shortest distance to a lamp, scene units.
_MIN_DISTANCE = 1e-6
_Finite = Annotated[float, Option(allow_inf_nan=False)]


class Lamp(Settings):
    """Point light that moves with the camera; by default at its optical centre, alike in all directions.

    Light towards a direction at an angle t to the lamp's axis is multiplied by max(cos t, 0)^power.
    """

    offset: tuple[_Finite, _Finite, _Finite] = (0.0, 0.0, 0.0)  # from the optical centre, camera axes, scene units (mm)
    # turn of its axis from the optical axis, about camera x, then y, degrees
    turn: tuple[_Finite, _Finite] = (0.0, 0.0)
    # exponent of the cosine in the lamp's beam; 0: alike in all directions
    power: float = Option(default=0.0, ge=0.0, allow_inf_nan=False)
    intensity: float = Option(default=1.0, ge=0.0, allow_inf_nan=False)  # factor of the trained intensity

    @property
    def described(self) -> JsonObject:
        """Plain values, for a record."""
        return self.model_dump()

    @property
    def at_camera(self) -> bool:
        """True for a lamp at the optical centre."""
        return not any(self.offset)

    def position(self, camera: Camera) -> Float[Tensor, "3"]:
        """Position of the lamp in the world, scene units."""
        return camera.center + camera.camera_to_world[:3, :3] @ constant(self.offset, camera.camera_to_world)

    def axis(self, camera: Camera) -> Float[Tensor, "3"]:
        """Axis of the lamp, the direction of most light, as a unit vector in the world.

        Turned by (a, b) degrees it is (sin b cos a, -sin a, cos b cos a) in camera axes: a > 0 turns it up (towards
        -y), b > 0 to the right (towards +x).
        """
        up, right = (math.radians(angle) for angle in self.turn)
        local = (math.sin(right) * math.cos(up), -math.sin(up), math.cos(right) * math.cos(up))
        return camera.camera_to_world[:3, :3] @ constant(local, camera.camera_to_world)

    def spread(self, directions: Float[Tensor, "N 3"], camera: Camera) -> Float[Tensor, "N"]:
        """Share of its light that goes in each direction, a unit vector in the world frame, intensity included."""
        cosines = (directions @ self.axis(camera)).clamp_min(0.0)
        return torch.as_tensor(self.intensity * cosines.pow(self.power))


@dataclass(frozen=True)
class LightOfCamera:
    """The lamp at the optical centre of a camera that stays where it is; it shines along the optical axis."""

    camera: Camera

    @property
    def described(self) -> JsonObject:
        """The pose of the camera."""
        return {"camera_to_world": self.camera.camera_to_world.tolist()}

    def incidence(self, points: Float[Tensor, "N 3"]) -> tuple[Float[Tensor, "N"], Float[Tensor, "N"]]:
        """Distance of points to the lamp, scene units, and cosine of their angle to its axis; 0 behind the camera."""
        camera = self.camera.to(points.device, points.dtype)
        sight = points - camera.center
        distances = sight.norm(dim=1)
        return distances, (sight @ camera.optical_axis / distances.clamp_min(_MIN_DISTANCE)).clamp(0.0, 1.0)

    def scaled(self, factor: float) -> LightOfCamera:
        """The light in a world whose lengths are ``factor`` times as large."""
        return LightOfCamera(self.camera.scaled(factor))

    def towards(self, points: Float[Tensor, "N 3"], normals: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """Unit vectors from points of a surface, world frame, with unit normals, to the lamp."""
        return torch.nn.functional.normalize(self.camera.center.to(points) - points, dim=1)


@dataclass(frozen=True)
class FlattenedLight:
    """Light that is alike everywhere, and falls on every surface along its normal."""

    distance: float  # to the lamp, scene units
    cosine: float  # of the angle to the lamp's axis

    @property
    def described(self) -> JsonObject:
        """Distance and cosine."""
        return {"distance": self.distance, "cosine": self.cosine}

    def incidence(self, points: Float[Tensor, "N 3"]) -> tuple[Float[Tensor, "N"], Float[Tensor, "N"]]:
        """Distance of points to the lamp, scene units, and cosine of their angle to its axis."""
        return points.new_full((len(points),), self.distance), points.new_full((len(points),), self.cosine)

    def scaled(self, factor: float) -> FlattenedLight:
        """The light in a world whose lengths are ``factor`` times as large."""
        return FlattenedLight(factor * self.distance, self.cosine)

    def towards(self, points: Float[Tensor, "N 3"], normals: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """Unit vectors from points of a surface, world frame, with unit normals, to the lamp."""
        return normals


#: Light that stays as it is while the camera moves.
HeldLight: TypeAlias = LightOfCamera | FlattenedLight
