"""Depth at single points: sampling against torch's own, what counts, and training with it."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import pytest
import torch
from torch.nn.functional import grid_sample, huber_loss

from coliags_plugin.config.method_config import load_method
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scenes import SparseDepth
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.engine.trainer import Trainer
from tests.losses import terms
from tests.losses.terms import make_output
from tests.scenes import SMALL, wall_scene
from tests.scenes import plain_frame as make_frame

HEIGHT, WIDTH = 7, 9


make = partial(terms.make, "sparse-depth")


@pytest.fixture
def rendered():
    return (20 + 10 * torch.rand(HEIGHT, WIDTH, dtype=torch.float64)).requires_grad_()


@pytest.fixture
def points():
    """Two hundred places, and their depths."""
    places = torch.rand(200, 2, dtype=torch.float64) * torch.tensor([WIDTH, HEIGHT])
    return places, 20 + 10 * torch.rand(200, dtype=torch.float64)


@pytest.fixture
def case():
    """The loss of a rendered depth at points."""

    def term(rendered, pixels, depth, alpha=None, mask=None, kind="depth_expected", **options):
        height, width = rendered.shape
        output = make_output(torch.zeros(height, width, 3), **{kind: rendered})
        if alpha is not None:
            output = replace(output, alpha=alpha)
        frame = make_frame(torch.zeros(height, width, 3, dtype=torch.uint8), mask=mask)
        points = SparseDepth(torch.as_tensor(pixels), torch.as_tensor(depth))
        return make(depth=kind, **options)(output, replace(frame, sparse_depth=points))

    return term


@pytest.mark.parametrize("huber", [None, 2.5])
def test_sampling_is_torchs_with_pixel_centres_at_one_half(case, rendered, points, huber):
    pixels, depth = points
    size = torch.tensor([WIDTH, HEIGHT])
    grid = (2 * pixels / size - 1)[None, None]
    sampled = grid_sample(rendered[None, None], grid, padding_mode="border", align_corners=False)[0, 0, 0]
    # Huber's loss is scaled to a slope of one.
    expected = huber_loss(sampled, depth, delta=huber) / huber if huber else (sampled - depth).abs().mean()
    term = case(rendered, pixels, depth, huber=huber)
    assert term.item() == pytest.approx(expected.item(), abs=1e-12)
    (gradient,) = torch.autograd.grad(expected, rendered, retain_graph=True)
    term.backward()
    torch.testing.assert_close(rendered.grad, gradient)


def test_relative_differences_need_no_unit(case, rendered, points):
    pixels, depth = points
    depth[3] = 0.0  # no point of a surface
    kept = torch.arange(len(depth)) != 3
    for huber in (None, 0.05):
        found = [
            case(unit * rendered, pixels, unit * depth, relative=True, huber=huber).item() for unit in (1.0, 1e-3, 50.0)
        ]
        pairs = zip(pixels[kept], depth[kept], strict=True)
        each = [case(rendered / z, [pixel.tolist()], [1.0], huber=huber).item() for pixel, z in pairs]
        assert found == pytest.approx([sum(each) / len(each)] * 3, rel=1e-6)


def test_a_point_on_a_pixel_centre_is_that_pixel(case, rendered):
    term = case(rendered, [[3.5, 2.5]], [0.0])
    term.backward()
    assert term.item() == rendered[2, 3].item()
    assert rendered.grad.nonzero().tolist() == [[2, 3]]


@pytest.mark.parametrize("size", [(HEIGHT, WIDTH), (1, 1), (1, 6), (5, 1)])
@pytest.mark.parametrize("place", [(0.0, 0.0), (1.0, 1.0), (0.02, 0.98), (0.999, 0.0)])
def test_edges_of_the_image_take_the_outermost_pixels(case, size, place):
    rendered = torch.arange(1.0, 1.0 + size[0] * size[1]).reshape(size)
    pixel = (place[0] * size[1], place[1] * size[0])
    row, column = (0 if share < 0.5 else -1 for share in place[::-1])
    assert case(rendered, [pixel], [0.0]).item() == pytest.approx(rendered[row, column].item())


@pytest.mark.parametrize("outside", [(-0.1, 3.0), (4.0, 7.1), (torch.nan, 2.0)])
def test_points_outside_do_not_count(case, rendered, outside):
    inside = case(rendered, [[4.0, 3.0]], [25.0])
    assert case(rendered, [[4.0, 3.0], outside], [25.0, 1e9]) == inside


@pytest.mark.parametrize("spoilt", ["alpha", "mask", "nan"])
def test_a_point_counts_only_where_all_its_pixels_show_something(case, rendered, spoilt):
    pixels, depth = [[2.0, 2.0], [6.5, 4.5], [6.5, 5.0]], [0.0, 0.0, 0.0]
    alpha, mask = torch.ones(HEIGHT, WIDTH), torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    values = rendered.detach().clone()
    # One of the four pixels around the first point; and a neighbour of weight 0 of the second.
    for row, column in ((1, 2), (5, 6)):
        values[row, column] = torch.nan
        alpha[row, column] = 0.0 if spoilt == "alpha" else 1.0
        mask[row, column] = spoilt != "mask"
    values.requires_grad_()
    term = case(values, pixels, depth, alpha, mask)
    term.backward()
    assert term.item() == pytest.approx(values[4, 6].item())
    assert values.grad.nonzero().tolist() == [[4, 6]]


def test_nothing_to_compare_is_zero_and_keeps_the_graph(case, rendered):
    frame = make_frame(torch.zeros(HEIGHT, WIDTH, 3, dtype=torch.uint8))
    output = make_output(torch.zeros(HEIGHT, WIDTH, 3), depth_expected=rendered)
    empty = SparseDepth(torch.zeros(0, 2), torch.zeros(0))
    terms = [make()(output, frame), make()(output, replace(frame, sparse_depth=empty))]
    terms.append(case(rendered, [[3.0, 3.0]], [5.0], alpha=torch.zeros(HEIGHT, WIDTH)))
    for term in terms:
        assert term.item() == 0.0
        assert term.dtype == rendered.dtype
        (gradient,) = torch.autograd.grad(term, rendered)
        assert not gradient.any()


def test_a_bounded_point_pulls_less_the_farther_it_is(case, rendered):
    """x becomes b (1 - exp(-x / b)): its slope is exp(-x / b), whatever its value."""
    value = rendered[2, 3].item()
    for share in (0.01, 0.5, 3.0, 1e4):
        depth = value / (1.0 + share)
        term = case(rendered, [[3.5, 2.5]], [depth], relative=True, bound=0.1)
        assert term.item() == pytest.approx(0.1 * (1 - math.exp(-share / 0.1)), rel=1e-5)
        (gradient,) = torch.autograd.grad(term, rendered)
        assert gradient[2, 3].item() == pytest.approx(math.exp(-share / 0.1) / depth, rel=1e-5, abs=1e-12)


def test_inverse_depth_is_inverted_and_emptiness_left_out(case):
    inverse = torch.tensor([[0.05, 0.0], [0.04, 0.02]], requires_grad=True)
    term = case(inverse, [[0.5, 0.5], [1.5, 0.5]], [18.0, 18.0], kind="inverse_depth_accumulated")
    term.backward()
    assert term.item() == pytest.approx(2.0)
    assert inverse.grad.tolist() == [[pytest.approx(-400.0), 0.0], [0.0, 0.0]]


# Training with it

SPARSE = ("losses.depth=null", "losses.sparse_depth={name: sparse-depth, weight: 1.0}")


def sparse_scene():
    """The wall without dense depth, its depth known at a grid of places instead."""
    scene = wall_scene()
    for name in ("train", "test"):
        frames = scene.train if name == "train" else scene.test_sets["test"]
        for index, frame in enumerate(frames):
            row, column = torch.meshgrid(torch.arange(1, 24, 3), torch.arange(1, 32, 3), indexing="ij")
            pixels = torch.stack([column, row], -1).reshape(-1, 2) + 0.5
            sparse = SparseDepth(pixels, frame.depth[row, column].reshape(-1))
            frames[index] = replace(frame, depth=None, sparse_depth=sparse)
    return scene


def trainer(folder, scene, overrides=SPARSE):
    method = load_method("coliags", [*SMALL, *overrides])
    return Trainer(method, scene, "wall", RunFolder(folder), 0, torch.device("cpu"))


def test_a_scene_without_such_depth_is_refused_before_training(tmp_path):
    for scene, overrides, message in (
        (wall_scene(), SPARSE, r"'sparse_depth' needs depth at single points.*losses\.sparse_depth=null"),
        (sparse_scene(), SPARSE[1:], r"'depth' needs depth, .*losses\.depth=null, train .*coliags-sparse-depth on its"),
    ):
        with pytest.raises(InputError, match=message):
            trainer(tmp_path / "run", scene, overrides)
