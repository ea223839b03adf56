"""The distance along the ray: against the geometry, in its units, at a fixed share of the pixels."""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace

import pytest
import torch

from coliags_plugin.config import registry
from coliags_plugin.contracts import Schedule, TrainingStep
from coliags_plugin.core.render_output import RenderOutput, concatenate_pixels
from coliags_plugin.core.scenes import concatenate_targets
from tests.losses import terms
from tests.scenes import camera_at, wall_scene
from tests.scenes import plain_frame as make_frame

make = partial(terms.make, "distance-l1")


def output(depth, lengths, kind="depth_accumulated"):
    return RenderOutput(
        torch.zeros(*depth.shape, 3), torch.ones(depth.shape), None, {kind: depth, "ray_lengths": lengths}
    )


def test_it_is_the_distance_between_points_on_the_ray():
    camera = camera_at(1.0, 2.0, 3.0, 6, 5, yaw=0.4)
    generator = torch.Generator().manual_seed(0)
    true, drawn = 20 + 5 * torch.rand(2, 5, 6, generator=generator, dtype=torch.float64)
    lengths = camera.rays().norm(dim=-1)
    frame = make_frame(torch.zeros(5, 6, 3, dtype=torch.uint8), true)
    found = make()(output(drawn, lengths), frame)
    apart = (camera.unproject(drawn) - camera.unproject(true)).norm(dim=-1)
    torch.testing.assert_close(found, apart.mean())
    coarse = make(depth="depth_accumulated_coarse")
    assert coarse(output(drawn, lengths, "depth_accumulated_coarse"), frame) == found
    assert coarse.loss.wants == {"depth_accumulated_coarse", "ray_lengths"} and coarse.loss.needs == {"depth"}


def test_in_the_fields_unit_it_is_divided_by_it():
    frame = make_frame(torch.zeros(1, 2, 3, dtype=torch.uint8), torch.tensor([[10.0, 20.0]]))
    loss = make(unit="field").loss
    model = SimpleNamespace(field=SimpleNamespace(length_unit=torch.tensor(50.0)))
    seen = output(torch.tensor([[12.0, 20.0]]), torch.tensor([[1.5, 1.0]]))
    assert loss(TrainingStep(seen, frame.target, model, 1, Schedule(1, 1))).item() == pytest.approx(1.5 / 50)


def test_a_share_of_each_image_counts_and_is_always_the_same():
    scene = wall_scene(frames=3, width=300, height=200)
    loss = make(share=0.03).loss
    counted = []
    for frame in scene.train:
        depth = frame.depth.clone().requires_grad_()
        seen = output(depth + 1.0, torch.ones_like(depth))
        term = loss(TrainingStep(seen, frame.target, None, 1, Schedule(1, 1)))
        assert term.item() == pytest.approx(1.0, abs=1e-4)
        (gradient,) = torch.autograd.grad(term, depth)
        counted.append(gradient != 0)
        assert counted[-1].float().mean().item() == pytest.approx(0.03, abs=0.003)
    assert 0.02 < (counted[0] & counted[1]).sum() / counted[0].sum() < 0.045  # drawn for each frame by itself
    # Pixels of several frames, as of another step: the same ones count.
    pixels = torch.randint(200, (5000, 2), generator=torch.Generator().manual_seed(0))
    parts = [frame.target_at(pixels) for frame in scene.train]
    depth = torch.cat([part.depth for part in parts]).requires_grad_()
    seen = concatenate_pixels([output(depth + 1.0, torch.ones_like(depth))])
    term = loss(TrainingStep(seen, concatenate_targets(parts), None, 2, Schedule(2, 2)))
    (gradient,) = torch.autograd.grad(term, depth)
    expected = torch.cat([inside[pixels[:, 1], pixels[:, 0]] for inside in counted])
    assert torch.equal(gradient[:, 0] != 0, expected)
    other = make(share=0.03, seed=1).loss(TrainingStep(seen, concatenate_targets(parts), None, 2, Schedule(2, 2)))
    (gradient,) = torch.autograd.grad(other, depth)
    assert not torch.equal(gradient[:, 0] != 0, expected)


def test_the_mean_square_of_either_image():
    image = torch.zeros(1, 2, 3, dtype=torch.uint8)
    image[0, 0] = torch.tensor([255, 51, 0])
    rgb, coarse = torch.zeros(1, 2, 3), torch.full((1, 2, 3), 0.5)
    seen = RenderOutput(rgb, torch.ones(1, 2), None, {"rgb_coarse": coarse})
    mean = terms.make("mse")(seen, make_frame(image, mask=torch.tensor([[True, False]])))
    assert mean.item() == pytest.approx((1.0 + 0.04) / 3)
    other = terms.make("mse", image="rgb_coarse")
    assert other(seen, make_frame(image)).item() == pytest.approx((0.25 + 0.09 + 0.25 + 3 * 0.25) / 6)
    assert other.loss.wants == {"rgb_coarse"} and terms.make("mse").loss.wants == frozenset()
    assert registry.losses.get("mse").needs == frozenset()
