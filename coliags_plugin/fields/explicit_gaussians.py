"""Explicit 3D Gaussians with spherical harmonics, as in 3D Gaussian Splatting."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from pydantic import Field as Option
from torch import Tensor, nn
from typing_extensions import Self

from coliags_plugin.contracts import GaussianField, Schedule
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.core.scenes import Scene
from coliags_plugin.core.settings import Settings
from coliags_plugin.fields import spherical_harmonics
from coliags_plugin.fields.anchor_points import initial_positions, neighbour_log_scales
from coliags_plugin.fields.frustum import DRAWN_SIGMAS, spheres_in_frustum


class ExplicitGaussiansSettings(Settings):
    """Options of explicit Gaussians (docs/methods.md 7.1)."""

    sh_degree: int = Option(default=3, ge=0, le=spherical_harmonics.MAX_DEGREE)  # of the spherical harmonics
    sh_every: int = Option(default=1000, ge=1)  # steps between increases of the active degree from 0
    initial_opacity: float = Option(default=0.1, gt=0, lt=1)  # of every Gaussian
    near_plane: float = Option(default=0.2, ge=0)  # scene units; nearer Gaussians are culled


class ExplicitGaussians(GaussianField):
    """One Gaussian per initial point, each with its own mean, covariance, opacity and spherical harmonics."""

    Settings: ClassVar[type[Settings]] = ExplicitGaussiansSettings
    primitive: ClassVar[str] = "gaussians3d"
    elements: ClassVar[str] = "gaussians"
    #: Parameter groups, each with one row per Gaussian; named as in gsplat.
    row_parameters: ClassVar[tuple[str, ...]] = ("means", "scales", "quats", "opacities", "sh0", "shN")

    degree: Tensor

    def __init__(self, settings: Any, count: int) -> None:
        super().__init__()
        self.settings = settings
        self.means = nn.Parameter(torch.zeros(count, 3))
        self.scales = nn.Parameter(torch.zeros(count, 3))  # logarithms
        self.quats = nn.Parameter(torch.zeros(count, 4))
        self.opacities = nn.Parameter(torch.zeros(count))  # logits
        self.sh0 = nn.Parameter(torch.zeros(count, 1, 3))
        self.shN = nn.Parameter(torch.zeros(count, (settings.sh_degree + 1) ** 2 - 1, 3))
        self.register_buffer("degree", torch.zeros((), dtype=torch.int64))

    @classmethod
    def from_scene(cls, scene: Scene, settings: Any, generator: torch.Generator) -> Self:
        """An isotropic Gaussian at every initial point, scaled to the distance of its neighbours.

        Raises:
            InputError: The scene has no points.
        """
        positions = initial_positions(scene)
        field = cls(settings, len(positions))
        with torch.no_grad():
            field.means.copy_(positions)
            field.scales.copy_(neighbour_log_scales(positions.to(torch.float32))[:, None].expand(-1, 3))
            field.quats[:, 0] = 1.0
            field.opacities.fill_(math.log(settings.initial_opacity / (1.0 - settings.initial_opacity)))
            if scene.points.colors is not None:
                rgb = scene.points.colors.to(torch.float32) / 255.0
                field.sh0.copy_((rgb[:, None] - 0.5) / spherical_harmonics.Y0)
        return field

    @classmethod
    def from_state(cls, state: Mapping[str, Tensor], settings: Any) -> Self:
        """The field of a checkpoint, of any number of Gaussians."""
        field = cls(settings, len(state["means"]))
        field.load_state_dict(state)
        return field

    @property
    def element_count(self) -> int:
        """Number of Gaussians."""
        return len(self.means)

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """One group for each kind of parameter."""
        return {name: [getattr(self, name)] for name in self.row_parameters}

    def before_step(self, step: int, schedule: Schedule) -> None:
        """Raise the active degree of spherical harmonics every ``sh_every`` steps."""
        every = max(1, schedule.at(self.settings.sh_every))
        self.degree.fill_(min(self.settings.sh_degree, step // every))

    def gaussians(self, camera: Camera) -> Gaussians:
        """The Gaussians in the camera's view with their colours from there."""
        camera = camera.to(self.means.device, self.means.dtype)
        visible = self._visible(camera)
        means, scales, quats, opacities, sh0, rest = (
            getattr(self, name).index_select(0, visible) for name in self.row_parameters
        )
        directions = nn.functional.normalize(means - camera.center, dim=1)
        return Gaussians(
            means=means,
            quats_wxyz=quats,
            scales=scales.exp(),
            opacities=opacities.sigmoid(),
            colors=spherical_harmonics.colors(torch.cat([sh0, rest], dim=1), directions, int(self.degree)),
            source_index=visible,
            visible_sources=visible,
        )

    @torch.no_grad()
    def _visible(self, camera: Camera) -> Tensor:
        reach = DRAWN_SIGMAS * self.scales.amax(dim=1).exp()
        return spheres_in_frustum(self.means, reach, camera, self.settings.near_plane).nonzero().squeeze(1)
