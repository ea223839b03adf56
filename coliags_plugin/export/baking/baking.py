"""Fields that decode or light their Gaussians for each view, averaged over views to one cloud for all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.core.lamps import HeldLight
from coliags_plugin.core.scenes import Frame
from coliags_plugin.engine.held_light import gaussians_of, splatting_of
from coliags_plugin.engine.progress import ProgressReport
from coliags_plugin.engine.trained import TrainedRun
from coliags_plugin.export.baking.distillation import adjusted_camera, distil, needs_distillation
from coliags_plugin.export.splats.cloud import SplatCloud, cloud_of_field, field_of_cloud
from coliags_plugin.fields.explicit_gaussians import INVERSE_SQUARE, ExplicitGaussians
from coliags_plugin.fields.spherical_harmonics import MAX_DEGREE, Y0, basis
from coliags_plugin.renderers.splatting import SplattingRenderer

#: A Gaussian is kept whose blending weights add up to so many pixels over the views, and which is on average at least
#: so opaque: others are invisible.
_LEAST_WEIGHT, _LEAST_OPACITY = 0.02, 1.0 / 255.0
#: Below it a weight is no weight, pixels.
_NONE = 1e-12


def blending_weights(renderer: SplattingRenderer, gaussians: Gaussians, camera: Camera) -> Float[Tensor, "N"]:
    """Blending weights of each Gaussian in a view, summed over the pixels: the number of pixels it fills. [N]

    These are the gradients of the image's sum with respect to the colours.
    """
    colors = gaussians.colors.detach().clone().requires_grad_()
    output = renderer.draw(replace(gaussians, colors=colors, features={}), camera, ("rgb", "alpha"))
    (gradients,) = torch.autograd.grad(output.rgb.sum(), colors)
    return gradients.mean(dim=1)


class GaussianAverages:
    """Running averages of the Gaussians of a field over views, each weighted by what a view shows of it.

    Centres, colours and logarithms of scales are means, rotations the main axes of the quaternions' outer products.
    Opacities are weighted by the weight of the whole element: a child that an anchor does not yield in a view counts
    with 0. Each element has ``per_element`` slots, each slot so many scales: three, two for surfels.
    """

    def __init__(self, elements: int, per_element: int, scales: int, device: torch.device) -> None:
        self._per_element, slots = per_element, elements * per_element
        self._sizes = [3, 3, 1, scales, 16]  # of mean, colour, log distance, log scales, and product of quaternions
        self._sums = torch.zeros(slots, sum(self._sizes), device=device)
        self._weights, self._opacities = torch.zeros(2, slots, device=device)
        self._element_weights = torch.zeros(elements, device=device)

    def add(self, gaussians: Gaussians, weights: Float[Tensor, "N"], camera: Camera) -> None:
        """Add a view's Gaussians by their :func:`blending_weights`, or other weights."""
        slots = gaussians.source_index
        elements = slots // self._per_element
        shown = torch.zeros_like(self._element_weights).index_add_(0, elements, weights)
        self._element_weights += shown
        self._opacities.index_add_(0, slots, shown[elements] * gaussians.opacities)
        self._weights.index_add_(0, slots, weights)
        distances = (gaussians.means - camera.center.to(gaussians.means)).norm(dim=1, keepdim=True)
        quats = torch.nn.functional.normalize(gaussians.quats_wxyz, dim=1)
        products = (quats[:, :, None] * quats[:, None]).flatten(1)
        logs = distances.clamp_min(_NONE).log(), gaussians.scales.log()
        values = torch.cat([gaussians.means, gaussians.colors, *logs, products], dim=1)
        self._sums.index_add_(0, slots, weights[:, None] * values)

    def visible(self) -> Int[Tensor, "N"]:
        """Slots of the Gaussians that are visible in a view, ascending; InputError where none is. [N]"""
        visible = (self._weights >= _LEAST_WEIGHT) & (self._mean_opacities() >= _LEAST_OPACITY)
        if not visible.any():
            raise InputError("no Gaussian of this run is visible in a training view", "a trained run")
        return visible.nonzero().squeeze(1)

    def heaviest(self, most: int, share: float = 1.0) -> Int[Tensor, "N"]:
        """The fewest visible slots that hold a share of all weights, at most ``most``, ascending. [N]"""
        visible = self.visible()
        weights, order = self._weights[visible].double().sort(descending=True, stable=True)
        below = int((weights.cumsum(0) < share * weights.sum()).sum()) + 1
        return visible[order[: min(most, below)]].sort().values

    def mean_colors(self, slots: Int[Tensor, "N"]) -> Float[Tensor, "N 3"]:
        """Mean colours (RGB) of some slots. [N, 3]"""
        return self._sums[slots, 3:6] / self._weights[slots][:, None]

    def _mean_opacities(self) -> Float[Tensor, "L"]:
        shown = self._element_weights.repeat_interleave(self._per_element)
        return self._opacities / shown.clamp_min(_NONE)

    def cloud(self, slots: Int[Tensor, "N"], harmonics: Float[Tensor, "N B 3"], attenuated: bool = False) -> SplatCloud:
        """The averages of some slots with given colours, which may fall with the distance to the lamp."""
        weights = self._weights[slots][:, None]
        means, _, log_distances, log_scales, products = torch.split(self._sums[slots], self._sizes, dim=1)
        parts = [
            means / weights,
            torch.linalg.eigh(products.view(-1, 4, 4)).eigenvectors[:, :, -1],
            (log_scales / weights).exp(),
            self._mean_opacities()[slots].clamp(1e-4, 1.0 - 1e-4),
            harmonics,
        ]
        if attenuated:
            distances = (log_distances / weights).exp()
            parts.append(torch.cat([distances, torch.full_like(distances, INVERSE_SQUARE)], dim=1))
        return SplatCloud.of_tensors(*parts).with_thickness()


