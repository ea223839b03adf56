"""Rates, rows that come and go, and values that are replaced, together with Adam's moments; samplers of steps."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from coliags_plugin.config.method_config import OptimizerSettings
from coliags_plugin.core.components import make_component
from coliags_plugin.core.scenes import concatenate_targets
from coliags_plugin.engine.model import Model
from coliags_plugin.engine.optimizers import Optimizers
from tests.scenes import wall_scene


class Rows(nn.Module):
    """A field of nothing but two parameters with rows, one of them inside a part."""

    def __init__(self, count=5):
        super().__init__()
        self.points = nn.Parameter(torch.randn(count, 3, generator=torch.Generator().manual_seed(0)))
        self.part = nn.Module()
        self.part.sizes = nn.Parameter(torch.ones(count))

    def parameter_groups(self):
        return {"points": [self.points], "sizes": [self.part.sizes]}


def make(**options):
    """A field, and its optimizers before their first step."""
    field = Rows()
    settings = {"points": OptimizerSettings(lr=0.1, **options), "sizes": OptimizerSettings(lr=0.01)}
    return field, Optimizers(Model(field, None, {}), settings, 100, 1.0)


@pytest.fixture
def stepped():
    """Optimizers after three steps, with gradients that have not been used."""
    field, optimizers = make()
    for step in (1, 2, 3, None):
        generator = torch.Generator().manual_seed(step or 0)
        field.points.grad = torch.randn(5, 3, generator=generator)
        field.part.sizes.grad = torch.randn(5, generator=generator)
        if step:
            optimizers.step(step)
    return field, optimizers


def moments(optimizers, group):
    (parameter,) = optimizers.adam[group].param_groups[0]["params"]
    return optimizers.adam[group].state[parameter]


def test_new_rows_have_no_history_but_their_parents_mean_square(stepped):
    field, optimizers = stepped
    points, gradient = field.points.detach().clone(), field.points.grad.clone()
    squares, new = moments(optimizers, "points")["exp_avg_sq"].clone(), torch.full((2, 3), 7.0)
    optimizers.add_rows({"points": new})
    assert torch.equal(field.points.detach(), torch.cat([points, new]))
    assert torch.equal(field.points.grad, torch.cat([gradient, torch.zeros(2, 3)]))
    assert torch.equal(moments(optimizers, "points")["exp_avg_sq"], torch.cat([squares, torch.zeros(2, 3)]))
    assert moments(optimizers, "points")["step"].item() == 3
    assert optimizers.adam["points"].param_groups[0]["params"] == [field.points]
    assert len(field.part.sizes) == 5
    optimizers.add_rows({"points": new}, torch.tensor([4, 1]))
    assert torch.equal(moments(optimizers, "points")["exp_avg_sq"][7:], squares[[4, 1]])
    assert not moments(optimizers, "points")["exp_avg"][5:].any()


def test_rows_that_stay_keep_everything(stepped):
    field, optimizers = stepped
    keep = torch.tensor([True, False, True, True, False])
    points, sizes, gradient = field.points.detach()[keep], field.part.sizes.detach()[keep], field.part.sizes.grad[keep]
    momentum = moments(optimizers, "sizes")["exp_avg"][keep]
    optimizers.keep_rows(("points", "sizes"), keep)
    assert torch.equal(field.points.detach(), points) and torch.equal(field.part.sizes.detach(), sizes)
    assert torch.equal(field.part.sizes.grad, gradient)
    assert torch.equal(moments(optimizers, "sizes")["exp_avg"], momentum)


def test_replaced_values_start_anew(stepped):
    field, optimizers = stepped
    parameter = field.part.sizes
    optimizers.replace_values("sizes", torch.arange(5.0))
    assert field.part.sizes is parameter and parameter.tolist() == [0, 1, 2, 3, 4]
    assert not moments(optimizers, "sizes")["exp_avg"].any() and not moments(optimizers, "sizes")["exp_avg_sq"].any()
    assert moments(optimizers, "points")["exp_avg"].any()


def test_before_the_first_step_there_are_no_moments_to_cut():
    field, optimizers = make()
    optimizers.add_rows({"points": torch.zeros(1, 3)}, torch.tensor([0]))
    optimizers.replace_values("sizes", torch.arange(5.0))
    optimizers.keep_rows(["points"], torch.arange(6) > 0)
    assert len(field.points) == 5


def test_beta2_sets_how_long_squared_gradients_are_remembered():
    """Without a memory of squares, bias-corrected Adam divides the momentum by the present gradient's size."""
    field, optimizers = make(beta2=0.0)
    before = field.points.detach().clone()
    for step, gradient in ((1, 4.0), (2, 1.0)):
        field.points.grad = torch.full((5, 3), gradient)
        optimizers.step(step)
    second = (0.9 * 0.4 + 0.1 * 1.0) / (1 - 0.9**2)
    torch.testing.assert_close(field.points.detach(), before - 0.1 * (1.0 + second))


# Samplers: the frames and pixels of a training step

SIZES = [(7, 5), (4, 3), (6, 6)]


def make_sampler(name="pixels", seed=0, **options):
    component = make_component("samplers", {"name": name, **options})
    return component.target(component.settings, SIZES, torch.Generator().manual_seed(seed))


def test_frames_come_whole_and_each_once_per_round():
    sampler = make_sampler("frames")
    drawn = [sampler.next() for _ in range(6)]
    assert all(len(draws) == 1 and draws[0].pixels is None for draws in drawn)
    assert sorted(draws[0].frame for draws in drawn[:3]) == sorted(draws[0].frame for draws in drawn[3:]) == [0, 1, 2]


@pytest.mark.parametrize(("pixels", "frames", "counts"), [(10, 3, [3, 3, 4]), (8, 1, [8]), (2, 5, [1, 1])])
def test_pixels_are_shared_between_frames_and_every_one_comes_up(pixels, frames, counts):
    sampler, drawn = make_sampler(pixels=pixels, frames=frames), set()
    for _ in range(600):
        draws = sampler.next()
        assert sorted(len(draw.pixels) for draw in draws) == sorted(counts)
        drawn |= {(draw.frame, *pixel) for draw in draws for pixel in draw.pixels.tolist()}
    assert drawn == {
        (index, x, y) for index, (width, height) in enumerate(SIZES) for x in range(width) for y in range(height)
    }


def test_targets_at_pixels():
    frames = wall_scene().train[:2]
    pixels = torch.tensor([[3, 1], [30, 20]])
    target = frames[0].target_at(pixels)
    assert target.image.shape == (2, 1, 3) and target.depth.shape == (2, 1)
    assert torch.equal(target.image[1, 0], frames[0].image[20, 30])
    assert target.depth[0, 0] == frames[0].depth[1, 3]
    both = concatenate_targets([target, frames[1].target_at(pixels)])
    assert both.image.shape == (4, 1, 3) and both.name == "0001, 0002"
    assert both.mask is None and both.depth[2, 0] == frames[1].depth[1, 3]
