"""Depth at single points, and estimated depth, under the protocols."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from coliags_plugin.config import registry
from coliags_plugin.contracts import Comparison
from coliags_plugin.core.errors import UnavailableError
from coliags_plugin.core.scenes import SparseDepth
from coliags_plugin.engine.scoring import Scorer
from tests.metrics.made import make, make_output
from tests.scenes import plain_frame as make_frame

HEIGHT, WIDTH = 6, 8


@pytest.fixture
def frame():
    return make_frame(torch.zeros(HEIGHT, WIDTH, 3, dtype=torch.uint8))


@pytest.fixture
def output():
    plane = 20 + torch.arange(WIDTH, dtype=torch.float32).expand(HEIGHT, WIDTH)  # z = 19.5 + column
    rgb = torch.full((HEIGHT, WIDTH, 3), 0.5)
    return make_output(rgb, depth_accumulated=plane, inverse_depth_accumulated=1 / plane)


@pytest.mark.parametrize("quantile", [0.0, 0.5, 0.9, 1.0])
def test_it_is_a_quantile_of_the_relative_errors(quantile):
    generator = torch.Generator().manual_seed(0)
    rendered, known = 10 + 20 * torch.rand(2, 101, generator=generator)
    grey, valid = torch.zeros(1, 1, 3), torch.ones(1, 1, dtype=torch.bool)
    found = make("sparse_depth", quantile=quantile)(
        Comparison(grey, grey, valid, point_depth=rendered, true_point_depth=known)
    )
    expected = np.quantile(np.abs(rendered.numpy() - known.numpy()) / known.numpy(), quantile)
    assert found == pytest.approx(100 * expected, rel=1e-5)


def test_a_protocol_interpolates_at_usable_points(frame, output):
    pixels = torch.tensor([[1.25, 2.5], [4.0, 3.0], [7.5, 5.5], [0.5, 0.5], [3.5, 0.5]])
    known = torch.tensor([20.75 / 1.1, 23.5 / 0.8, 27.0, 20.0, 0.0])  # errors of 10 %, 20 %, 0; ignored; no surface
    mask = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    mask[0, 0] = False
    at = replace(frame, mask=mask, sparse_depth=SparseDepth(pixels, known))
    comparison = registry.protocols.get("paper")().compare(output, at)
    torch.testing.assert_close(comparison.point_depth, torch.tensor([20.75, 23.5, 27.0]))
    scores = Scorer("paper").score(comparison)
    assert scores.values["sparse_depth_median"] == pytest.approx(10.0, rel=1e-5)
    assert scores.values["sparse_depth_p90"] == pytest.approx(18.0, rel=1e-5)
    assert scores.reasons["depth_mse"] == "this frame has no ground-truth depth"


def test_without_points_or_without_anything_drawn_it_is_unavailable(frame, output):
    scorer, protocol = Scorer("paper"), registry.protocols.get("paper")()
    reasons = scorer.score(protocol.compare(output, frame)).reasons
    assert reasons["sparse_depth_median"] == "this frame has no points of known depth"
    points = SparseDepth(torch.tensor([[2.0, 2.0]]), torch.tensor([20.0]))
    empty = replace(output, alpha=torch.zeros(HEIGHT, WIDTH))
    reasons = scorer.score(protocol.compare(empty, replace(frame, sparse_depth=points))).reasons
    assert reasons["sparse_depth_p90"] == "nothing was drawn at the points of known depth"


@pytest.mark.parametrize("name", ["paper", "authors-code"])
def test_estimated_depth_is_no_truth(name, frame, output):
    depth = torch.full((HEIGHT, WIDTH), 21.0)
    estimated = replace(frame, depth=depth, depth_confidence=torch.ones(HEIGHT, WIDTH))
    comparison = registry.protocols.get(name)().compare(output, estimated)
    assert comparison.estimated
    assert comparison.depth is comparison.true_depth is comparison.depth_valid is None
    with pytest.raises(UnavailableError, match="estimated depth is no truth"):
        make("depth_mse")(comparison)
    assert (
        "depth_mse"
        in Scorer(name).score(registry.protocols.get(name)().compare(output, replace(frame, depth=depth))).values
    )
