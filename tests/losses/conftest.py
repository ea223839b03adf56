"""Hand-made renders and frames for the losses."""

from __future__ import annotations

import pytest
import torch

from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.core.render_output import RenderOutput, Splats
from tests.scenes import plain_frame


def _output(rgb, scales=None, alpha=None, **maps):
    scales = torch.zeros(0, 3) if scales is None else scales
    count = len(scales)
    gaussians = Gaussians(
        torch.zeros(count, 3), torch.zeros(count, 4), scales, torch.ones(count), torch.zeros(count, 3),
        torch.arange(count), torch.arange(count),
    )  # fmt: skip
    splats = Splats(gaussians, torch.zeros(count, 2), torch.zeros(count))
    return RenderOutput(rgb, torch.ones(rgb.shape[:2]) if alpha is None else alpha, None, maps, splats)


@pytest.fixture
def make_output():
    """A RenderOutput of these colours, scales, alpha and maps."""
    return _output


@pytest.fixture
def make_frame():
    """A Frame of this image, depth and mask."""
    return plain_frame
