"""Outputs of renderers."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError, check_name
from coliags_plugin.core.gaussians import Gaussians

#: All outputs of renderers besides a field's own feature channels. "depth" alone names nothing: each kind
#: is a different quantity.
OUTPUTS = (
    "rgb",
    "alpha",
    "depth_accumulated",  # sum_i w_i z_i: the paper's D (Eq. 2); too small where alpha < 1
    "depth_expected",  # sum_i w_i z_i / sum_i w_i
    "depth_median",  # z of the Gaussian at which transmittance falls to one half
    "inverse_depth_accumulated",  # sum_i w_i / z_i: used by the authors' code for training and evaluation
    "normals",  # sum_i w_i n_i, camera axes, n_i the shortest axis, facing the camera
    "distortion",  # sum_{j<i} w_i w_j (m_i - m_j)^2, m a depth in [0, 1]; surfels only
)

#: Alpha below which a pixel shows more background than tissue, so that its depth means little.
OPAQUE_ALPHA = 0.5
#: Views of a smaller mean alpha show nothing.
BLANK_ALPHA = 1e-3

#: Outputs that only surfels have.
SURFEL_OUTPUTS = frozenset({"distortion"})

DEPTH_KINDS = tuple(name for name in OUTPUTS if "depth" in name)


@dataclass(frozen=True)
class Splats:
    """Rendered Gaussians and their projections, of splatting renderers only.

    Attributes:
        gaussians: What was drawn.
        means2d: Projected centres, pixels; holds its gradient after ``backward``. [N, 2]
        radii: Screen extent in pixels of each Gaussian, 0 where it was not drawn. [N]
    """

    gaussians: Gaussians
    means2d: Float[Tensor, "N 2"]
    radii: Float[Tensor, "N"]


@dataclass(frozen=True)
class RenderOutput:
    """One rendered view, or a batch of its pixels as an image of P rows and one column.

    Attributes:
        rgb: Composited colour over the background. [H, W, 3]
        alpha: Accumulated opacity. [H, W]
        camera: What it was rendered from, as the model's modules adjusted it; None for pixels of several cameras.
        maps: The other requested outputs by name. [H, W] or [H, W, C]
        splats: From splatting renderers only.
    """

    rgb: Float[Tensor, "H W 3"]
    alpha: Float[Tensor, "H W"]
    camera: Camera | None
    maps: dict[str, Tensor] = field(default_factory=dict)
    splats: Splats | None = None

    @property
    def expected_depth(self) -> Float[Tensor, "H W"] | None:
        """Expected depth, sum w z / sum w, NaN where alpha is below :data:`OPAQUE_ALPHA`. [H, W]

        Of a view with accumulated depth; None where that was not requested.
        """
        accumulated = self.maps.get("depth_accumulated")
        if accumulated is None:
            return None
        return torch.where(self.alpha >= OPAQUE_ALPHA, accumulated / self.alpha, torch.nan)

    @property
    def drawn(self) -> Splats:
        """The splats; InputError where the renderer draws none."""
        if self.splats is None:
            raise InputError("a rendered view without splats", "one of a splatting renderer", "Choose another renderer")
        return self.splats

    @property
    def gradient_lengths(self) -> Float[Tensor, "N"] | None:
        """Length of the gradient of each of ``means2d`` in units of half the image; 0 where a Gaussian was not drawn.

        These are the units of 3DGS's and Scaffold-GS's thresholds (docs/methods.md 4.3). None before ``backward``, or
        if no gradient reached the centres.
        """
        gradient = self.drawn.means2d.grad
        if gradient is None:
            return None
        height, width = self.alpha.shape
        # A mask instead of indexing, which would synchronise with the GPU.
        lengths = torch.hypot(0.5 * width * gradient[:, 0], 0.5 * height * gradient[:, 1])
        return torch.where(self.drawn.radii > 0, lengths, 0.0)

    def __getitem__(self, name: str) -> Tensor:
        """An output by name. Raises KeyError if it was not requested."""
        if name == "rgb":
            return self.rgb
        if name == "alpha":
            return self.alpha
        if name not in self.maps:
            raise KeyError(f"output '{name}' was not requested; the component that reads it must list it in `wants`")
        return self.maps[name]


def check_outputs(wants: Iterable[str], names: Collection[str]) -> None:
    """Refuse outputs that a renderer does not have."""
    for name in wants:
        check_name("renderer output", name, names)


def concatenate_pixels(parts: Sequence[RenderOutput]) -> RenderOutput:
    """Pixel batches of several cameras, of P_i rows and one column each and with the same maps, as one."""
    if len(parts) == 1:
        return parts[0]
    maps = {name: torch.cat([part.maps[name] for part in parts]) for name in parts[0].maps}
    return RenderOutput(torch.cat([p.rgb for p in parts]), torch.cat([p.alpha for p in parts]), None, maps)
