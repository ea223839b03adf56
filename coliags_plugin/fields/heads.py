"""Heads of an anchor field: feature and viewing geometry -> opacity, scale and rotation, or colour, of every child."""

from __future__ import annotations

import math
from typing import ClassVar, Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn
from typing_extensions import TypeVar

from coliags_plugin.contracts import AppearanceHead, GeometryHead, HeadNetworks, SeenAnchors
from coliags_plugin.core.scenes import Scene
from coliags_plugin.core.settings import Rates, Settings
from coliags_plugin.fields.mlp import mlp, outputs


class PlainGeometrySettings(Settings):
    """Options of the plain geometry head."""

    hidden: int = Field(default=32, ge=1)  # units of each hidden layer
    # Opacity of every child at the start; null: random, about half of the children are below 0 (docs/methods.md 3.4).
    initial_opacity: float | None = Field(default=None, gt=0, lt=1)


#: Settings of a geometry head.
GeometryT = TypeVar("GeometryT", bound=PlainGeometrySettings, default=PlainGeometrySettings)


class PlainGeometryHead(GeometryHead[GeometryT]):
    """Geometry head of Scaffold-GS (docs/methods.md 3.6)."""

    Settings: ClassVar[type[Settings]] = PlainGeometrySettings
    decoding = "networks"
    rates: ClassVar[Rates] = {  # Scaffold-GS's released code
        "opacity_mlp": {"lr": 0.002, "final_lr": 0.00002},
        "covariance_mlp": {"lr": 0.004},
    }

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
        """Number of frequencies of the embedding of the viewing direction; 0: the direction itself."""
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

    frequencies: int = Field(default=10, ge=0)  # frequencies of gamma, per component of the direction


class IMVEGeometryHead(PlainGeometryHead[IMVEGeometrySettings]):
    """Improved Geometry Modeling with View Embedding: gamma(v) in place of v (paper, Eq. 7; docs/methods.md 3.4)."""

    @property
    def frequencies(self) -> int:
        """Number of frequencies for the viewing direction: gamma(v) has 63 numbers at ten."""
        return self.settings.frequencies


#: Widths of the lobes of glints: sines of the angle at which each has fallen to 1 / e. The first is narrower than the
#: lobe of a wet film, the last knows no more than the side from which the wall is seen.
WIDTHS = (0.03, 0.06, 0.12, 0.25, 0.5, 1.0)
#: Largest component of a facet's tilt along the wall.
MAX_TILT = 0.5


class AppearanceSettings(Settings):
    """Options common to all appearance heads.

    ``bias_init`` initialises the biases of hidden units with the distance as an input: "scene_distances" spreads the
    units' kinks over the distances of the scene (docs/methods.md 3.4), "pytorch" is PyTorch's default, as in the paper.
    """

    hidden: int = Field(default=32, ge=1)  # units of each hidden layer
    bias_init: Literal["scene_distances", "pytorch"] = "scene_distances"  # initial biases of hidden units


#: Settings of an appearance head.
AppearanceT = TypeVar("AppearanceT", bound=AppearanceSettings, default=AppearanceSettings)


class MLPAppearanceHead(AppearanceHead[AppearanceT]):
    """Base class of heads of one MLP, which sees the anchor's feature and an encoding of the viewing geometry."""

    #: Channels of :meth:`embed_direction`, which lie between the feature and the distance.
    direction_channels: ClassVar[int] = 3
    #: How many of the last inputs are embedded by gamma.
    embedded: ClassVar[int] = 0
    decoding = "networks"
    rates: ClassVar[Rates] = {"color_mlp": {"lr": 0.008, "final_lr": 0.00005}}  # Scaffold-GS's released code

    def __init__(self, settings: AppearanceT, features: int, children: int, generator: torch.Generator) -> None:
        super().__init__()
        self.settings = settings
        self.children_per_anchor = children
        self.features = features
        anchors = SeenAnchors(*(torch.zeros(1, width) for width in (features, self.direction_channels, 1, 1)))
        inputs = self.inputs(anchors).shape[1] + 2 * self.embedded * self.frequencies
        self.color_mlp = mlp(features + inputs, settings.hidden, 3 * children, generator)

    @property
    def frequencies(self) -> int:
        """Number of frequencies of the positional encoding; 0 means none."""
        return 0

    def embed_direction(self, anchors: SeenAnchors) -> Float[Tensor, "V D"]:
        """Encoding of the viewing direction that the MLP gets."""
        return anchors.directions

    def inputs(self, anchors: SeenAnchors) -> Float[Tensor, "V R"]:
        """Inputs of the MLP besides the feature: the direction as encoded, then the distance if :attr:`knows_lamp`."""
        return torch.cat([anchors.directions, anchors.distances], dim=1) if self.knows_lamp else anchors.directions

    @torch.no_grad()
    def prepare(self, scene: Scene, distances: Float[Tensor, "D"]) -> None:
        """Initialise the biases so that each hidden unit's kink is at a distance of the scene (docs/methods.md 3.4).

        Drawn about zero, units see millimetres that outweigh all other inputs: those with a negative weight for the
        distance, about half, are never active and never learn.
        """
        if not self.knows_lamp or self.settings.bias_init == "pytorch" or len(distances) == 0:
            return
        units = self.settings.hidden
        places = (torch.arange(units, device=distances.device) * 2 + 1) * len(distances) // (2 * units)
        kinks = distances.sort().values[places]
        of_distance = self.color_mlp.get_parameter("0.weight")[:, self.features + self.direction_channels]
        self.color_mlp.get_parameter("0.bias").sub_(of_distance * kinks)

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """The MLP."""
        return {"color_mlp": list(self.color_mlp.parameters())}

    def networks(self, anchors: SeenAnchors) -> HeadNetworks:
        """The MLP."""
        inputs = self.inputs(anchors._replace(directions=self.embed_direction(anchors)))
        return HeadNetworks(inputs, self.embedded, self.frequencies, (self.color_mlp,))

    def forward(self, anchors: SeenAnchors) -> Float[Tensor, "V K 3"]:
        """Decode the children's colours."""
        (colors,) = outputs(anchors.features, self.networks(anchors))
        return colors.view(len(colors), self.children_per_anchor, 3).sigmoid()


