"""Glints of the lamp on the wet wall: IMIA that also sees how far a micro-facet is from facing the lamp."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from coliags_plugin.fields.appearance_heads import IMIAAppearanceHead

#: Widths of the lobes: sines of the angle at which each has fallen to 1 / e. The first is narrower than the lobe of a
#: wet film, the last knows no more than the side from which the wall is seen.
WIDTHS = (0.03, 0.06, 0.12, 0.25, 0.5, 1.0)
#: Largest component of a facet's tilt along the wall.
MAX_TILT = 0.5


class GlintAppearanceHead(IMIAAppearanceHead):
    """IMIA with lobes about the directions in which an anchor's micro-facets throw the lamp's light back.

    The lamp sits at the lens: a facet glints where it is seen along its normal. A layer decodes the tilt of each facet
    against the wall's normal from the anchor's feature; the MLP sees the components of v along the tilted facet, and
    Gaussians of their length, of six widths (docs/methods.md 3.8).
    """

    def __init__(self, settings: Any, features: int, children: int, generator: torch.Generator) -> None:
        super().__init__(settings, features, children, generator)
        self.tilt_layer = nn.Linear(features, 2)
        nn.init.zeros_(self.tilt_layer.weight)
        nn.init.zeros_(self.tilt_layer.bias)

    @property
    def uses_normals(self) -> bool:
        """Always."""
        return True

    @property
    def direction_channels(self) -> int:
        """Those of v, of the facets' components and lobes."""
        return 3 + 2 + len(WIDTHS)

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """The MLP with the layer of the tilts."""
        return {"color_mlp": [*self.color_mlp.parameters(), *self.tilt_layer.parameters()]}

    def embed_direction(
        self, features: Float[Tensor, "V F"], directions: Float[Tensor, "V 3"], normals: Float[Tensor, "V 3"] | None
    ) -> Float[Tensor, "V D"]:
        """v, and the facets' components and lobes."""
        assert normals is not None, "the field keeps normals, as uses_normals says"
        tilts = MAX_TILT * self.tilt_layer(features).tanh()
        across = tangent_components(directions, normals) - tilts
        squares = across.square().sum(1, keepdim=True)
        return torch.cat([directions, across, *(torch.exp(squares * -(width**-2)) for width in WIDTHS)], dim=1)


def tangent_components(directions: Float[Tensor, "V 3"], normals: Float[Tensor, "V 3"]) -> Float[Tensor, "V 2"]:
    """Components of directions along two axes that are perpendicular to a normal and to each other. [V, 2]

    The axes follow from the normal alone, and turn smoothly with it except where its z changes sign (Duff et al. 2017,
    *Building an Orthonormal Basis, Revisited*).
    """
    x, y, z = normals.unbind(1)
    sign = torch.where(z < 0, -1.0, 1.0).to(z)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = torch.stack([1.0 + sign * x * x * a, sign * b, -sign * x], dim=1)
    second = torch.stack([b, sign + y * y * a, -y], dim=1)
    return torch.stack([(directions * first).sum(1), (directions * second).sum(1)], dim=1)
