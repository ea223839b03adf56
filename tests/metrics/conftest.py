"""Hand-made comparisons, renders and frames for metrics and protocols."""

from __future__ import annotations

import cv2
import pytest
import torch

from coliags_plugin.config import registry
from coliags_plugin.contracts import Comparison
from coliags_plugin.core.render_output import RenderOutput
from coliags_plugin.metrics import lpips_weights
from tests.scenes import plain_frame


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
    return plain_frame


@pytest.fixture
def nowhere(monkeypatch, tmp_path):
    """A machine without any LPIPS weights."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    monkeypatch.delenv(lpips_weights.WEIGHTS_VARIABLE, raising=False)
    monkeypatch.setattr(lpips_weights, "find_spec", lambda name: None)
    return tmp_path


@pytest.fixture
def pair():
    """A Comparison of a random image and a noisy copy."""
    generator = torch.Generator().manual_seed(3)
    truth = torch.rand(48, 40, 3, generator=generator)
    return _images((truth + 0.1 * torch.randn(48, 40, 3, generator=generator)).clamp(0, 1), truth)


def _read(path):
    return torch.from_numpy(cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)).float() / 255


@pytest.fixture
def examples(shared_data):
    """The example images of LPIPS."""
    return {name: _read(shared_data / "lpips" / "test_images" / f"ex_{name}.png") for name in ("ref", "p0", "p1")}
