"""REIM-NeRF: a neural radiance field of tissue lit by a moving lamp."""

from __future__ import annotations

import logging
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from jaxtyping import Float
from pydantic import Field as Option
from pydantic import model_validator
from torch import Tensor, nn
from torch.nn import functional
from typing_extensions import Self

from coliags_plugin.contracts import RadianceField, RadianceLevel, RadianceSamples
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scenes import Scene
from coliags_plugin.core.settings import Rates, Settings
from coliags_plugin.core.tensors import sent
from coliags_plugin.fields.mlp import Precision, cosine_embedding, first_layer, glorot_linear, reduced_dtype
from coliags_plugin.fields.points import initial_positions, spheres_in_frustum

logger = logging.getLogger(__name__)

#: Factors on the smallest and the largest distance.
NEAR_MARGIN, FAR_MARGIN = 0.9, 1.1
#: About as many of the initial points, evenly chosen, are looked at from every camera.
_POINTS = 20_000


class SceneNormalisation(nn.Module):
    """Shift and scale that put the scene's initial points into [-1, 1]; saved with the field.

    Attributes:
        center: Mean of the points, scene units. [3]
        unit: Largest absolute coordinate of a point relative to the centre, scene units. []
    """

    center: Tensor
    unit: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("center", torch.zeros(3))
        self.register_buffer("unit", torch.ones(()))

    @classmethod
    def from_scene(cls, scene: Scene) -> Self:
        """The normalisation of a scene's initial points."""
        points = initial_positions(scene).double()
        center = points.mean(0)
        unit = (points - center).abs().max()
        if not unit > 0:
            raise InputError(
                "the scene's initial points are all at one place",
                "points spread over the surface, whose size is the field's unit of length",
                "Give the data manager points or depth",
            )
        normalisation = cls()
        normalisation.center.copy_(center)
        normalisation.unit.copy_(unit)
        return normalisation

    def forward(self, positions: Float[Tensor, "*P 3"]) -> Float[Tensor, "*P 3"]:
        """Scene units to normalised coordinates."""
        return (positions - self.center) / self.unit


