"""What a Gaussian field hands to a renderer, and what the renderer answers."""

from __future__ import annotations

from dataclasses import dataclass, field

from jaxtyping import Float, Int
from torch import Tensor

#: Everything a renderer can be asked for. "depth" alone names nothing: each kind is a different quantity.
OUTPUTS = (
    "rgb",
    "alpha",
    "depth_accumulated",  # sum_i w_i z_i: the paper's D (Eq. 2); falls short where alpha < 1
    "depth_expected",  # sum_i w_i z_i / sum_i w_i
    "depth_median",  # z of the Gaussian at which transmittance falls to one half
    "inverse_depth_accumulated",  # sum_i w_i / z_i: what the authors' code trains on and scores
    "normals",  # sum_i w_i n_i, camera axes, n_i the shortest axis turned towards the camera
)

DEPTH_KINDS = tuple(name for name in OUTPUTS if "depth" in name)


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
    """

    means: Float[Tensor, "N 3"]
    quats_wxyz: Float[Tensor, "N 4"]
    scales: Float[Tensor, "N S"]
    opacities: Float[Tensor, "N"]
    colors: Float[Tensor, "N 3"]
    source_index: Int[Tensor, "N"]
    visible_sources: Int[Tensor, "V"]

    def __len__(self) -> int:
        return len(self.means)


@dataclass(frozen=True)
class RenderOutput:
    """One rendered view.

    Attributes:
        rgb: Composited colour over the background. [H, W, 3]
        alpha: Accumulated opacity. [H, W]
        maps: The other outputs asked for, by their names in :data:`OUTPUTS`. [H, W] or [H, W, 3]
        means2d: Projected centres, pixels; holds its gradient after backward. [N, 2]
        radii: Screen extent in pixels of each Gaussian, 0 where it was not drawn. [N]
        gaussians: What was drawn.
    """

    rgb: Float[Tensor, "H W 3"]
    alpha: Float[Tensor, "H W"]
    means2d: Float[Tensor, "N 2"]
    radii: Float[Tensor, "N"]
    gaussians: Gaussians
    maps: dict[str, Tensor] = field(default_factory=dict)

    def __getitem__(self, name: str) -> Tensor:
        """An output by name. Raises KeyError where it was not asked for."""
        if name == "rgb":
            return self.rgb
        if name == "alpha":
            return self.alpha
        return self.maps[name]
