"""Flat Gaussians with a material, lit by a lamp on the camera, as in PR-Endo, and the reflectance of their surfaces."""

from __future__ import annotations

import copy
import logging
import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from pydantic import Field as Option
from pydantic import model_validator
from torch import Tensor, nn
from typing_extensions import Self

from coliags_plugin.contracts import Schedule
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.gaussians import Gaussians, third_axes
from coliags_plugin.core.lamps import HeldLight, Lamp
from coliags_plugin.core.scenes import PointCloud, Scene
from coliags_plugin.core.settings import Rates
from coliags_plugin.core.tensors import sent
from coliags_plugin.fields.explicit_gaussians import ExplicitField, ExplicitFieldSettings
from coliags_plugin.fields.mlp import Precision, linear_layers, reduced_dtype
from coliags_plugin.fields.points import unique_rows

logger = logging.getLogger(__name__)

#: Rows of a product of bfloat16 are a multiple of this: oneDNN compiles, and keeps in memory, a kernel for every size.
_ROWS = 8192


class DiffuseNetwork(nn.Module):
    """MLP: albedo, lamp distance, normal, direction to the lamp and their cosine -> factor of each channel.

    Its last biases start at 1, so that a new network changes little (docs/rivals/pr-endo.md).
    """

    INPUTS = 11

    def __init__(self, hidden: int, hidden_layers: int, precision: Precision, generator: torch.Generator) -> None:
        super().__init__()
        self.precision = precision
        layers = linear_layers((self.INPUTS, *[hidden] * hidden_layers, 3), generator)
        nn.init.ones_(layers[-1].bias)
        self.layers = nn.ModuleList(layers)

    def forward(
        self,
        albedos: Float[Tensor, "N 3"],
        distances: Float[Tensor, "N 1"],
        normals: Float[Tensor, "N 3"],
        lamps: Float[Tensor, "N 3"],
        in_training: bool,
    ) -> Float[Tensor, "N 3"]:
        """Factors, of any sign.

        Albedos are linear RGB, distances in extents of the scene, normals on the side of the camera, and lamps unit
        vectors to the lamp; only in training may products be of the reduced precision.
        """
        cosines = (normals * lamps).sum(1, keepdim=True)
        inputs = torch.cat([albedos, distances, normals, lamps, cosines], dim=1)
        dtype = reduced_dtype(self.precision, inputs) if in_training else inputs.dtype
        *hidden, (last_weight, last_bias) = (
            (layer.get_parameter("weight"), layer.get_parameter("bias")) for layer in self.layers
        )
        values = inputs.to(dtype)
        if dtype == torch.bfloat16:
            values = nn.functional.pad(values, (0, 0, 0, -len(values) % _ROWS))
        for weight, bias in hidden:
            values = torch.relu_(nn.functional.linear(values, weight.to(dtype), bias.to(dtype)))
        # The bias, near 1, is added to the small rest in full precision.
        rest = nn.functional.linear(values, last_weight.to(dtype))[: len(inputs)]
        return rest.to(inputs.dtype) + last_bias


#: Third standard deviation, scene units.
THICKNESS = 1e-8
#: Colours are linear light to the power of 1 / GAMMA, of at least MIN_LIGHT.
GAMMA = 2.2
MIN_LIGHT = 1e-6
#: Colour of mucosa, gamma-encoded RGB in [0, 1].
PINK = (188 / 255, 99 / 255, 76 / 255)
#: A Gaussian of lower opacity is drawn nowhere.
MIN_OPACITY = 1.0 / 255.0
#: Shortest distance to the lamp, scene units.
_MIN_DISTANCE = 1e-6


