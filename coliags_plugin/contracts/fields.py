"""Base classes of Gaussian and radiance fields, and of the exchangeable heads of an anchor field."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import ClassVar, Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from typing_extensions import Self

from coliags_plugin.contracts.schedule import Schedule
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.core.json_files import JsonObject
from coliags_plugin.core.lamps import HeldLight, Lamp
from coliags_plugin.core.scenes import Scene
from coliags_plugin.core.settings import Configurable, SettingsT


class Field(nn.Module, ABC, Configurable[SettingsT]):
    """Trainable scene representation: a :class:`GaussianField` or a :class:`RadianceField`."""

    #: ``gaussians3d``, ``surfels`` or ``radiance``; renderers declare which they support.
    primitive: ClassVar[str]
    #: Elements that strategies add and remove: ``anchors`` or ``gaussians``; ``none`` where the size is fixed.
    elements: ClassVar[str] = "none"
    #: Parameter groups with one row per element.
    row_parameters: ClassVar[tuple[str, ...]] = ()
    #: Whether the lamp is modelled apart from the tissue, so that :meth:`with_lamp` can exchange it after training.
    lamp_is_apart: ClassVar[bool] = False

    @property
    def element_count(self) -> int:
        """Current number of elements; 0 where the field has a fixed size."""
        return 0

    @classmethod
    @abstractmethod
    def from_scene(cls, scene: Scene, settings: SettingsT, generator: torch.Generator) -> Self:
        """A new field, initialised from the scene's points."""

    @classmethod
    @abstractmethod
    def from_state(cls, state: Mapping[str, Tensor], settings: SettingsT) -> Self:
        """The field of a checkpoint, of any number of elements."""

    @abstractmethod
    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Trainable parameters by the name that a method config's ``optimizers`` uses."""

    @property
    def length_unit(self) -> float | Tensor:
        """Length of one unit of the field's own coordinates, scene units; 1 where it uses the scene's. []"""
        return 1.0

    @property
    def learned(self) -> JsonObject:
        """Learned numbers that have a meaning of their own, for the record of a run; default: none."""
        return {}

    @property
    def feature_channels(self) -> frozenset[str]:
        """Names of the feature channels of its Gaussians, each of which is an output; default: none."""
        return frozenset()

    @property
    def knows_lamp(self) -> bool:
        """True if colours depend on where the lamp is, which can be held; default: if it is modelled apart."""
        return self.lamp_is_apart

    def with_lamp(self, lamp: Lamp) -> Self:
        """The field under another lamp, sharing its parameters; only where :attr:`lamp_is_apart`."""
        raise NotImplementedError(f"{type(self).__name__} has the light in its colours")

    @property
    def normals_and_references(self) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 3"]] | None:
        """Normals of the Gaussians and those that they should have, for losses; default: None, without such.

        World frame, of either sign; the first are differentiable. [N, 3], [N, 3]
        """
        return None

    def rows_added(self, positions: Float[Tensor, "B 3"], parents: Int[Tensor, "B"]) -> None:
        """Called after a strategy appended rows to ``row_parameters``: their positions, and the rows they come from.

        Extends what elements have besides parameters, in scene units.
        """

    def rows_kept(self, keep: Bool[Tensor, "M"]) -> None:
        """Called after a strategy kept only some rows of ``row_parameters``."""

    def before_step(self, step: int, schedule: Schedule) -> None:
        """Called before each training step, counted from 1, by fields that change over the run.

        What it changes must be a buffer, so that checkpoints restore it.
        """


class GaussianField(Field[SettingsT]):
    """:class:`Camera` -> :class:`Gaussians`, for splatting renderers."""

    @property
    def slots_per_element(self) -> int:
        """Gaussians that an element may yield: ``source_index`` divided by it is the element."""
        return 1

    @abstractmethod
    def gaussians(
        self, camera: Camera, light: HeldLight | None = None, generator: torch.Generator | None = None
    ) -> Gaussians:
        """The Gaussians this camera sees, differentiable with respect to the field's parameters and the pose.

        Args:
            camera: Viewpoint.
            light: The lamp, where it is held and does not move with the camera.
            generator: In a training step, of noise where there is any; None: without.
        """


class RadianceSamples(NamedTuple):
    """Density and colour of a radiance field at points along rays.

    Attributes:
        density: Not below 0, per scene unit. [P, S]
        rgb: In [0, 1]. [P, S, 3]
    """

    density: Float[Tensor, "P S"]
    rgb: Float[Tensor, "P S 3"]


class RadianceLevel(ABC):
    """Points and directions -> density and colour: a :class:`RadianceField`, or the coarse part of one."""

    @abstractmethod
    def query(
        self,
        positions: Float[Tensor, "P S 3"],
        directions: Float[Tensor, "P 3"],
        camera: Camera,
        generator: torch.Generator | None = None,
    ) -> RadianceSamples:
        """Density and colour at points along the rays of one camera.

        Args:
            positions: World frame, scene units. [P, S, 3]
            directions: Unit vectors from the camera. [P, 3]
            camera: Camera of the rays; its centre and optical axis are the lamp's too.
            generator: In a training step, of noise where there is any; None: without.
        """

    def query_density(
        self, positions: Float[Tensor, "P S 3"], directions: Float[Tensor, "P 3"], camera: Camera
    ) -> Float[Tensor, "P S"]:
        """Density of :meth:`query`, which may take less time without colours. [P, S]"""
        return self.query(positions, directions, camera).density


