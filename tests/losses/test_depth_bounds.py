"""The one-sided depth loss, and the one that trusts pixels beside steps less: closed forms."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from coliags_plugin.core.scenes import concatenate_targets
from coliags_plugin.losses.edge_aware_depth import steps
from tests.losses.terms import make

NAN = float("nan")


@pytest.fixture
def frame(make_frame):
    """Four pixels, of which two are clipped, at 100 mm; one is masked in some tests."""
    made = make_frame(torch.zeros(1, 4, 3, dtype=torch.uint8), torch.tensor([[20.0, NAN, NAN, 40.0]]), None)
    return replace(made, depth_at_least=torch.tensor([[NAN, 100.0, 100.0, NAN]]))


def drawn(make_output, depth):
    depth = depth.requires_grad_()
    return make_output(torch.zeros(1, 4, 3), torch.zeros(0, 3), alpha=torch.ones(1, 4), depth_accumulated=depth), depth


def test_only_depths_below_the_clipped_one_cost(frame, make_output):
    output, depth = drawn(make_output, torch.tensor([[5.0, 60.0, 130.0, 5.0]]))
    term = make("depth-at-least")(output, frame)
    assert term.item() == pytest.approx(40.0 / 4)
    term.backward()
    assert depth.grad.tolist() == [[0.0, -0.25, 0.0, 0.0]]


def test_masked_pixels_and_frames_without_clipping_cost_nothing(frame, make_output):
    output, depth = drawn(make_output, torch.tensor([[5.0, 60.0, 60.0, NAN]]))
    masked = replace(frame, mask=torch.tensor([[True, False, True, True]]))
    assert make("depth-at-least")(output, masked).item() == pytest.approx(40.0 / 3)
    term = make("depth-at-least")(output, replace(frame, depth_at_least=None))
    assert term.item() == 0.0
    term.backward()
    assert depth.grad.tolist() == [[0.0, 0.0, 0.0, 0.0]]


def test_pixels_of_frames_keep_their_bounds(frame):
    pixels = torch.tensor([[1, 0], [3, 0]])
    joined = concatenate_targets([frame.target_at(pixels), replace(frame, depth_at_least=None).target_at(pixels)])
    expected = torch.tensor([[100.0], [NAN], [NAN], [NAN]])
    torch.testing.assert_close(joined.depth_at_least, expected, equal_nan=True)


def test_steps_are_within_one_pixel_of_a_change_of_depth():
    depth = torch.tensor([[10.0, 10.5, 10.9, 20.0, 20.0, NAN, 40.0]]).repeat(3, 1)
    assert steps(depth, 0.1).tolist() == [[False, False, True, True, False, False, False]] * 3
    assert not steps(torch.full((4, 5), NAN), 0.1).any()


def test_pixels_at_steps_weigh_less(make_frame, make_output):
    truth = torch.tensor([[10.0, 10.0, 20.0, 20.0]])
    frame = make_frame(torch.zeros(1, 4, 3, dtype=torch.uint8), truth, None)
    output, _ = drawn(make_output, truth + torch.tensor([[1.0, 5.0, 7.0, 2.0]]))
    term = make("edge-aware-depth-l1", weight_at_steps=0.5)(output, frame)
    assert term.item() == pytest.approx((1 + 0.5 * 5 + 0.5 * 7 + 2) / 3)
    confident = replace(frame, depth_confidence=torch.tensor([[1.0, 1.0, 1.0, 0.0]]))
    term = make("edge-aware-depth-l1", weight_at_steps=0.5)(output, confident)
    assert term.item() == pytest.approx((1 + 0.5 * 5 + 0.5 * 7) / 2)
    everywhere = make("edge-aware-depth-l1", weight_at_steps=1.0)(output, frame)
    assert everywhere.item() == pytest.approx(make("depth-l1")(output, frame).item())
