"""Hand-made comparisons and renders for metrics and protocols."""

from __future__ import annotations

import torch

from coliags_plugin.config import registry
from coliags_plugin.contracts import Comparison
from coliags_plugin.core.render_output import RenderOutput


def make(name, **options):
    """A metric by name and options."""
    metric = registry.metrics.get(name)
    return metric(metric.Settings(**options))


def images(rgb, true_rgb, valid=None):
    """A Comparison of two images."""
    valid = torch.ones(rgb.shape[:2], dtype=torch.bool) if valid is None else valid
    return Comparison(rgb, true_rgb, valid)


def depths(depth, true_depth, valid=None):
    """A Comparison of two depth maps."""
    grey = torch.zeros(*depth.shape, 3)
    everywhere = torch.ones(depth.shape, dtype=torch.bool)
    return Comparison(grey, grey, everywhere, depth, true_depth, torch.isfinite(true_depth) if valid is None else valid)


def make_output(rgb, **maps):
    """A RenderOutput of these colours and maps."""
    return RenderOutput(rgb, torch.ones(rgb.shape[:2]), None, maps)
