"""Hand-made comparisons, renders and frames for metrics and protocols."""

from __future__ import annotations

import pytest
import torch

from coliags_plugin.config import registry
from coliags_plugin.contracts import Comparison
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.render_output import RenderOutput
from coliags_plugin.core.scenes import Frame


def _make(name, **options):
    metric = registry.metrics.get(name)
    return metric(metric.Settings(**options))


def _images(rgb, true_rgb, valid=None):
    valid = torch.ones(rgb.shape[:2], dtype=torch.bool) if valid is None else valid
    return Comparison(rgb, true_rgb, valid)


def _depths(depth, true_depth, valid=None):
    grey = torch.zeros(*depth.shape, 3)
    everywhere = torch.ones(depth.shape, dtype=torch.bool)
    return Comparison(grey, grey, everywhere, depth, true_depth, torch.isfinite(true_depth) if valid is None else valid)


def _output(rgb, **maps):
    return RenderOutput(rgb, torch.ones(rgb.shape[:2]), None, maps)


def _frame(image, depth=None, mask=None):
    height, width = image.shape[:2]
    camera = Camera(100.0, 100.0, width / 2, height / 2, width, height, torch.eye(4))
    return Frame("0007", 7, image, camera, depth, mask)


@pytest.fixture
def make():
    """A metric by name and options."""
    return _make


@pytest.fixture
def images():
    """A Comparison of two images."""
    return _images


@pytest.fixture
def depths():
    """A Comparison of two depth maps."""
    return _depths


@pytest.fixture
def make_output():
    """A RenderOutput of these colours and maps."""
    return _output


@pytest.fixture
def make_frame():
    """A Frame of this image, depth and mask."""
    return _frame
