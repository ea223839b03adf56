"""Samplers: the frames and pixels of a training step."""

from __future__ import annotations

import pytest
import torch

from coliags_plugin.config.components import make_component
from coliags_plugin.core.scenes import concatenate_targets
from tests.scenes import wall_scene

SIZES = [(7, 5), (4, 3), (6, 6)]


def make(name="pixels", seed=0, **options):
    component = make_component("samplers", {"name": name, **options})
    return component.target(component.settings, SIZES, torch.Generator().manual_seed(seed))


def test_frames_come_whole_and_each_once_per_round():
    sampler = make("frames")
    drawn = [sampler.next() for _ in range(6)]
    assert all(len(draws) == 1 and draws[0].pixels is None for draws in drawn)
    assert sorted(draws[0].frame for draws in drawn[:3]) == sorted(draws[0].frame for draws in drawn[3:]) == [0, 1, 2]


@pytest.mark.parametrize(("pixels", "frames", "counts"), [(10, 3, [3, 3, 4]), (8, 1, [8]), (2, 5, [1, 1])])
def test_pixels_are_shared_between_frames_and_every_one_comes_up(pixels, frames, counts):
    sampler, drawn = make(pixels=pixels, frames=frames), set()
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