def surface_distances(scene: Scene) -> Float[Tensor, "2"]:
    """Smallest and largest distance of a training camera from the initial points in its view, times 0.9 and 1.1.

    Scene units. Occlusion is not tested.
    """
    points = initial_positions(scene).double()
    points = points[:: max(1, len(points) // _POINTS)]
    radii = points.new_zeros(len(points))
    distances_in_view = []
    for frame in scene.train:
        camera = frame.camera.to(points.device, points.dtype)
        distances = (points - camera.center).norm(dim=1)
        distances_in_view.append(distances[spheres_in_frustum(points, radii, replace(camera, near_plane=0.0))])
    all_distances = torch.cat(distances_in_view)
    if not len(all_distances):
        raise InputError(
            "no training camera has an initial point in view",
            "points on the surface that the cameras see, between which and the cameras rays are sampled",
            "Look at poses and points with `coliags check data`",
        )
    return torch.stack([NEAR_MARGIN * all_distances.min(), FAR_MARGIN * all_distances.max()])


class ReimNerfFieldSettings(Settings):
    """Options of REIM-NeRF's field (docs/rivals/reim-nerf.md); the coarse and the fine network are alike."""

    layers: int = Option(default=8, ge=1)  # layers of the trunk, from position to density
    width: int = Option(default=256, ge=1)  # units of a layer of the trunk
    skip: int | None = Option(default=4, ge=1)  # layer, from 0, that sees the embedded position again; null: none
    color_width: int = Option(default=128, ge=1)  # units of the layer between feature and colour
    position_frequencies: int = Option(default=10, ge=0)  # frequencies of the embedding of the position
    direction_frequencies: int = Option(default=4, ge=0)  # frequencies of the embedding of the viewing direction
    light_frequencies: int = Option(default=4, ge=0)  # frequencies of the embedding of the light
    light: bool = True  # whether the colour depends on the lamp's position, which is the camera's; without: NeRF
    # precision of products in rendering; auto: bfloat16 where the CPU is made for it
    render_precision: Precision = "auto"
    density_noise: float = Option(default=1.0, ge=0)  # standard deviation, in training, before ReLU, per field's unit

    @model_validator(mode="after")
    def _skip_within(self) -> Self:
        if self.skip is not None and self.skip >= self.layers:
            raise ValueError(f"skip {self.skip} with layers {self.layers}: expected a smaller number, or null")
        return self


class RadianceMLP(nn.Module):
    """NeRF's network: density from the position, colour also from the direction and, where asked, the light's place."""

    def __init__(self, settings: ReimNerfFieldSettings, generator: torch.Generator) -> None:
        super().__init__()
        self.settings = settings
        embedded = _embedding_size(settings.position_frequencies)
        width, inputs = settings.width, [embedded] + (settings.layers - 1) * [settings.width]
        if settings.skip is not None:
            inputs[settings.skip] += embedded
        self.trunk = nn.ModuleList([glorot_linear(size, width, generator) for size in inputs])
        self.density = glorot_linear(width, 1, generator)
        self.feature = glorot_linear(width, width, generator)
        embedded_size = _embedding_size(settings.direction_frequencies)
        if settings.light:
            embedded_size += _embedding_size(settings.light_frequencies)
        self.color = glorot_linear(width + embedded_size, settings.color_width, generator)
        self.rgb = glorot_linear(settings.color_width, 3, generator)

    def hidden(self, positions: Float[Tensor, "P S 3"], in_rendering: bool = False) -> Float[Tensor, "P*S W"]:
        """Output of the trunk at normalised coordinates.

        In rendering, without gradients, factors of products are of ``render_precision``, but for the first layer, which
        needs all digits of the positions.
        """
        embedded = cosine_embedding(positions.flatten(0, 1), self.settings.position_frequencies)
        dtype = reduced_dtype(self.settings.render_precision, embedded) if in_rendering else embedded.dtype
        hidden = self.trunk[0](embedded).relu_().to(dtype)
        embedded = embedded.to(dtype)
        for index, layer in enumerate(self.trunk):
            weight, bias = layer.get_parameter("weight").to(dtype), layer.get_parameter("bias").to(dtype)
            if index == self.settings.skip:
                hidden = first_layer(hidden, embedded, weight, bias).relu_()
            elif index > 0:
                hidden = functional.linear(hidden, weight, bias).relu_()
        return hidden

    def densities(
        self, hidden: Float[Tensor, "P*S W"], rays: int, generator: torch.Generator | None = None
    ) -> Float[Tensor, "P S"]:
        """Densities in normalised units, of what :meth:`hidden` gave for P rays, with noise in training."""
        raw = functional.linear(hidden.to(self.density.weight.dtype), self.density.weight, self.density.bias)
        raw = raw.view(rays, -1)
        if generator is not None and self.settings.density_noise > 0:
            noise = torch.randn(raw.shape, generator=generator, dtype=raw.dtype)
            raw = raw + self.settings.density_noise * sent(noise, raw.device)
        return raw.relu()

    def colors(
        self, hidden: Float[Tensor, "P*S W"], directions: Float[Tensor, "P 3"], light: Float[Tensor, "3"]
    ) -> Float[Tensor, "P S 3"]:
        """Colours in [0, 1] along unit vectors, with the light at normalised coordinates.

        What is the same all along a ray enters the colour layer once per ray. The feature layer has no activation, so
        its product with the colour layer is one smaller matrix.
        """
        settings = self.settings
        embedded = cosine_embedding(directions, settings.direction_frequencies)
        if settings.light:
            lamp = cosine_embedding(light, settings.light_frequencies)
            embedded = torch.cat([embedded, lamp.expand(len(embedded), -1)], dim=1)
        from_feature, from_ray = self.color.weight[:, : settings.width], self.color.weight[:, settings.width :]
        constant = self.color.bias + from_feature @ self.feature.bias
        of_ray = functional.linear(embedded, from_ray, constant)
        of_point = functional.linear(hidden, (from_feature @ self.feature.weight).to(hidden.dtype))
        mixed = (of_point.view(len(embedded), -1, settings.color_width) + of_ray[:, None]).relu_()
        return functional.linear(mixed, self.rgb.weight, self.rgb.bias).sigmoid()


def _embedding_size(frequencies: int) -> int:
    """Length of the embedding of three coordinates."""
    return 3 * (1 + 2 * frequencies)


class _NetworkLevel(RadianceLevel):
    """Density and colour of one network, in scene units."""

    @abstractmethod
    def _parts(self) -> tuple[SceneNormalisation, RadianceMLP]:
        """Scene units to the network's coordinates, and the network."""

    def query(
        self,
        positions: Float[Tensor, "P S 3"],
        directions: Float[Tensor, "P 3"],
        camera: Camera,
        generator: torch.Generator | None = None,
    ) -> RadianceSamples:
        normalisation, network = self._parts()
        hidden = network.hidden(normalisation(positions), generator is None and not torch.is_grad_enabled())
        rgb = network.colors(hidden, directions, normalisation(camera.center))
        return RadianceSamples(network.densities(hidden, len(positions), generator) / normalisation.unit, rgb)

    def query_density(
        self, positions: Float[Tensor, "P S 3"], directions: Float[Tensor, "P 3"], camera: Camera
    ) -> Float[Tensor, "P S"]:
        normalisation, network = self._parts()
        hidden = network.hidden(normalisation(positions), not torch.is_grad_enabled())
        return network.densities(hidden, len(positions)) / normalisation.unit


class ReimNerf(_NetworkLevel, RadianceField[ReimNerfFieldSettings]):
    """Two networks from position to density, and from position, direction and lamp position to colour.

    After Psychogyios et al., "Realistic Endoscopic Illumination Modeling for NeRF-Based Data Generation" (MICCAI 2023).
    The networks compute in normalised coordinates; positions are taken, and densities returned, in scene units.

    Attributes:
        normalisation: Scene units to the networks' coordinates.
        bounds: Distances between which rays are sampled, scene units. [2]
    """

    rates: ClassVar[Rates] = {  # released code
        name: {"lr": 0.0005, "halve_at": (0.5, 0.75), "eps": 1e-8} for name in ("coarse", "fine")
    }

    bounds: Tensor

    def __init__(self, settings: ReimNerfFieldSettings, generator: torch.Generator) -> None:
        super().__init__()
        self.settings = settings
        self.normalisation = SceneNormalisation()
        self.register_buffer("bounds", torch.zeros(2))
        self.coarse_network = RadianceMLP(settings, generator)
        self.fine_network = RadianceMLP(settings, generator)

    @classmethod
    def from_scene(cls, scene: Scene, settings: ReimNerfFieldSettings, generator: torch.Generator) -> Self:
        """Fresh networks, normalised by the scene's initial points; one training frame is refused."""
        if len(scene.train) < 2:
            raise InputError(
                f"{len(scene.train)} training frame of scene '{scene.name}'",
                "at least two, which show the tissue and its shading from different places",
                "Give more frames, or another split: `datamanager.split=...`",
            )
        field = cls(settings, generator)
        field.normalisation = SceneNormalisation.from_scene(scene)
        field.bounds.copy_(surface_distances(scene))
        near, far = field.bounds.tolist()
        logger.info("unit of length %.4g scene units; surface at %.4g to %.4g", float(field.length_unit), near, far)
        return field

    @classmethod
    def from_state(cls, state: Mapping[str, Tensor], settings: ReimNerfFieldSettings) -> Self:
        """The field of a checkpoint."""
        field = cls(settings, torch.Generator())
        field.load_state_dict(state)
        return field

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """One group for each network."""
        return {"coarse": list(self.coarse_network.parameters()), "fine": list(self.fine_network.parameters())}

    @property
    def length_unit(self) -> Tensor:
        """Scene units from 0 to 1 of the networks' coordinates."""
        return self.normalisation.unit

    @property
    def ray_bounds(self) -> Float[Tensor, "2"]:
        """Near and far ends of the sampled rays, scene units. [2]"""
        return self.bounds

    @property
    def coarse_level(self) -> RadianceLevel:
        """The coarse network."""
        return _CoarseLevel(self)

    def _parts(self) -> tuple[SceneNormalisation, RadianceMLP]:
        return self.normalisation, self.fine_network


@dataclass(frozen=True)
class _CoarseLevel(_NetworkLevel):
    field: ReimNerf

    def _parts(self) -> tuple[SceneNormalisation, RadianceMLP]:
        return self.field.normalisation, self.field.coarse_network
