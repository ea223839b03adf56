"""Gaussians that differ from view to view, averaged over views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from coliags_plugin.contracts import GaussianField, gaussians_under
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.fields.explicit_gaussians import ExplicitGaussians, ExplicitGaussiansSettings
from coliags_plugin.lighting.lamps import HeldLight
from coliags_plugin.renderers.splatting import SplattingRenderer

#: A Gaussian is kept whose blending weights add up to so many pixels over the views, and which is on average at least
#: so opaque: others are invisible.
_LEAST_WEIGHT, _LEAST_OPACITY = 0.02, 1.0 / 255.0
#: Below it a weight is no weight, pixels.
_NONE = 1e-12


def blending_weights(renderer: SplattingRenderer, gaussians: Gaussians, camera: Camera) -> Float[Tensor, "N"]:
    """How many pixels each Gaussian fills in a view: its blending weights, summed over the pixels. [N]

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
        self._per_element = per_element
        slots = elements * per_element

        def zeros(*shape: int) -> Tensor:
            return torch.zeros(shape, device=device)

        self._weights, self._opacities, self._element_weights = zeros(slots), zeros(slots), zeros(elements)
        self._means, self._log_scales, self._rotations = zeros(slots, 3), zeros(slots, scales), zeros(slots, 4, 4)
        self._colors = zeros(slots, 3)

    def add(self, gaussians: Gaussians, weights: Float[Tensor, "N"]) -> None:
        """Add a view's Gaussians by their :func:`blending_weights`, or other weights."""
        slots = gaussians.source_index
        elements = slots // self._per_element
        shown = torch.zeros_like(self._element_weights).index_add_(0, elements, weights)
        quats = torch.nn.functional.normalize(gaussians.quats_wxyz, dim=1)
        products = quats[:, :, None] * quats[:, None]
        self._element_weights += shown
        self._opacities.index_add_(0, slots, shown[elements] * gaussians.opacities)
        self._weights.index_add_(0, slots, weights)
        self._means.index_add_(0, slots, weights[:, None] * gaussians.means)
        self._colors.index_add_(0, slots, weights[:, None] * gaussians.colors)
        self._log_scales.index_add_(0, slots, weights[:, None] * gaussians.scales.log())
        self._rotations.index_add_(0, slots, weights[:, None, None] * products)

    def visible(self) -> Int[Tensor, "N"]:
        """Slots of the Gaussians that are visible in a view, ascending. [N]"""
        visible = (self._weights >= _LEAST_WEIGHT) & (self._mean_opacities() >= _LEAST_OPACITY)
        return visible.nonzero().squeeze(1)

    def kept(self) -> Int[Tensor, "N"]:
        """The same, at least one; refuses a run of which nothing is visible. [N]"""
        visible = self.visible()
        if not len(visible):
            raise InputError("no Gaussian of this run is visible in a training view", "a trained run")
        return visible

    def gaussians(self, kept: Int[Tensor, "N"]) -> Gaussians:
        """The averages of some slots, of no view in particular."""
        weights = self._weights[kept][:, None]
        return Gaussians(
            means=self._means[kept] / weights,
            quats_wxyz=torch.linalg.eigh(self._rotations[kept]).eigenvectors[:, :, -1],
            scales=(self._log_scales[kept] / weights).exp(),
            opacities=self._mean_opacities()[kept],
            colors=self._colors[kept] / weights,
            source_index=kept,
            visible_sources=kept,
        )

    def _mean_opacities(self) -> Float[Tensor, "L"]:
        shown = self._element_weights.repeat_interleave(self._per_element)
        return self._opacities / shown.clamp_min(_NONE)

    def field(self, kept: Int[Tensor, "N"], harmonics: Float[Tensor, "N B 3"]) -> ExplicitGaussians:
        """The averages of some slots as an explicit field, with colours to degree D, B = (D + 1)^2."""
        degree = round(harmonics.shape[1] ** 0.5) - 1
        made = ExplicitGaussians(ExplicitGaussiansSettings(sh_degree=degree), len(kept)).to(kept.device)
        mean = self.gaussians(kept)
        with torch.no_grad():
            made.means.copy_(mean.means)
            made.scales.copy_(self._log_scales[kept] / self._weights[kept][:, None])
            made.quats.copy_(mean.quats_wxyz)
            made.opacities.copy_(torch.logit(mean.opacities.clamp(1e-4, 1.0 - 1e-4)))
            made.sh0.copy_(harmonics[:, :1])
            made.shN.copy_(harmonics[:, 1:])
            made.degree.fill_(degree)
        return made


@torch.no_grad()
def mean_gaussians(field: GaussianField, cameras: Sequence[Camera], light: HeldLight | None = None) -> Gaussians:
    """The Gaussians of a field for no view in particular: averages over views, weighted by their opacities there.

    Without a light to hold, the lamp of each camera lights them, so that colours are of the average light.
    """
    views = [gaussians_under(field, camera, light) for camera in cameras]
    slots = max((int(view.source_index.max()) + 1 for view in views if len(view)), default=0)
    per_element, scales = field.slots_per_element, views[0].scales.shape[1]
    averages = GaussianAverages(-(-slots // per_element), per_element, scales, views[0].means.device)
    for view in views:
        averages.add(view, view.opacities)
    return averages.gaussians(averages.visible())