class RadianceField(Field[SettingsT], RadianceLevel):
    """Density and colour in space, for renderers that sample along rays."""

    primitive: ClassVar[str] = "radiance"

    @property
    def coarse_level(self) -> RadianceLevel:
        """Coarse network, whose weights place the importance samples on a ray; by default the field itself."""
        return self

    @property
    def ray_bounds(self) -> Float[Tensor, "2"] | None:
        """Near and far ends of the sampled rays, distances from the camera in scene units; None where not known. [2]"""
        return None


class SeenAnchors(NamedTuple):
    """V anchors as seen by a camera: the inputs of heads.

    Attributes:
        features: Anchor features. [V, F]
        directions: Unit vectors from the camera (and lamp) to the anchors, world frame. [V, 3]
        distances: From the lamp to the anchors, scene units (mm), not normalised. [V, 1]
        cosines: Of the angle at the lamp between optical axis and direction, in [0, 1]. [V, 1]
        normals: Unit normals of the wall at the anchors, world frame, of either sign; None for heads that use none.
            [V, 3]
    """

    features: Float[Tensor, "V F"]
    directions: Float[Tensor, "V 3"]
    distances: Float[Tensor, "V 1"]
    cosines: Float[Tensor, "V 1"]
    normals: Float[Tensor, "V 3"] | None = None


class HeadNetworks(NamedTuple):
    """Networks of a head, of one hidden layer each (Linear, ReLU, Linear), with the same inputs.

    Attributes:
        inputs: Inputs besides the anchors' features. [V, R]
        embedded: How many of the last inputs are embedded by gamma (docs/methods.md 3.2).
        frequencies: Number of frequencies of gamma.
        mlps: The networks: those of opacity, before tanh, and covariance; or that of colour, before the sigmoid. Their
            inputs are the features, then ``inputs`` with the embedded ones extended.
    """

    inputs: Tensor
    embedded: int
    frequencies: int
    mlps: tuple[nn.Sequential, ...]


class Head(nn.Module, ABC, Configurable[SettingsT]):
    """Exchangeable decoder within a field, with parameter groups of its own.

    Made by ``Head(settings, features, children, generator)``.
    """

    #: What decodes anchors: ``"networks"``, kernels that run :meth:`networks`, where they serve the device, else
    #: ``forward``, which gives the same; or ``"forward"``, always that method.
    decoding: Literal["networks", "forward"]

    def __init_subclass__(cls, **options: object) -> None:
        """Raise TypeError for a subclass that overrides ``forward`` without declaring ``decoding``."""
        super().__init_subclass__(**options)
        forward = vars(cls).get("forward")
        if forward is None or getattr(forward, "__isabstractmethod__", False) or "decoding" in vars(cls):
            return
        raise TypeError(
            f"{cls.__name__} overrides forward, which kernels do not call: set decoding = 'forward' in the class, or "
            "'networks' if the kernels may decode by its networks instead"
        )

    def networks(self, anchors: SeenAnchors) -> HeadNetworks:
        """MLPs of this head and their inputs, where ``decoding`` is "networks"."""
        raise NotImplementedError(f"{type(self).__name__} has no networks for kernels to decode by")

    @abstractmethod
    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Trainable parameters by the name that ``optimizers`` uses."""


class GeometryHead(Head[SettingsT]):
    """Anchor feature and viewing direction -> opacity, scale and rotation of every child."""

    @abstractmethod
    def forward(self, anchors: SeenAnchors) -> tuple[Float[Tensor, "V K"], Float[Tensor, "V K 7"]]:
        """Decode the children of the visible anchors.

        Returns:
            Signed opacities in (-1, 1), of which only positive ones are drawn [V, K]; and three scale logits and four
            quaternion components (w first) per child [V, K, 7].
        """


class AppearanceHead(Head[SettingsT]):
    """Anchor feature and viewing geometry -> colour of every child."""

    @property
    def knows_lamp(self) -> bool:
        """True if colours depend on distance or angle to the lamp."""
        return True

    @property
    def uses_normals(self) -> bool:
        """True if :meth:`forward` and :meth:`apply_light` are given the normals of the wall; default: not."""
        return False

    def shadows(
        self,
        positions: Float[Tensor, "N 3"],
        opacities: Float[Tensor, "N"],
        scales: Float[Tensor, "N 3"],
        camera: Camera,
    ) -> Float[Tensor, "N 3"] | None:
        """Factors of the colours where children keep the light of the camera's lamps from others; None: none do.

        Args:
            positions: Of the children, world frame, scene units. [N, 3]
            opacities: [N]
            scales: Standard deviations, scene units. [N, 3]
            camera: From which they are seen.
        """
        return None

    def prepare(self, scene: Scene, distances: Float[Tensor, "D"]) -> None:
        """Adapt the initial parameters to the scene, before training.

        Args:
            scene: The scene.
            distances: From cameras to anchors in their view, scene units. [D]
        """

    @abstractmethod
    def forward(self, anchors: SeenAnchors) -> Float[Tensor, "V K 3"]:
        """Decode the children's colours: RGB in (0, 1). [V, K, 3]"""

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

    @property
    def learned(self) -> JsonObject:
        """Learned numbers that have a meaning of their own, for the record of a run; default: none."""
        return {}
