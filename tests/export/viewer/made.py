"""Gaussians for tests of the view."""

from __future__ import annotations

import torch

from coliags_plugin.core.gaussians import Gaussians


def some_gaussians(count: int, scales: int = 3, seed: int = 0) -> Gaussians:
    """So many at random, within 10 mm of the origin."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> torch.Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator)

    index = torch.arange(count)
    return Gaussians(
        means=uniform(-10.0, 10.0, count, 3),
        quats_wxyz=torch.randn(count, 4, generator=generator),
        scales=uniform(0.1, 1.0, count, scales),
        opacities=uniform(0.05, 1.0, count),
        colors=uniform(0.0, 1.0, count, 3),
        source_index=index,
        visible_sources=index,
    )
