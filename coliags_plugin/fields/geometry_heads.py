"""Geometry heads: anchor feature and viewing direction -> opacity, scale and rotation of every child."""

from __future__ import annotations

import math
from typing import ClassVar

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn
from typing_extensions import TypeVar

from coliags_plugin.contracts import GeometryHead, HeadNetworks, SeenAnchors
from coliags_plugin.core.settings import Settings
from coliags_plugin.fields.mlp import mlp, outputs


class PlainGeometrySettings(Settings):
    """Options of the plain geometry head."""

    hidden: int = Field(default=32, ge=1)  # units of each hidden layer
    # Of every child at the start; null: random, about half of an anchor's children are below 0 (docs/methods.md 3.4).
    initial_opacity: float | None = Field(default=None, gt=0, lt=1)


#: Settings of a geometry head.
GeometryT = TypeVar("GeometryT", bound=PlainGeometrySettings, default=PlainGeometrySettings)


class PlainGeometryHead(GeometryHead[GeometryT]):
    """Geometry head of Scaffold-GS (docs/methods.md 3.6)."""

    Settings: ClassVar[type[Settings]] = PlainGeometrySettings
    decoding = "networks"

    def __init__(self, settings: GeometryT, features: int, children: int, generator: torch.Generator) -> None:
        super().__init__()
        self.settings = settings
        self.children_per_anchor = children
        inputs = features + 3 * (1 + 2 * self.frequencies)
        self.opacity_mlp = mlp(inputs, settings.hidden, children, generator)
        self.covariance_mlp = mlp(inputs, settings.hidden, 7 * children, generator)
        if settings.initial_opacity is not None:
            weight, bias = self.opacity_mlp[-1].parameters()
            nn.init.zeros_(weight)
            nn.init.constant_(bias, math.atanh(settings.initial_opacity))

    @property
    def frequencies(self) -> int:
        """Number of frequencies of the embedding of the viewing direction; 0 leaves it as it is."""
        return 0

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """The two MLPs."""
        return {
            "opacity_mlp": list(self.opacity_mlp.parameters()),
            "covariance_mlp": list(self.covariance_mlp.parameters()),
        }

    def networks(self, anchors: SeenAnchors) -> HeadNetworks:
        """The two MLPs."""
        return HeadNetworks(anchors.directions, 3, self.frequencies, (self.opacity_mlp, self.covariance_mlp))

    def forward(self, anchors: SeenAnchors) -> tuple[Float[Tensor, "V K"], Float[Tensor, "V K 7"]]:
        """Decode the children of the visible anchors."""
        opacities, covariances = outputs(anchors.features, self.networks(anchors))
        return opacities.tanh(), covariances.view(len(opacities), self.children_per_anchor, 7)


class IMVEGeometrySettings(PlainGeometrySettings):
    """Options of IMVE."""

    frequencies: int = Field(default=10, ge=0)  # of gamma, per component of the direction


class IMVEGeometryHead(PlainGeometryHead[IMVEGeometrySettings]):
    """Improved geometry Modelling with View Embedding: gamma(v) in place of v (paper, Eq. 7; docs/methods.md 3.4)."""

    @property
    def frequencies(self) -> int:
        """Number of frequencies for the viewing direction: gamma(v) has 63 numbers at ten."""
        return self.settings.frequencies
