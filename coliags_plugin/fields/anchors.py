"""Anchor field: anchors on the tissue that are decoded into Gaussians per view."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int
from pydantic import Field as Option
from torch import Tensor, nn
from typing_extensions import Self

from coliags_plugin.contracts import GaussianField, HeadNetworks, SeenAnchors
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.components import AppearanceHeadNode, GeometryHeadNode
from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.core.json_files import JsonObject
from coliags_plugin.core.lamps import HeldLight
from coliags_plugin.core.scenes import Scene
from coliags_plugin.core.settings import Rates, Settings
from coliags_plugin.core.tensors import fit_kernels, fit_triton_kernels, wall_normals
from coliags_plugin.fields.children import AnchorRows, DrawnChildren, drawn_children, fused_children, visible_anchors
from coliags_plugin.fields.points import (
    DRAWN_SIGMAS,
    initial_positions,
    neighbour_log_scales,
    spheres_in_frustum,
    unique_rows,
    voxelize,
)

logger = logging.getLogger(__name__)

#: Approximate number of training cameras, evenly spaced, that the range of distances is computed from.
_DISTANCE_CAMERAS = 16


class AnchorFieldSettings(Settings):
    """Options of the anchor field. Constants: docs/methods.md 3.1 and 3.4."""

    geometry_head: GeometryHeadNode  # decoder of opacity, scale and rotation
    appearance_head: AppearanceHeadNode  # decoder of colour
    features: int = Option(default=32, ge=1)  # feature channels per anchor, input of the heads
    children: int = Option(default=10, ge=1)  # Gaussians per anchor
    # Edge of a voxel in scene units (mm); null: voxel_pixels times the size of a training pixel on the surface.
    voxel_size: float | None = Option(default=None, gt=0)
    # Edge of a voxel, pixels: 2 with ten children per anchor, half of them transparent, put a Gaussian at every pixel.
    voxel_pixels: float = Option(default=2.0, gt=0)


class AnchorField(GaussianField[AnchorFieldSettings]):
    """Anchors with features; two heads decode each visible one into its children (paper, II-A2 and II-C).

    Differs from the released ColIAGS code where that is defective (docs/methods.md 6): voxels are of a size that
    merges points (that code's 0.001 is a micron in a scene in mm), and only anchors in the viewing frustum are decoded.

    Attributes:
        anchors: Positions, scene units; they never move. [M, 3]
        offsets: Children's positions relative to the anchor, in units of its first three scales. [M, K, 3]
        features: [M, F]
        scalings: Log scales: three for the offsets, three bases of the children's sizes. [M, 6]
        voxel_size: Scene units. []
        normals: Unit normals of the wall at the anchors, of either sign, where the appearance head uses them. [M, 3]
        spacing: Of the anchors at the start: median root mean squared distance to the three nearest, scene units. []
    """

    primitive: ClassVar[str] = "gaussians3d"
    elements: ClassVar[str] = "anchors"
    row_parameters: ClassVar[tuple[str, ...]] = ("offsets", "features", "scalings")
    rates: ClassVar[Rates] = {  # Scaffold-GS's released code
        "offsets": {"lr": 0.01, "final_lr": 0.0001, "times_extent": True},
        "features": {"lr": 0.0075},
        "scalings": {"lr": 0.007},
    }

    anchors: Tensor
    normals: Tensor | None
    voxel_size: Tensor
    spacing: Tensor

    def __init__(self, settings: AnchorFieldSettings, anchor_count: int, generator: torch.Generator) -> None:
        super().__init__()
        self.settings = settings
        self.register_buffer("anchors", torch.zeros(anchor_count, 3))
        self.register_buffer("voxel_size", torch.zeros(()))
        self.register_buffer("spacing", torch.zeros(()))
        self.offsets = nn.Parameter(torch.zeros(anchor_count, settings.children, 3))
        self.features = nn.Parameter(torch.zeros(anchor_count, settings.features))
        self.scalings = nn.Parameter(torch.zeros(anchor_count, 6))
        heads = (settings.geometry_head, settings.appearance_head)
        self.geometry_head, self.appearance_head = (
            head.target(head.settings, settings.features, settings.children, generator) for head in heads
        )
        for head in (self.geometry_head, self.appearance_head):
            if head.decoding == "forward":
                logger.info("%s decodes by its own forward, in PyTorch: no kernels do it", type(head).__name__)
        self.register_buffer("normals", torch.zeros(anchor_count, 3) if self.appearance_head.uses_normals else None)

    @classmethod
    def from_scene(cls, scene: Scene, settings: AnchorFieldSettings, generator: torch.Generator) -> Self:
        """Merge the scene's points into one anchor per voxel."""
        positions = initial_positions(scene)
        size = settings.voxel_pixels * scene.pixel_footprint if settings.voxel_size is None else settings.voxel_size
        anchors = voxelize(positions, size)
        if len(anchors) > 0.95 * len(scene.points) > 1000:
            problem = "voxels of %.3g scene units merge almost nothing: %d points make %d anchors"
            logger.warning(problem, size, len(scene.points), len(anchors))
        field = cls(settings, len(anchors), generator)
        field.anchors.copy_(anchors)
        if field.normals is not None:
            field.normals.copy_(wall_normals(positions, anchors))
        field.voxel_size.fill_(size)
        log_scales = neighbour_log_scales(anchors)
        field.spacing.copy_(log_scales.exp().median())
        with torch.no_grad():
            field.scalings.copy_(log_scales[:, None].expand(-1, 6))
            cameras = [frame.camera for frame in scene.train[:: max(1, len(scene.train) // _DISTANCE_CAMERAS)]]
            field.appearance_head.prepare(scene, torch.cat([field._distances(camera) for camera in cameras]))
        logger.info("%d points in voxels of %.3g scene units make %d anchors", len(scene.points), size, len(anchors))
        return field

    @classmethod
    def from_state(cls, state: Mapping[str, Tensor], settings: AnchorFieldSettings) -> Self:
        """The field of a checkpoint, of any number of anchors."""
        field = cls(settings, len(state["anchors"]), torch.Generator())
        field.load_state_dict(state)
        return field

    @property
    def element_count(self) -> int:
        """Number of anchors."""
        return len(self.anchors)

    @property
    def slots_per_element(self) -> int:
        """Children of an anchor."""
        return self.settings.children

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Offsets, features, scalings, and the three MLPs."""
        return {
            "offsets": [self.offsets],
            "features": [self.features],
            "scalings": [self.scalings],
            **self.geometry_head.parameter_groups(),
            **self.appearance_head.parameter_groups(),
        }

    def rows_added(self, positions: Float[Tensor, "B 3"], parents: Int[Tensor, "B"]) -> None:
        """Add the positions of new anchors, and their parents' normals."""
        self.anchors = torch.cat([self.anchors, positions])
        if self.normals is not None:
            self.normals = torch.cat([self.normals, self.normals[parents]])

    def rows_kept(self, keep: Bool[Tensor, "M"]) -> None:
        """Keep the positions and normals of some anchors."""
        self.anchors = self.anchors[keep]
        self.normals = None if self.normals is None else self.normals[keep]

    @property
    def knows_lamp(self) -> bool:
        """True if colours depend on the lamp, as the appearance head says."""
        return self.appearance_head.knows_lamp

    @property
    def learned(self) -> JsonObject:
        """The numbers of the appearance head."""
        return self.appearance_head.learned

    def child_positions(self) -> Float[Tensor, "M K 3"]:
        """Positions of all children (paper, Eq. 3), scene units."""
        return self.anchors[:, None] + self.offsets * self.scalings[:, None, :3].exp()

    @torch.no_grad()
    def visible_anchors(self, camera: Camera) -> Int[Tensor, "V"]:
        """Indices of anchors of which any child may overlap the image."""
        camera = camera.to(self.anchors.device, self.anchors.dtype)
        if fit_kernels(self.anchors):
            return visible_anchors(self._rows, camera)
        reach = (self.offsets * self.scalings[:, None, :3].exp()).norm(dim=2).amax(dim=1)
        size = DRAWN_SIGMAS * self.scalings[:, 3:].amax(dim=1).exp()
        return spheres_in_frustum(self.anchors, reach + size, camera).nonzero().squeeze(1)

    @property
    def _rows(self) -> AnchorRows:
        return AnchorRows(self.anchors, self.offsets, self.scalings)

    def _distances(self, camera: Camera) -> Float[Tensor, "V"]:
        camera = camera.to(self.anchors.device, self.anchors.dtype)
        return (self.anchors[self.visible_anchors(camera)] - camera.center).norm(dim=1)

    def gaussians(
        self, camera: Camera, light: HeldLight | None = None, generator: torch.Generator | None = None
    ) -> Gaussians:
        """Decode the visible anchors (docs/methods.md 3.5); a held light gives distances and angles to the lamp."""
        camera = camera.to(self.anchors.device, self.anchors.dtype)
        drawn, visible = self._children(camera, light)
        normals = None
        if self.normals is not None:
            normals = self.normals.index_select(0, drawn.source_index // self.settings.children)
        lit = self.appearance_head.apply_light(drawn.colors, drawn.means, normals, camera, light)
        if light is None:
            shadows = self.appearance_head.shadows(drawn.means, drawn.opacities, drawn.scales, camera)
            lit = lit if shadows is None else lit * shadows
        return Gaussians(**{**drawn._asdict(), "colors": lit}, visible_sources=visible)

    def _children(self, camera: Camera, light: HeldLight | None) -> tuple[DrawnChildren, Int[Tensor, "V"]]:
        """Children of the visible anchors, and these: by kernels of a device or of the CPU, or by the definition."""
        by_networks = all(head.decoding == "networks" for head in (self.geometry_head, self.appearance_head))
        if by_networks and fit_triton_kernels(self.anchors):
            from coliags_plugin.fields.triton_kernels.children import visible_children

            head_inputs = _seen(self.anchors, self.features, self.normals, camera, light)
            return visible_children(self._rows, camera, self.features, *self._networks(head_inputs))
        visible = self.visible_anchors(camera)
        anchors, features = (unique_rows(rows, visible) for rows in (self.anchors, self.features))
        normals = None if self.normals is None else self.normals.index_select(0, visible)
        head_inputs = _seen(anchors, features, normals, camera, light)
        if by_networks and fit_kernels(self.anchors):
            return fused_children(self._rows, visible, features, *self._networks(head_inputs)), visible
        opacities, covariances = self.geometry_head(head_inputs)
        return drawn_children(self._rows, visible, opacities, covariances, self.appearance_head(head_inputs)), visible

    def _networks(self, head_inputs: SeenAnchors) -> tuple[HeadNetworks, HeadNetworks]:
        return self.geometry_head.networks(head_inputs), self.appearance_head.networks(head_inputs)


def _seen(
    anchors: Tensor, features: Tensor, normals: Tensor | None, camera: Camera, light: HeldLight | None
) -> SeenAnchors:
    """The inputs of the heads for anchors that a camera sees under its own lamp or a held light."""
    sight = anchors - camera.center
    distances = sight.norm(dim=1, keepdim=True)
    directions = sight / distances
    # Anchors behind the lens would have negative cosines; the lamp does not shine there (docs/methods.md 3.3).
    cosines = (directions @ camera.optical_axis).clamp(0.0, 1.0)[:, None]
    if light is not None:
        distances, cosines = (values[:, None] for values in light.incidence(anchors))
    return SeenAnchors(features, directions, distances, cosines, normals)
