"""Weights and images of LPIPS."""

from __future__ import annotations

import cv2
import pytest
import torch

from coliags_plugin.metrics import lpips
from tests.metrics.made import images


@pytest.fixture
def nowhere(monkeypatch, tmp_path):
    """A machine without any LPIPS weights."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    monkeypatch.delenv(lpips.WEIGHTS_VARIABLE, raising=False)
    return tmp_path


@pytest.fixture
def pair():
    """A Comparison of a random image and a noisy copy."""
    generator = torch.Generator().manual_seed(3)
    truth = torch.rand(48, 40, 3, generator=generator)
    return images((truth + 0.1 * torch.randn(48, 40, 3, generator=generator)).clamp(0, 1), truth)


def _read(path):
    return torch.from_numpy(cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)).float() / 255


@pytest.fixture
def examples(shared_data):
    """The example images of LPIPS."""
    return {name: _read(shared_data / "lpips" / "test_images" / f"ex_{name}.png") for name in ("ref", "p0", "p1")}
