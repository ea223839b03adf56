"""Image gradients of projected centres, the statistic of densification."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from coliags_plugin.core.render_output import RenderOutput


def gradient_lengths(output: RenderOutput) -> Float[Tensor, "N"] | None:
    """Length of the gradient of each projected centre in units of half the image; 0 where a Gaussian was not drawn.

    These are the units of 3DGS's and Scaffold-GS's thresholds (docs/methods.md 4.3). None before ``backward``, or if no
    gradient reached the centres.
    """
    splats = output.drawn
    gradient = splats.means2d.grad
    if gradient is None:
        return None
    height, width = output.alpha.shape
    # A mask instead of indexing, which would synchronise with the GPU.
    lengths = torch.hypot(0.5 * width * gradient[:, 0], 0.5 * height * gradient[:, 1])
    return torch.where(splats.radii > 0, lengths, 0.0)