class LitGaussiansSettings(ExplicitFieldSettings):
    """Options of lit Gaussians; the defaults are PR-Endo's (docs/rivals/pr-endo.md)."""

    max_scale_share: float = Option(default=0.1, gt=0)  # upper bound of all scales, as a share of the extent
    pink_share: float = Option(default=0.5, ge=0, le=1)  # share of the colour of mucosa in the initial albedo
    initial_roughness: float = Option(default=0.5, ge=0, le=1)  # roughness of every Gaussian at the start
    initial_f0: float = Option(default=0.035, ge=0, le=1)  # reflectance of every Gaussian at normal incidence
    roughness_range: tuple[float, float] = (0.05, 0.7)  # bounds of the roughness
    f0_range: tuple[float, float] = (0.0, 0.035)  # bounds of the reflectance at normal incidence
    lamp_intensity: float = Option(default=2.0, gt=0)  # initial, of the lamp
    lamp_falloff: float = Option(default=0.95, ge=0)  # initial k in 1 / (1 + k d^p), d in extents
    lamp_exponent: float = Option(default=2.0, ge=0)  # initial p
    network_from: int = Option(default=1000, ge=0)  # step after which the network corrects the diffuse reflection
    hidden: int = Option(default=128, ge=1)  # units of each hidden layer of the network
    hidden_layers: int = Option(default=3, ge=1)  # hidden layers of the network
    # precision of the network's products in training; auto: bfloat16 where the CPU is made for it
    network_precision: Precision = "auto"
    input_noise: float = Option(default=0.001, ge=0)  # standard deviation, on the network's inputs while training

    @model_validator(mode="after")
    def _ranges_ascend(self) -> Self:
        for name, lowest in (("roughness_range", 0.01), ("f0_range", 0.0)):
            low, high = getattr(self, name)
            if not lowest <= low < high <= 1.0:
                raise ValueError(f"{name} [{low}, {high}]; expected two numbers that ascend between {lowest} and 1")
        return self


