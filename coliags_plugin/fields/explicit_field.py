"""Base class of fields of explicit Gaussians, whose parameters have one row per Gaussian."""

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

from coliags_plugin.contracts import GaussianField
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.gaussians import shortest_axes
from coliags_plugin.core.scenes import Scene
from coliags_plugin.core.settings import Settings
from coliags_plugin.core.tensors import point_normals
from coliags_plugin.fields.points import DRAWN_SIGMAS, initial_positions, neighbour_log_scales, spheres_in_frustum


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

    initial_opacity: float = Option(default=0.1, gt=0, lt=1)  # of every Gaussian
    # neighbours from which normals of the initial points are estimated, as references; null: no such normals
    normal_neighbours: int | None = Option(default=None, ge=3)


#: Settings of a field of explicit Gaussians.
ExplicitT = TypeVar("ExplicitT", bound=ExplicitFieldSettings, default=ExplicitFieldSettings)


class ExplicitField(GaussianField[ExplicitT]):
    """One Gaussian per initial point, each with its own mean, covariance and opacity; subclasses add their colours."""

    elements: ClassVar[str] = "gaussians"
    #: Named as in gsplat.
    row_parameters: ClassVar[tuple[str, ...]] = ("means", "scales", "quats", "opacities")
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
