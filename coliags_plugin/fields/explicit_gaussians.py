"""Explicit Gaussians with spherical harmonics, as in 3D and 2D Gaussian Splatting."""

from __future__ import annotations

from typing import ClassVar

import torch
from jaxtyping import Float, Int
from pydantic import Field as Option
from torch import Tensor, nn
from typing_extensions import Self

from coliags_plugin.contracts import Schedule
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.core.lamps import HeldLight
from coliags_plugin.core.scenes import Scene
from coliags_plugin.core.tensors import fit_kernels
from coliags_plugin.fields import spherical_harmonics
from coliags_plugin.fields.explicit_field import ExplicitField, ExplicitFieldSettings
from coliags_plugin.fields.points import unique_rows

#: Ratio of distances to the lamp, and its inverse, beyond which :class:`AttenuatedGaussians` change no further.
FARTHEST = 2.0
#: Exponent of the fall of display values, of gamma 2.2, under a lamp whose light falls with the squared distance.
INVERSE_SQUARE = 2.0 / 2.2


class ExplicitGaussiansSettings(ExplicitFieldSettings):
    """Options of explicit Gaussians (docs/methods.md 7.1)."""

    sh_degree: int = Option(default=3, ge=0, le=spherical_harmonics.MAX_DEGREE)  # of the spherical harmonics
    sh_every: int = Option(default=1000, ge=1)  # steps between increases of the active degree from 0


class ExplicitGaussians(ExplicitField[ExplicitGaussiansSettings]):
    """Explicit Gaussians whose colours are spherical harmonics of the viewing direction."""

    primitive: ClassVar[str] = "gaussians3d"
    row_parameters: ClassVar[tuple[str, ...]] = (*ExplicitField.row_parameters, "sh0", "shN")
    host_buffers: ClassVar[tuple[str, ...]] = ("degree",)

    degree: Tensor

    def __init__(self, settings: ExplicitGaussiansSettings, count: int) -> None:
        super().__init__(settings, count)
        self.sh0 = nn.Parameter(torch.zeros(count, 1, 3))
        self.shN = nn.Parameter(torch.zeros(count, (settings.sh_degree + 1) ** 2 - 1, 3))
        self.register_buffer("degree", torch.zeros((), dtype=torch.int64))

    @classmethod
    def from_scene(cls, scene: Scene, settings: ExplicitGaussiansSettings, generator: torch.Generator) -> Self:
        """An isotropic Gaussian at every initial point, with its colour."""
        field = super().from_scene(scene, settings, generator)
        if scene.points.colors is not None:
            rgb = scene.points.colors.to(torch.float32) / 255.0
            with torch.no_grad():
                field.sh0.copy_((rgb[:, None] - 0.5) / spherical_harmonics.Y0)
        return field

    def before_step(self, step: int, schedule: Schedule) -> None:
        """Raise the active degree of spherical harmonics every ``sh_every`` steps."""
        self.degree.fill_(min(self.settings.sh_degree, step // schedule.interval(self.settings.sh_every)))

    def gaussians(
        self, camera: Camera, light: HeldLight | None = None, generator: torch.Generator | None = None
    ) -> Gaussians:
        """The Gaussians in the camera's view with their colours from there."""
        camera = camera.to(self.means.device, self.means.dtype)
        visible = self._in_view(camera).nonzero().squeeze(1)
        means, scales, quats, opacities = (
            unique_rows(self.get_parameter(name), visible) for name in ExplicitField.row_parameters
        )
        return Gaussians(
            means=means,
            quats_wxyz=quats,
            scales=scales.exp(),
            opacities=opacities.sigmoid(),
            colors=self._colors(visible, means - camera.center),
            source_index=visible,
            visible_sources=visible,
        )

    def _colors(self, rows: Int[Tensor, "V"], sight: Float[Tensor, "V 3"]) -> Float[Tensor, "V 3"]:
        """Colours of some Gaussians, seen along vectors from the camera's centre to theirs. [V, 3]"""
        degree = int(self.degree)
        if fit_kernels(sight):
            from coliags_plugin.fields.numba_kernels.spherical_harmonics import colors

            return colors(self.sh0, self.shN, rows, sight, degree)
        higher = unique_rows(self.shN[:, : (degree + 1) ** 2 - 1], rows)  # the active ones alone
        harmonics = torch.cat([unique_rows(self.sh0, rows), higher], dim=1)
        return spherical_harmonics.colors(harmonics, nn.functional.normalize(sight, dim=1), degree)


class AttenuatedGaussians(ExplicitGaussians):
    """Explicit Gaussians whose colours are attenuated by a power of the distance to the camera, where the lamp is.

    At a distance d they are (d / D)^-a times what the spherical harmonics give, with d / D no further than
    :data:`FARTHEST` from 1.
    """

    row_parameters: ClassVar[tuple[str, ...]] = (*ExplicitGaussians.row_parameters, "exponents")

    distances: Tensor

    def __init__(self, settings: ExplicitGaussiansSettings, count: int) -> None:
        super().__init__(settings, count)
        self.exponents = nn.Parameter(torch.full((count, 1), INVERSE_SQUARE))  # a
        self.register_buffer("distances", torch.ones(count, 1))  # D, scene units

    def _colors(self, rows: Int[Tensor, "V"], sight: Float[Tensor, "V 3"]) -> Float[Tensor, "V 3"]:
        ratios = sight.detach().norm(dim=1, keepdim=True) / self.distances.index_select(0, rows)
        factors = ratios.clamp(1.0 / FARTHEST, FARTHEST).pow(-unique_rows(self.exponents, rows))
        return super()._colors(rows, sight) * factors


class Surfels(ExplicitGaussians):
    """Explicit Gaussians on discs, with two scales each; their normals are the third axes of their rotations."""

    primitive: ClassVar[str] = "surfels"
    scale_count: ClassVar[int] = 2

    @classmethod
    def from_scene(cls, scene: Scene, settings: ExplicitGaussiansSettings, generator: torch.Generator) -> Self:
        """A round surfel at every initial point, with its colour; quaternions are uniform in [0, 1)^4."""
        field = super().from_scene(scene, settings, generator)
        with torch.no_grad():
            field.quats.copy_(torch.rand(field.quats.shape, generator=generator))
        return field
