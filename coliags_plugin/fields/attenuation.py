"""Attenuation of the light by a law: a factor on the colours of any appearance head."""

from __future__ import annotations

from typing import ClassVar, Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional

from coliags_plugin.contracts import AppearanceHead, HeadNetworks, SeenAnchors
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.components import AppearanceHeadNode
from coliags_plugin.core.json_files import JsonObject
from coliags_plugin.core.lamps import HeldLight
from coliags_plugin.core.photometry import fit_light
from coliags_plugin.core.scenes import Scene
from coliags_plugin.core.settings import Rates, Settings
from coliags_plugin.core.shadows import MOST_LAMPS, lit_shares
from coliags_plugin.core.tensors import fit_kernels

#: Largest distance of the lamp from the optical centre along each camera axis, scene units (mm).
MAX_OFFSET = 20.0
#: Smallest distance to the lamp, as a share of the reference distance, and smallest cosines of the angles to the axis
#: and to the wall's normal, that the law is computed at.
_MIN_DISTANCE, _MIN_COSINE, _MIN_INCIDENCE = 0.02, 0.05, 0.1
#: Largest b and c that a fit may start with: cos^9 in linear light.
_LARGEST_EXPONENT = 4.0
#: Initial logit of the share of light that is missing in a shadow.
_INITIAL_SHADOW = -0.5
#: Fewer Gaussians are left to PyTorch by the kernels.
_FEWEST = 16


class AttenuatedAppearanceSettings(Settings):
    """Options of the attenuation; the initial exponents are those of an inverse-square law at gamma 2.2."""

    head: AppearanceHeadNode = Field(default="imia", validate_default=True)  # decoder of the colours before attenuation
    distance_exponent: float = -0.9  # initial a
    cosine_exponent: float = 0.3  # initial b where it is not fitted
    incidence_exponent: float | None = None  # initial c where it is not fitted; null: incidence does not count
    # initial b, c and the lamp's offset: as above and 0, or fitted to surface points (docs/methods.md 4.8)
    initial: Literal["given", "points"] = "given"
    # exponents for each colour, or one pair for all: red falls off slower (docs/methods.md 3.7)
    channels: Literal[1, 3] = 3
    shadows: bool = False  # whether lamps beside the lens, where points tell of any, cast shadows (docs/methods.md 3.9)


