"""Gaussians of one view, the input of splatting renderers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class Gaussians:
    """3D Gaussians (or surfels) of one view, in the world frame and scene units.

    Attributes:
        means: Centres. [N, 3]
        quats_wxyz: Rotations, need not be normalised. [N, 4]
        scales: Standard deviations along the local axes; two for surfels. [N, 3] or [N, 2]
        opacities: In (0, 1]. [N]
        colors: RGB in [0, 1]. [N, 3]
        source_index: Which slot of the field each Gaussian comes from (the anchor field: anchor * children + child).
            [N]
        visible_sources: Field elements evaluated for this view, those that yielded no Gaussian included
            (the anchor field: anchors in the frustum). [V]
        features: Named channels that are composited like the colours, over 0; each comes out under its own name. [N, C]
    """

    means: Float[Tensor, "N 3"]
    quats_wxyz: Float[Tensor, "N 4"]
    scales: Float[Tensor, "N S"]
    opacities: Float[Tensor, "N"]
    colors: Float[Tensor, "N 3"]
    source_index: Int[Tensor, "N"]
    visible_sources: Int[Tensor, "V"]
    features: Mapping[str, Float[Tensor, "N C"]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.means)