#: Training views, evenly spaced, at most: whose Gaussians are averaged, and whose colours are fitted.
_VIEWS, _COLOR_VIEWS = 120, 30
#: Share of all blending weights that the Gaussians hold which are fitted to what the run renders.
_FITTED_SHARE = 0.7


def bake(
    trained: TrainedRun,
    light: HeldLight | None,
    seconds: float = 180.0,
    most: int | None = None,
    degree: int = MAX_DEGREE,
    attenuated: bool = False,
    most_steps: int | None = None,
) -> tuple[SplatCloud, dict[str, Any]]:
    """Convert a field to one cloud of Gaussians for all views, under a held light; facts are empty if unchanged.

    Every Gaussian is averaged over training views, and its colours are fitted with spherical harmonics by least
    squares, both weighted by how much each view shows of it. Where these averages lose much, as they do of Gaussians
    that are others in every view, or where only ``most`` of them may be kept, those with the largest blending weights
    are fitted to what the run renders, for so many seconds and steps at most
    (:mod:`~coliags_plugin.export.baking.distillation`): 70 % of the weights, as fewer Gaussians allow more steps.
    Explicit Gaussians of which all may be kept are as they are, and surfels, made thin Gaussians that viewers draw with
    another filter, are fitted so, all of them.
    """
    scale, light = trained.model.scale, None if light is None else light.scaled(trained.model.scale)
    trained = trained.in_model_units
    explicit = trained.model.field
    if most is None and isinstance(explicit, ExplicitGaussians):
        baked = field_of_cloud(cloud_of_field(explicit).with_thickness())
        needs = explicit.scale_count < 3 and needs_distillation(baked, trained, light)
        facts = {"steps": distil(baked, trained, light, seconds, most_steps), "seconds": seconds} if needs else {}
        return cloud_of_field(baked).scaled(1.0 / scale), facts
    views = trained.scene.train[:: -(-len(trained.scene.train) // _VIEWS)]
    averages, colors = _averaged(trained, views, light)
    slots = averages.visible()
    visible, steps = len(slots), 0

    def field(slots: Int[Tensor, "N"]) -> ExplicitGaussians:
        harmonics = fit_harmonics(colors, slots, averages.mean_colors(slots), degree)
        return field_of_cloud(averages.cloud(slots, harmonics, attenuated))

    if most is not None:
        slots = averages.heaviest(most)
    baked = field(slots)
    if needs_distillation(baked, trained, light):
        baked = field(averages.heaviest(len(slots), _FITTED_SHARE))
        steps = distil(baked, trained, light, seconds, most_steps)
    facts = {"steps": steps, "seconds": seconds, "views": len(views), "visible": visible}
    return cloud_of_field(baked).scaled(1.0 / scale), facts


def _averaged(
    trained: TrainedRun, views: list[Frame], light: HeldLight | None
) -> tuple[GaussianAverages, list[SeenColors]]:
    """Gaussians of a run averaged over views, and their colours in some of these."""
    field, renderer = gaussians_of(trained.model), splatting_of(trained.model)
    averages = GaussianAverages(
        field.element_count, field.slots_per_element, 2 if field.primitive == "surfels" else 3, trained.device
    )
    colors: list[SeenColors] = []
    every = -(-len(views) // _COLOR_VIEWS)
    with ProgressReport("bake: average over views", len(views)) as progress:
        for index, frame in enumerate(views):
            camera = adjusted_camera(trained, frame)
            with torch.no_grad():
                gaussians = field.gaussians(camera, light)
            weights = blending_weights(renderer, gaussians, camera)
            averages.add(gaussians, weights, camera)
            if index % every == 0:
                colors.append(SeenColors.of(gaussians, weights, camera))
            progress.update(index + 1)
    return averages, colors


#: Added to the normal equations of coefficients above degree 0, whose weights add up to 1: a Gaussian seen along one
#: direction has no information about others, and keeps its mean colour there.
RIDGE = 0.01
#: Gaussians whose normal equations are solved at a time.
_CHUNK = 1 << 16


@dataclass(frozen=True)
class SeenColors:
    """Colours (RGB) of some Gaussians in one view, how much it shows of each, and unit directions from the camera."""

    slots: Int[Tensor, "V"]
    weights: Float[Tensor, "V"]
    directions: Float[Tensor, "V 3"]
    colors: Float[Tensor, "V 3"]

    @classmethod
    def of(cls, gaussians: Gaussians, weights: Float[Tensor, "N"], camera: Camera) -> SeenColors:
        """The colours of those that a view shows."""
        shown = weights > 0
        directions = torch.nn.functional.normalize(gaussians.means[shown] - camera.center, dim=1)
        return cls(gaussians.source_index[shown], weights[shown], directions, gaussians.colors[shown])


def fit_harmonics(
    views: Sequence[SeenColors], slots: Int[Tensor, "N"], mean_colors: Float[Tensor, "N 3"], degree: int
) -> Float[Tensor, "N B 3"]:
    """Coefficients that reproduce the colours best: weighted least squares per Gaussian, ridge above degree 0.

    Args:
        views: Colours in some views.
        slots: Gaussians to fit, ascending.
        mean_colors: RGB of these where no view shows them.
        degree: Degree D of the harmonics; B = (D + 1)^2.
    """
    bases = (degree + 1) ** 2
    rows = torch.full((int(slots[-1]) + 1,), -1, dtype=torch.int64, device=slots.device)
    rows[slots] = torch.arange(len(slots), device=slots.device)
    ridge = torch.full((bases,), RIDGE, device=slots.device)
    ridge[0] = 0.0
    parts = []
    for start in range(0, len(slots), _CHUNK):
        count = min(_CHUNK, len(slots) - start)
        normal = torch.zeros(count, bases, bases, device=slots.device)
        right = torch.zeros(count, bases, 3, device=slots.device)
        total = torch.zeros(count, device=slots.device)
        for view in views:
            row = rows[view.slots.clamp_max(len(rows) - 1)] - start
            here = (view.slots < len(rows)) & (row >= 0) & (row < count)
            row, weights = row[here], view.weights[here]
            values = basis(view.directions[here], degree)
            weighted = weights[:, None] * values
            normal.index_add_(0, row, weighted[:, :, None] * values[:, None])
            right.index_add_(0, row, weighted[:, :, None] * (view.colors[here] - mean_colors[start + row])[:, None])
            total.index_add_(0, row, weights)
        scale = total.clamp_min(1e-12)[:, None, None]
        parts.append(torch.linalg.solve(normal / scale + torch.diag(ridge + 1e-6 * Y0**2), right / scale))
    coefficients = torch.cat(parts)
    coefficients[:, 0] += (mean_colors - 0.5) / Y0
    return coefficients