class AttenuatedAppearanceHead(AppearanceHead[AttenuatedAppearanceSettings]):
    """The colours of another head times (d / d_0)^a cos(psi)^b cos(i)^c, a law of all Gaussians (docs/methods.md 3.7).

    d is the distance of a Gaussian, not of its anchor, to a lamp whose offset from the optical centre is learned, psi
    its angle there to the optical axis, and i the angle of incidence on the wall. d_0, the median distance of the
    scene, fixes the unit of the colours.

    Attributes:
        exponents: a, b and c of each channel; without c where incidence does not count. [C, 3] or [C, 2]
        lamp_offset: Of the lamp in camera axes, before it is bounded to +-:data:`MAX_OFFSET`, scene units. [3]
        reference: d_0, scene units. []
        lamps: Offsets of the lamps that cast shadows, camera axes, scene units, and their shares; those of share 0 are
            none. [L, 4]
        shadow: Logits of the share of light that is missing in a whole shadow, for each colour. [3]
    """

    decoding = "networks"
    rates: ClassVar[Rates] = {
        "attenuation": {"lr": 0.01, "final_lr": 0.0005},
        "lamp_offset": {"lr": 0.01, "final_lr": 0.001},  # scene units
        "shadow": {"lr": 0.02},  # a group with ``shadows`` alone
    }

    reference: Tensor
    lamps: Tensor

    def __init__(
        self, settings: AttenuatedAppearanceSettings, features: int, children: int, generator: torch.Generator
    ) -> None:
        super().__init__()
        self.settings = settings
        self.head: AppearanceHead = settings.head.target(settings.head.settings, features, children, generator)
        self.decoding = self.head.decoding
        initial = [settings.distance_exponent, settings.cosine_exponent]
        if settings.incidence_exponent is not None:
            initial.append(settings.incidence_exponent)
        self.exponents = nn.Parameter(torch.tensor(initial).repeat(settings.channels, 1))
        self.lamp_offset = nn.Parameter(torch.zeros(3))
        self.register_buffer("reference", torch.ones(()))
        if settings.shadows:
            self.shadow = nn.Parameter(torch.full((3,), _INITIAL_SHADOW))
            self.register_buffer("lamps", torch.zeros(MOST_LAMPS, 4))

    @property
    def uses_normals(self) -> bool:
        """True if the law has an exponent of incidence, or the head below uses them."""
        return self.settings.incidence_exponent is not None or self.head.uses_normals

    @torch.no_grad()
    def prepare(self, scene: Scene, distances: Float[Tensor, "D"]) -> None:
        """Take the median distance as the reference, and start at the light of surface points if settings say so."""
        self.head.prepare(scene, distances)
        if len(distances):
            self.reference.copy_(distances.median())
        fitted = fit_light(scene) if self.settings.initial == "points" else None
        if self.settings.shadows:
            self.shadow.requires_grad_(fitted is not None and len(fitted.lamps) > 0)
        if fitted is None:
            return
        angles = self.exponents.shape[1] - 1
        for column, fitted_exponents in enumerate((fitted.cosine_exponents, fitted.incidence_exponents)[:angles], 1):
            bounded = fitted_exponents.clamp(0.0, _LARGEST_EXPONENT)
            self.exponents[:, column] = bounded.mean() if self.settings.channels == 1 else bounded
        self.lamp_offset.copy_(MAX_OFFSET * torch.atanh((fitted.lamp_offset / MAX_OFFSET).clamp(-0.9, 0.9)))
        if self.settings.shadows:
            self.lamps[: len(fitted.lamps)] = fitted.lamps

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Groups of the head, of exponents, of the lamp's offset, which needs a rate in scene units, and of shadows."""
        groups = {**self.head.parameter_groups(), "attenuation": [self.exponents], "lamp_offset": [self.lamp_offset]}
        return {**groups, "shadow": [self.shadow]} if self.settings.shadows else groups

    def networks(self, anchors: SeenAnchors) -> HeadNetworks:
        """Networks of the head below."""
        return self.head.networks(anchors)

    def forward(self, anchors: SeenAnchors) -> Float[Tensor, "V K 3"]:
        """The colours before attenuation."""
        colors: Tensor = self.head(anchors)
        return colors

    @property
    def offset(self) -> Float[Tensor, "3"]:
        """Position of the lamp in camera axes, scene units. [3]"""
        return MAX_OFFSET * torch.tanh(self.lamp_offset / MAX_OFFSET)

    def law(
        self, distances: Float[Tensor, "N"], cosines: Float[Tensor, "N"], incidences: Float[Tensor, "N"] | None = None
    ) -> Float[Tensor, "N C"]:
        """The law's factor at distances to the lamp, scene units, and cosines of psi and i; without incidences, 1."""
        relative = (distances / self.reference).clamp_min(_MIN_DISTANCE)
        logs = [relative.log(), cosines.clamp_min(_MIN_COSINE).log()]
        if self.settings.incidence_exponent is not None:
            facing = torch.ones_like(distances) if incidences is None else incidences.clamp_min(_MIN_INCIDENCE)
            logs.append(facing.log())
        return (torch.stack(logs, dim=1) @ self.exponents.T).exp()

    def apply_light(
        self,
        colors: Float[Tensor, "N 3"],
        positions: Float[Tensor, "N 3"],
        normals: Float[Tensor, "N 3"] | None,
        camera: Camera,
        light: HeldLight | None,
    ) -> Float[Tensor, "N 3"]:
        """The colours under the lamp, which does not move Gaussians: positions get no gradient from it."""
        positions = positions.detach()
        facing = None if self.settings.incidence_exponent is None else normals
        if light is not None:
            incidences = None if facing is None else (light.towards(positions, facing) * facing).sum(1).abs()
            return colors * self.law(*light.incidence(positions), incidences)
        lamp = camera.center + camera.camera_to_world[:3, :3] @ self.offset
        if fit_kernels(colors) and len(colors) >= _FEWEST:
            from coliags_plugin.fields.numba_kernels.attenuation import attenuated

            exponents = functional.pad(self.exponents, (0, 3 - self.exponents.shape[1])).expand(3, 3)
            bounds = torch.stack([torch.tensor([_MIN_DISTANCE, _MIN_COSINE, _MIN_INCIDENCE]), self.reference.expand(3)])
            return attenuated(colors, lamp, camera.optical_axis, exponents, positions, facing, bounds)
        rays = positions - lamp
        distances = rays.norm(dim=1).clamp_min(1e-9)
        incidences = None if facing is None else (facing * rays).sum(1).abs() / distances
        return colors * self.law(distances, rays @ camera.optical_axis / distances, incidences)

    def shadows(
        self,
        positions: Float[Tensor, "N 3"],
        opacities: Float[Tensor, "N"],
        scales: Float[Tensor, "N 3"],
        camera: Camera,
    ) -> Float[Tensor, "N 3"] | None:
        """One less the learned share of each colour times the share of the lamps' light that is missing."""
        lamps = self.lamps[self.lamps[:, 3] > 0] if self.settings.shadows else ()
        if not len(lamps):
            return None
        sizes = scales.detach().median(dim=1).values
        lit = [lamp[3] * lit_shares(positions, opacities, sizes, camera, lamp[:3]) for lamp in lamps]
        return 1.0 - (1.0 - torch.stack(lit).sum(0))[:, None] * self.shadow.sigmoid()

    @property
    def learned(self) -> JsonObject:
        """The law's numbers."""
        names = ("distance_exponent", "cosine_exponent", "incidence_exponent")
        return {
            **dict(zip(names, self.exponents.detach().T.tolist(), strict=False)),
            "lamp_offset": self.offset.detach().tolist(),
            "reference_distance": float(self.reference),
            **(
                {"lamps": self.lamps.tolist(), "shadow": self.shadow.sigmoid().tolist()}
                if self.settings.shadows
                else {}
            ),
        }
