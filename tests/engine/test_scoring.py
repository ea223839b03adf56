"""Scores of single views: metrics that are not available, and protocols that are not valid."""

from __future__ import annotations

from unittest import mock

import pytest
import torch

from coliags_plugin.config import registry
from coliags_plugin.contracts import Comparison
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError, UnavailableError
from coliags_plugin.core.scenes import Frame
from coliags_plugin.engine.scoring import EvaluatedSet, Scorer
from coliags_plugin.metrics.image import PSNR
from coliags_plugin.metrics.protocols import PaperProtocol


def comparison(error=0.1):
    truth = torch.full((16, 16, 3), 0.5)
    return Comparison(truth + error, truth, torch.ones(16, 16, dtype=torch.bool))


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        (float("nan"), "the metric is nan"),
        (float("-inf"), "the metric is -inf"),
        (UnavailableError("no weights"), "no weights"),
    ],
)
def test_a_metric_that_cannot_be_had_has_a_reason(value, reason, monkeypatch):
    monkeypatch.setattr(PSNR, "__call__", mock.Mock(side_effect=[value]))
    scores = Scorer("paper", only=("psnr", "ssim")).score(comparison())
    assert scores.reasons == {"psnr": reason} and set(scores.values) == {"ssim"}


def test_views_that_show_nothing_within_their_masks_are_counted():
    left_half, nothing, everything = torch.zeros(16, 16, dtype=torch.bool), torch.zeros(16, 16), torch.ones(16, 16)
    left_half[:, :8] = True
    views = [
        (None, nothing),
        (left_half, (~left_half).float()),
        (left_half, left_half.float()),
        (~left_half & left_half, nothing),
        (None, everything),
    ]
    evaluated = EvaluatedSet("mm", Scorer("paper", only=("psnr",)))
    for index, (mask, alpha) in enumerate(views):
        camera = Camera(16.0, 16.0, 8.0, 8.0, 16, 16, torch.eye(4))
        image = torch.zeros(16, 16, 3, dtype=torch.uint8)
        evaluated.add(Frame.of(f"{index}", index, image, camera, mask=mask), comparison(), alpha)
    record = evaluated.record()
    assert record.blank == 2 and record.transparency_warning.startswith("2 of 5 views show nothing")


@pytest.mark.parametrize(
    ("metrics", "message"),
    [
        ({"sharpness": ("sharpnes", {})}, "protocol 'mine', metric 'sharpness': no metric 'sharpnes'"),
        ({"psnr": ("psnr", {"peek": 1.0})}, "protocol 'mine', metric 'psnr': option of 'psnr' peek"),
    ],
)
def test_metrics_of_a_protocol_that_are_not_valid_are_named(metrics, message, monkeypatch):
    mine = type("Mine", (PaperProtocol,), {"name": "mine", "metrics": metrics})
    monkeypatch.setitem(registry.protocols._targets, "mine", mine)
    with pytest.raises(InputError, match=message):
        Scorer("mine")


def test_a_protocol_under_another_name_is_refused(monkeypatch):
    monkeypatch.setitem(registry.protocols._targets, "mine", PaperProtocol)
    monkeypatch.setitem(registry.protocols._sources, "mine", "entry point x:Y")
    with pytest.raises(InputError, match="protocol 'mine' from entry point x:Y has the name 'paper'"):
        Scorer("mine")
