"""Base classes of the exchangeable heads of an anchor field."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar, Generic

from jaxtyping import Float
from torch import Tensor, nn

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.json_files import JsonObject
from coliags_plugin.core.scenes import Scene
from coliags_plugin.core.settings import Settings, SettingsT
from coliags_plugin.lighting.lamps import HeldLight


class Head(nn.Module, ABC, Generic[SettingsT]):
    """Exchangeable decoder within a field, with parameter groups of its own.

    Made by ``Head(settings, features, children, generator)``.
    """

    Settings: ClassVar[type[Settings]]
    settings: SettingsT

    @abstractmethod
    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Trainable parameters by the name that ``optimizers`` uses."""


class GeometryHead(Head[SettingsT]):
    """Anchor feature and viewing direction -> opacity, scale and rotation of every child."""

    @abstractmethod
    def forward(
        self, features: Float[Tensor, "V F"], directions: Float[Tensor, "V 3"]
    ) -> tuple[Float[Tensor, "V K"], Float[Tensor, "V K 7"]]:
        """Decode the children of the visible anchors.

        Args:
            features: Anchor features. [V, F]
            directions: Unit vectors from the camera to the anchors, world frame. [V, 3]

        Returns:
            Signed opacities in (-1, 1), of which only positive ones are drawn [V, K]; and three scale logits and four
            quaternion components (w first) per child [V, K, 7].
        """


class AppearanceHead(Head[SettingsT]):
    """Anchor feature and viewing geometry -> colour of every child."""

    @property
    def knows_lamp(self) -> bool:
        """Whether colours depend on distance or angle to the lamp."""
        return True

    @property
    def uses_normals(self) -> bool:
        """Whether :meth:`forward` and :meth:`apply_light` are given the normals of the wall; default: not."""
        return False

    def init_from_distances(self, distances: Float[Tensor, "D"]) -> None:
        """Adapt the initial parameters to the distances of the scene, before training.

        Args:
            distances: From cameras to anchors in their view, scene units. [D]
        """

    def prepare(self, scene: Scene) -> None:
        """Adapt the initial parameters to the colours of the scene, before training."""

    @abstractmethod
    def forward(
        self,
        features: Float[Tensor, "V F"],
        directions: Float[Tensor, "V 3"],
        distances: Float[Tensor, "V 1"],
        cosines: Float[Tensor, "V 1"],
        normals: Float[Tensor, "V 3"] | None,
    ) -> Float[Tensor, "V K 3"]:
        """Decode the children's colours.

        Args:
            features: Anchor features. [V, F]
            directions: Unit vectors from the camera (and lamp) to the anchors, world frame. [V, 3]
            distances: Camera to anchor, scene units (mm), not normalised. [V, 1]
            cosines: Of the angle between optical axis and direction, in [0, 1]. [V, 1]
            normals: Unit normals of the wall at the anchors, world frame, of either sign; None for heads that use
                none. [V, 3]

        Returns:
            RGB in (0, 1). [V, K, 3]
        """

    def apply_light(
        self,
        colors: Float[Tensor, "N 3"],
        positions: Float[Tensor, "N 3"],
        normals: Float[Tensor, "N 3"] | None,
        camera: Camera,
        light: HeldLight | None,
    ) -> Float[Tensor, "N 3"]:
        """Colours of single children in the light that falls on them; default: as decoded.

        Args:
            colors: Decoded. [N, 3]
            positions: Of the children, world frame, scene units. [N, 3]
            normals: Unit normals of the wall there, world frame, of either sign; None for heads that use none. [N, 3]
            camera: From which they are seen.
            light: The lamp that lights them, if it does not move with the camera.
        """
        return colors

    def attenuation(self, points: Float[Tensor, "N 3"]) -> Float[Tensor, "N C"] | None:
        """Factor of the light's law on colours, of all channels or each; default: None, without a law. [N, C]

        Args:
            points: In camera axes, scene units. [N, 3]
        """
        return None

    @property
    def learned(self) -> JsonObject:
        """Learned numbers that have a meaning of their own, for the record of a run; default: none."""
        return {}