class LitGaussians(ExplicitField[LitGaussiansSettings]):
    """Flat Gaussians whose colour is the light of a lamp that they reflect (docs/rivals/pr-endo.md).

    Attributes:
        albedos: Linear RGB, not below 0. [N, 3]
        roughness: Square root of GGX's alpha. [N]
        f0: Reflectance at normal incidence. [N]
        lamp_parameters: Intensity, falloff k and exponent p. [3]
        extent: Of the scene, the unit of distances to the lamp, scene units. []
        network_on: Whether the network corrects the diffuse reflection. []
    """

    primitive: ClassVar[str] = "gaussians3d"
    lamp_is_apart: ClassVar[bool] = True
    row_parameters: ClassVar[tuple[str, ...]] = (*ExplicitField.row_parameters, "albedos", "roughness", "f0")
    host_buffers: ClassVar[tuple[str, ...]] = ("network_on",)
    scale_count: ClassVar[int] = 2
    rates: ClassVar[Rates] = {  # PR-Endo's released code
        **ExplicitField.rates,
        "opacities": {"lr": 0.05},
        "albedos": {"lr": 0.000705},  # 0.0025 of albedo / 0.28209
        "roughness": {"lr": 0.002},
        "f0": {"lr": 0.002},
        "lamp": {"lr": 0.003},
        "diffuse_network": {"lr": 0.0005},
    }

    extent: Tensor
    network_on: Tensor

    def __init__(self, settings: LitGaussiansSettings, count: int) -> None:
        super().__init__(settings, count)
        self.lamp = Lamp()
        self.albedos = nn.Parameter(torch.zeros(count, 3))
        self.roughness = nn.Parameter(torch.full((count,), settings.initial_roughness))
        self.f0 = nn.Parameter(torch.full((count,), settings.initial_f0))
        self.lamp_parameters = nn.Parameter(
            torch.tensor([settings.lamp_intensity, settings.lamp_falloff, settings.lamp_exponent])
        )
        self.diffuse_network = _network(settings, torch.Generator())
        self.register_buffer("extent", torch.ones(()))
        self.register_buffer("network_on", torch.zeros((), dtype=torch.bool))

    @classmethod
    def from_scene(cls, scene: Scene, settings: LitGaussiansSettings, generator: torch.Generator) -> Self:
        """A disc at every initial point, of its colour; the unit of length needs cameras that move."""
        if scene.extent == 0.0:
            raise InputError(
                "all training cameras are at one place", "cameras that move: lengths are measured in their extent"
            )
        field = super().from_scene(scene, settings, generator)
        field.diffuse_network = _network(settings, generator)
        field.extent.fill_(scene.extent)
        with torch.no_grad():
            field.albedos.copy_(_initial_albedos(scene.points, settings.pink_share))
        field._project()
        return field

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """One group for each kind of parameter, the lamp's and the network's."""
        return {
            **super().parameter_groups(),
            "lamp": [self.lamp_parameters],
            "diffuse_network": list(self.diffuse_network.parameters()),
        }

    @property
    def feature_channels(self) -> frozenset[str]:
        """Material of the Gaussians, and the network's factor."""
        return frozenset({"albedo", "roughness", "f0", "diffuse_factor"})

    def with_lamp(self, lamp: Lamp) -> Self:
        """The field under another lamp; it shares the parameters."""
        other = copy.copy(self)
        other.lamp = lamp
        return other

    def before_step(self, step: int, schedule: Schedule) -> None:
        """Switch the network on, and move parameters that the optimizers brought out of bounds back to these."""
        self.network_on.fill_(step > schedule.at(self.settings.network_from))
        self._project()

    @torch.no_grad()
    def _project(self) -> None:
        """Bring parameters within their bounds, where clamping them passes gradients on."""
        self.scales.clamp_max_(self._max_log_scale())
        self.albedos.clamp_min_(0.0)
        self.roughness.clamp_(*self.settings.roughness_range)
        self.f0.clamp_(*self.settings.f0_range)
        self.lamp_parameters.clamp_min_(0.0)

    def _max_log_scale(self) -> Tensor:
        return (self.settings.max_scale_share * self.extent).log()

    def gaussians(
        self, camera: Camera, light: HeldLight | None = None, generator: torch.Generator | None = None
    ) -> Gaussians:
        """The Gaussians in the camera's view with the light they reflect towards it.

        A held lamp is as intense as the trained one, alike in all directions. In training noise is on the network's
        inputs, and its products are in ``network_precision``.
        """
        camera = camera.to(self.means.device, self.means.dtype)
        bright = self.opacities.detach().sigmoid() >= MIN_OPACITY
        visible = (self._in_view(camera) & bright).nonzero().squeeze(1)
        means, log_scales, quats, logits, albedos, roughness, f0 = (
            unique_rows(self.get_parameter(name), visible) for name in self.row_parameters
        )
        scales = log_scales.clamp_max(self._max_log_scale()).exp()
        albedos = albedos.clamp_min(0.0)
        roughness = roughness.clamp(*self.settings.roughness_range)
        f0 = f0.clamp(*self.settings.f0_range)
        reflected, factors = self._reflected(camera, means, third_axes(quats), albedos, roughness, f0, generator, light)
        return Gaussians(
            means=means,
            quats_wxyz=quats,
            scales=torch.cat([scales, torch.full_like(scales[:, :1], THICKNESS)], dim=1),
            opacities=logits.sigmoid(),
            colors=reflected.clamp_min(MIN_LIGHT).pow(1.0 / GAMMA),
            source_index=visible,
            visible_sources=visible,
            features={"albedo": albedos, "roughness": roughness[:, None], "f0": f0[:, None], "diffuse_factor": factors},
        )

    def _reflected(
        self,
        camera: Camera,
        means: Float[Tensor, "V 3"],
        axes: Float[Tensor, "V 3"],
        albedos: Float[Tensor, "V 3"],
        roughness: Float[Tensor, "V"],
        f0: Float[Tensor, "V"],
        generator: torch.Generator | None,
        held_light: HeldLight | None,
    ) -> tuple[Float[Tensor, "V 3"], Float[Tensor, "V 3"]]:
        """Linear light from Gaussians to the camera, and the factors of their diffuse reflection."""
        views = camera.center - means
        facing = (axes * views).sum(1)
        normals = torch.where((facing < 0)[:, None], -axes, axes)
        if held_light is None:
            lamps = views if self.lamp.at_camera else self.lamp.position(camera) - means
            lengths = lamps.norm(dim=1, keepdim=True).clamp_min(_MIN_DISTANCE)
            lamps = lamps / lengths
        else:
            lamps, lengths = held_light.towards(means, normals), held_light.incidence(means)[0][:, None]
        distances = lengths / self.extent
        if held_light is None and self.lamp.at_camera:
            cosines = Cosines.retroreflected((normals * lamps).sum(1).clamp_min(0.0))
        else:
            cosines = Cosines.of(normals, nn.functional.normalize(views, dim=1), lamps)
        intensity, falloff, exponent = self.lamp_parameters.clamp_min(0.0).unbind()
        arriving = intensity / (1.0 + falloff * distances[:, 0].pow(exponent))
        if held_light is None and self.lamp != Lamp():
            arriving = arriving * self.lamp.spread(-lamps, camera)
        factors = self._factors(albedos, distances, normals, lamps, generator)
        diffuse, specular = reflection(cosines, f0, roughness)
        light = (albedos * factors).clamp_min(0.0) * diffuse[:, None] + specular[:, None]
        return light * arriving[:, None], factors

    def _factors(
        self,
        albedos: Float[Tensor, "V 3"],
        distances: Float[Tensor, "V 1"],
        normals: Float[Tensor, "V 3"],
        lamps: Float[Tensor, "V 3"],
        generator: torch.Generator | None,
    ) -> Float[Tensor, "V 3"]:
        """Factors of the diffuse reflection: 1 before the network counts."""
        if not self.network_on:
            return torch.ones_like(albedos)
        if generator is not None and self.settings.input_noise > 0:
            drawn = sent(torch.randn(len(albedos), 7, generator=generator), albedos.device)
            noise = self.settings.input_noise * drawn.to(albedos.dtype)
            distances = distances + noise[:, :1]
            normals = nn.functional.normalize(normals + noise[:, 1:4], dim=1)
            lamps = nn.functional.normalize(lamps + noise[:, 4:], dim=1)
        factors: Tensor = self.diffuse_network(albedos, distances, normals, lamps, generator is not None)
        return factors


