"""Gaussians that differ from view to view, averaged over views."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.fields.explicit_gaussians import ExplicitGaussians, ExplicitGaussiansSettings
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
    with 0.

    Args:
        elements: Of the field, E.
        per_element: Slots of each.
        device: Of the Gaussians.
    """

    def __init__(self, elements: int, per_element: int, device: torch.device) -> None:
        self._per_element = per_element
        slots = elements * per_element

        def zeros(*shape: int) -> Tensor:
            return torch.zeros(shape, device=device)

        self._weights, self._opacities, self._element_weights = zeros(slots), zeros(slots), zeros(elements)
        self._means, self._log_scales, self._rotations = zeros(slots, 3), zeros(slots, 3), zeros(slots, 4, 4)
        self._colors = zeros(slots, 3)

    def add(self, gaussians: Gaussians, weights: Float[Tensor, "N"]) -> None:
        """Add a view.

        Args:
            gaussians: Of the view, with three scales each.
            weights: Their :func:`blending_weights`. [N]
        """
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

    def kept(self) -> Int[Tensor, "N"]:
        """Slots of the Gaussians that are visible in a view, ascending. [N]

        Raises:
            InputError: There are none.
        """
        visible = (self._weights >= _LEAST_WEIGHT) & (self._mean_opacities() >= _LEAST_OPACITY)
        if not visible.any():
            raise InputError("no Gaussian of this run is visible in a training view", "a trained run")
        return visible.nonzero().squeeze(1)

    def colors(self, kept: Int[Tensor, "N"]) -> Float[Tensor, "N 3"]:
        """Mean colours. [N, 3]

        Args:
            kept: Slots. [N]
        """
        return self._colors[kept] / self._weights[kept][:, None]

    def _mean_opacities(self) -> Float[Tensor, "L"]:
        shown = self._element_weights.repeat_interleave(self._per_element)
        return self._opacities / shown.clamp_min(_NONE)

    def field(self, kept: Int[Tensor, "N"], harmonics: Float[Tensor, "N B 3"]) -> ExplicitGaussians:
        """The averages as an explicit field.

        Args:
            kept: Slots of its Gaussians. [N]
            harmonics: Their colours, to degree D, B = (D + 1)^2. [N, B, 3]
        """
        degree = round(harmonics.shape[1] ** 0.5) - 1
        made = ExplicitGaussians(ExplicitGaussiansSettings(sh_degree=degree), len(kept)).to(kept.device)
        weights = self._weights[kept][:, None]
        with torch.no_grad():
            made.means.copy_(self._means[kept] / weights)
            made.scales.copy_(self._log_scales[kept] / weights)
            made.quats.copy_(torch.linalg.eigh(self._rotations[kept]).eigenvectors[:, :, -1])
            made.opacities.copy_(torch.logit(self._mean_opacities()[kept].clamp(1e-4, 1.0 - 1e-4)))
            made.sh0.copy_(harmonics[:, :1])
            made.shN.copy_(harmonics[:, 1:])
            made.degree.fill_(degree)
        return made
