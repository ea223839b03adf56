"""Explicit Gaussians, of one row of parameters each; with spherical harmonics, as in 3D and 2D Gaussian Splatting."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from pydantic import Field as Option
from scipy.spatial import cKDTree
from torch import Tensor, nn
from typing_extensions import Self, TypeVar

from coliags_plugin.contracts import GaussianField, Schedule
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.gaussians import Gaussians, shortest_axes
from coliags_plugin.core.lamps import HeldLight
from coliags_plugin.core.scenes import Scene
from coliags_plugin.core.settings import Rates, Settings
from coliags_plugin.core.tensors import fit_kernels, point_normals
from coliags_plugin.fields import spherical_harmonics
from coliags_plugin.fields.points import (
    DRAWN_SIGMAS,
    initial_positions,
    neighbour_log_scales,
    spheres_in_frustum,
    unique_rows,
)


class ReferenceNormals(nn.Module):
    """Normal of the initial point nearest to each Gaussian when it was added (docs/rivals/gaussian-pancakes.md).

    Attributes:
        points: Initial points, scene units. [P, 3]
        normals: Their unit normals, of either sign. [P, 3]
        of_rows: Reference of each Gaussian. [N, 3]
    """

    points: Tensor
    normals: Tensor
    of_rows: Tensor

    def __init__(self, points: int, rows: int) -> None:
        super().__init__()
        self.register_buffer("points", torch.zeros(points, 3))
        self.register_buffer("normals", torch.zeros(points, 3))
        self.register_buffer("of_rows", torch.zeros(rows, 3))

    @classmethod
    def of_points(cls, points: Float[Tensor, "P 3"], neighbours: int) -> Self:
        """The references of one Gaussian at each point."""
        references = cls(len(points), len(points))
        references.points.copy_(points)
        references.normals.copy_(point_normals(points, neighbours))
        references.of_rows.copy_(references.normals)
        return references

    def extend(self, means: Float[Tensor, "B 3"]) -> None:
        """Add the references of Gaussians that were appended, from their centres, scene units."""
        _, nearest = cKDTree(self.points.cpu().numpy()).query(means.cpu().numpy(), workers=-1)
        chosen = torch.from_numpy(np.asarray(nearest)).to(self.normals.device)
        self.of_rows = torch.cat([self.of_rows, self.normals[chosen]])

    def keep(self, keep: Bool[Tensor, "N"]) -> None:
        """Keep the references of some Gaussians."""
        self.of_rows = self.of_rows[keep]


class ExplicitFieldSettings(Settings):
    """Options of all fields of explicit Gaussians (docs/methods.md 7.1)."""

    initial_opacity: float = Option(default=0.1, gt=0, lt=1)  # opacity of every Gaussian at the start
    # neighbours from which normals of the initial points are estimated, as references; null: no such normals
    normal_neighbours: int | None = Option(default=None, ge=3)


#: Settings of a field of explicit Gaussians.
ExplicitT = TypeVar("ExplicitT", bound=ExplicitFieldSettings, default=ExplicitFieldSettings)


class ExplicitField(GaussianField[ExplicitT]):
    """One Gaussian per initial point, each with its own mean, covariance and opacity; subclasses add their colours."""

    elements: ClassVar[str] = "gaussians"
    #: Named as in gsplat.
    row_parameters: ClassVar[tuple[str, ...]] = ("means", "scales", "quats", "opacities")
    rates: ClassVar[Rates] = {  # 3DGS's released code
        "means": {"lr": 0.00016, "final_lr": 0.0000016, "times_extent": True},
        "scales": {"lr": 0.005},
        "quats": {"lr": 0.001},
        "opacities": {"lr": 0.025},  # since 2024; 0.05 before
    }
    #: Buffers that the host reads at every step: they stay on the CPU.
    host_buffers: ClassVar[tuple[str, ...]] = ()
    #: Trained scales of a Gaussian.
    scale_count: ClassVar[int] = 3

    def __init__(self, settings: ExplicitT, count: int) -> None:
        super().__init__()
        self.settings = settings
        self.means = nn.Parameter(torch.zeros(count, 3))
        self.scales = nn.Parameter(torch.zeros(count, self.scale_count))  # logarithms
        self.quats = nn.Parameter(torch.zeros(count, 4))
        self.opacities = nn.Parameter(torch.zeros(count))  # logits
        self.references: ReferenceNormals | None = None

    @classmethod
    def from_scene(cls, scene: Scene, settings: ExplicitT, generator: torch.Generator) -> Self:
        """An isotropic Gaussian at every initial point, scaled to the distance of its neighbours."""
        positions = initial_positions(scene)
        field = cls(settings, len(positions))
        with torch.no_grad():
            field.means.copy_(positions)
            field.scales.copy_(neighbour_log_scales(positions.to(torch.float32))[:, None].expand(-1, cls.scale_count))
            field.quats[:, 0] = 1.0
            field.opacities.fill_(math.log(settings.initial_opacity / (1.0 - settings.initial_opacity)))
        if settings.normal_neighbours is not None:
            field.references = ReferenceNormals.of_points(positions, settings.normal_neighbours)
        return field

    @classmethod
    def from_state(cls, state: Mapping[str, Tensor], settings: ExplicitT) -> Self:
        """The field of a checkpoint, of any number of Gaussians."""
        field = cls(settings, len(state["means"]))
        if settings.normal_neighbours is not None:
            field.references = ReferenceNormals(len(state["references.points"]), len(state["means"]))
        field.load_state_dict(state)
        return field

    @property
    def element_count(self) -> int:
        """Number of Gaussians."""
        return len(self.means)

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """One group for each kind of parameter."""
        return {name: [self.get_parameter(name)] for name in self.row_parameters}

    def rows_added(self, positions: Float[Tensor, "B 3"], parents: Int[Tensor, "B"]) -> None:
        """Add the reference normals of new Gaussians."""
        if self.references is not None:
            self.references.extend(positions)

    def rows_kept(self, keep: Bool[Tensor, "N"]) -> None:
        """Keep the reference normals of some Gaussians."""
        if self.references is not None:
            self.references.keep(keep)

    def normals(self) -> Float[Tensor, "N 3"]:
        """Shortest axis of every Gaussian, world frame, of either sign; differentiable in the rotations."""
        return shortest_axes(self.quats, self.scales)

    @property
    def normals_and_references(self) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 3"]] | None:
        """Shortest axes, and the normals of the initial points nearest to each Gaussian at its birth."""
        return None if self.references is None else (self.normals(), self.references.of_rows)

    @torch.no_grad()
    def _in_view(self, camera: Camera) -> Bool[Tensor, "N"]:
        """Mask of the Gaussians that may overlap the image. [N]"""
        reach = DRAWN_SIGMAS * self.scales.amax(dim=1).exp()
        return spheres_in_frustum(self.means, reach, camera)

    def _apply(self, *args: Any, **kwargs: Any) -> Self:
        """Move or convert all but ``host_buffers``."""
        kept = {name: self.get_buffer(name) for name in self.host_buffers}
        super()._apply(*args, **kwargs)  # type: ignore[no-untyped-call]
        for name, value in kept.items():
            setattr(self, name, value)
        return self


#: Ratio of distances to the lamp, and its inverse, beyond which :class:`AttenuatedGaussians` change no further.
FARTHEST = 2.0
#: Exponent of the fall of display values, of gamma 2.2, under a lamp whose light falls with the squared distance.
INVERSE_SQUARE = 2.0 / 2.2


class ExplicitGaussiansSettings(ExplicitFieldSettings):
    """Options of explicit Gaussians (docs/methods.md 7.1)."""

    sh_degree: int = Option(default=3, ge=0, le=spherical_harmonics.MAX_DEGREE)  # degree of the spherical harmonics
    sh_every: int = Option(default=1000, ge=1)  # steps between increases of the active degree from 0


class ExplicitGaussians(ExplicitField[ExplicitGaussiansSettings]):
    """Explicit Gaussians whose colours are spherical harmonics of the viewing direction."""

    primitive: ClassVar[str] = "gaussians3d"
    row_parameters: ClassVar[tuple[str, ...]] = (*ExplicitField.row_parameters, "sh0", "shN")
    host_buffers: ClassVar[tuple[str, ...]] = ("degree",)
    rates: ClassVar[Rates] = {
        **ExplicitField.rates,
        "sh0": {"lr": 0.0025},
        "shN": {"lr": 0.000125},
    }  # 3DGS's released code

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