def _initial_albedos(points: PointCloud, pink_share: float) -> Float[Tensor, "N 3"]:
    """Colours of the points, mixed with that of mucosa, as linear light; that of mucosa where they have none."""
    pink = torch.tensor(PINK).expand(len(points), 3)
    if points.colors is None:
        if pink_share < 1.0:
            logger.warning("the initial points have no colours: all start with that of mucosa")
        return pink.pow(GAMMA)
    return torch.lerp(points.colors.to(torch.float32) / 255.0, pink, pink_share).pow(GAMMA)


def _network(settings: LitGaussiansSettings, generator: torch.Generator) -> DiffuseNetwork:
    return DiffuseNetwork(settings.hidden, settings.hidden_layers, settings.network_precision, generator)


@dataclass(frozen=True)
class Cosines:
    """Cosines between directions at N points, of which those with the normal are in [0, 1] (docs/rivals/pr-endo.md).

    The unit vectors are the normal N, V to the viewer, L to the lamp, and H = (V + L) / |V + L|.

    Attributes:
        normal_view: <N, V>. [N]
        normal_lamp: <N, L>. [N]
        normal_half: <N, H>. [N]
        half_view: <H, V> = <H, L>; None where V = L, where it is 1. [N]
    """

    normal_view: Float[Tensor, "N"]
    normal_lamp: Float[Tensor, "N"]
    normal_half: Float[Tensor, "N"]
    half_view: Float[Tensor, "N"] | None = None

    @classmethod
    def of(cls, normals: Float[Tensor, "N 3"], views: Float[Tensor, "N 3"], lamps: Float[Tensor, "N 3"]) -> Cosines:
        """Cosines between unit vectors."""
        halves = torch.nn.functional.normalize(views + lamps, dim=-1)
        pairs = (normals, views), (normals, lamps), (normals, halves), (halves, views)
        return cls(*((a * b).sum(-1).clamp(0.0, 1.0) for a, b in pairs))

    @classmethod
    def retroreflected(cls, cosines: Float[Tensor, "N"]) -> Cosines:
        """The lamp is at the viewer: all cosines with the normal are the same."""
        return cls(cosines, cosines, cosines)


def reflection(
    cosines: Cosines, f0: Float[Tensor, "N"], roughness: Float[Tensor, "N"]
) -> tuple[Float[Tensor, "N"], Float[Tensor, "N"]]:
    """Diffuse BRDF of albedo 1 beneath the surface, and Cook-Torrance BRDF F D G / (4 <N, V> <N, L>), 1 / sr.

    Both are times <N, L>. F is Schlick's approximation of the share that the surface reflects, f0 at normal incidence;
    what it leaves goes in. D is GGX's density of microfacets, with the square of the roughness, which is above 0, as
    alpha. G = G1(<N, V>) G1(<N, L>), G1(t) = t / (t (1 - k) + k), k = (roughness + 1)^2 / 8: its numerators cancel the
    denominator, so that the BRDF is finite at grazing angles. (Cook and Torrance 1982.)
    """
    reflected = f0 if cosines.half_view is None else f0 + (1.0 - f0) * (1.0 - cosines.half_view).pow(5)
    diffuse = (1.0 - reflected) * cosines.normal_lamp / math.pi
    k = (roughness + 1.0).square() / 8.0
    masked = torch.lerp(k, torch.ones_like(k), cosines.normal_view)
    shadowed = masked if cosines.half_view is None else torch.lerp(k, torch.ones_like(k), cosines.normal_lamp)
    alpha_squared = roughness.pow(4)
    density = alpha_squared / (math.pi * (cosines.normal_half.square() * (alpha_squared - 1.0) + 1.0).square())
    return diffuse, cosines.normal_lamp * reflected * density / (4.0 * masked * shadowed)