class PlainAppearanceSettings(AppearanceSettings):
    """Options of the plain appearance head."""

    distance: bool = False  # Scaffold-GS's add_color_dist: distance as a further input


class PlainAppearanceHead(MLPAppearanceHead[PlainAppearanceSettings]):
    """Appearance head of Scaffold-GS, optionally with distance as an input (docs/methods.md 3.6)."""

    @property
    def knows_lamp(self) -> bool:
        """True where the distance to the lamp is an input of the MLP."""
        return self.settings.distance


class IMIAAppearanceSettings(AppearanceSettings):
    """Options of IMIA."""

    frequencies: int = Field(default=5, ge=0)  # frequencies of gamma, for the cosine


class IMIAAppearanceHead(MLPAppearanceHead[IMIAAppearanceSettings]):
    """Improved Appearance Modeling with Illumination Attenuation (paper, Eq. 8; docs/methods.md 3.4).

    The MLP sees v, the distance d to the lamp and gamma(cos theta), the angle to the optical axis in which light
    spread and vignetting merge.
    """

    embedded: ClassVar[int] = 1

    @property
    def frequencies(self) -> int:
        """Number of frequencies for the cosine: gamma(cos theta) has 11 numbers at five."""
        return self.settings.frequencies

    def inputs(self, anchors: SeenAnchors) -> Float[Tensor, "V R"]:
        """v, d and cos theta."""
        return torch.cat([anchors.directions, anchors.distances, anchors.cosines], dim=1)


class GlintAppearanceHead(IMIAAppearanceHead):
    """IMIA with lobes about the directions in which an anchor's micro-facets throw the lamp's light back.

    The lamp sits at the lens: a facet glints where it is seen along its normal. A layer decodes the tilt of each facet
    against the wall's normal from the anchor's feature; the MLP sees the components of v along the tilted facet, and
    Gaussians of their length, of six widths (docs/methods.md 3.8).
    """

    #: Channels of the encoded direction: v, the facets' components, and lobes.
    direction_channels: ClassVar[int] = 3 + 2 + len(WIDTHS)

    def __init__(
        self, settings: IMIAAppearanceSettings, features: int, children: int, generator: torch.Generator
    ) -> None:
        super().__init__(settings, features, children, generator)
        self.tilt_layer = nn.Linear(features, 2)
        nn.init.zeros_(self.tilt_layer.weight)
        nn.init.zeros_(self.tilt_layer.bias)

    @property
    def uses_normals(self) -> bool:
        """Always."""
        return True

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """The MLP with the layer of the tilts."""
        return {"color_mlp": [*self.color_mlp.parameters(), *self.tilt_layer.parameters()]}

    def embed_direction(self, anchors: SeenAnchors) -> Float[Tensor, "V D"]:
        """v, and the facets' components and lobes."""
        assert anchors.normals is not None, "the field keeps normals, as uses_normals says"
        tilts = MAX_TILT * self.tilt_layer(anchors.features).tanh()
        across = tangent_components(anchors.directions, anchors.normals) - tilts
        squares = across.square().sum(1, keepdim=True)
        return torch.cat([anchors.directions, across, *(torch.exp(squares * -(width**-2)) for width in WIDTHS)], dim=1)


def tangent_components(directions: Float[Tensor, "V 3"], normals: Float[Tensor, "V 3"]) -> Float[Tensor, "V 2"]:
    """Components of directions along two axes that are perpendicular to a normal and to each other.

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
