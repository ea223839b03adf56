"""Growing and pruning anchors, with counters, moments and windows."""

from __future__ import annotations

import math

import pytest
import torch

from coliags_plugin.components import make_component
from coliags_plugin.gaussians import Gaussians, RenderOutput
from coliags_plugin.strategies.parameter_rows import append_rows, keep_rows
from tests.scenes import wall_scene

CHILDREN = 10


def make_field(voxel=2.0):
    node = {"name": "anchors", "geometry_head": "plain", "appearance_head": "plain", "voxel_size": voxel}
    component = make_component("fields", node)
    field = component.target.from_scene(wall_scene(), component.settings, torch.Generator().manual_seed(0))
    adam = {name: torch.optim.Adam(group, lr=0.01) for name, group in field.parameter_groups().items()}
    for optimizer in adam.values():
        for parameter in optimizer.param_groups[0]["params"]:
            parameter.grad = torch.randn(parameter.shape, generator=torch.Generator().manual_seed(1))
        optimizer.step()
    return field, adam


def make_strategy(seed=0, steps=30_000, **options):
    component = make_component("strategies", {"name": "anchor-growth", **options})
    return component.target(component.settings, torch.Generator().manual_seed(seed), steps)


def make_output(slots, gradients, opacity=0.5, visible=None, radii=None, width=200, height=100):
    """Gaussians of the given slots whose centres have the given pixel gradients (x only)."""
    n = len(slots)
    means2d = torch.zeros(n, 2, requires_grad=True)
    means2d.grad = torch.stack([torch.as_tensor(gradients, dtype=torch.float32), torch.zeros(n)], dim=1)
    sources = torch.as_tensor(slots, dtype=torch.long)
    seen = torch.unique(sources // CHILDREN) if visible is None else visible
    opacities = torch.full((n,), float(opacity))
    gaussians = Gaussians(
        torch.zeros(n, 3), torch.zeros(n, 4), torch.ones(n, 3), opacities, torch.zeros(n, 3), sources, seen
    )
    image = torch.zeros(height, width)
    drawn = torch.ones(n) if radii is None else torch.as_tensor(radii)
    return RenderOutput(image[..., None].expand(-1, -1, 3), image, means2d, drawn, gaussians)


def test_counts_only_inside_the_window():
    field, adam = make_field()
    strategy = make_strategy()
    for step in (500, 15_000, 20_000):
        assert strategy.after_backward(step, field, adam, make_output([0], [1.0])) == {}
        assert len(strategy.seen) == 0
    strategy.after_backward(501, field, adam, make_output([0, 11], [0.01, 0.02]))
    assert strategy.seen.nonzero().flatten().tolist() == [0, 1]
    assert strategy.opacity_sum[:2].tolist() == [0.5, 0.5]
    # Pixel gradients times half the width are gradients in normalised image units.
    assert strategy.gradient_sum[[0, 11]].tolist() == pytest.approx([1.0, 2.0])
    assert strategy.drawn[[0, 11]].tolist() == [1.0, 1.0]


def test_growth_ends_at_half_of_a_short_run():
    field, adam = make_field()
    strategy = make_strategy(steps=1600)
    strategy.after_backward(799, field, adam, make_output([0], [1.0]))
    assert strategy.seen[0] == 1
    strategy.after_backward(800, field, adam, make_output([0], [1.0]))
    assert strategy.seen[0] == 1


def test_undrawn_children_and_childless_anchors():
    field, adam = make_field()
    strategy = make_strategy()
    output = make_output([0, 1], [0.01, 0.01], visible=torch.tensor([0, 5]), radii=[3.0, 0.0])
    strategy.after_backward(600, field, adam, output)
    assert strategy.drawn[:2].tolist() == [1.0, 0.0]
    assert strategy.seen[[0, 5]].tolist() == [1.0, 1.0]
    assert strategy.opacity_sum[5] == 0.0


def grow_once(gradient, voxel=2.0, **options):
    """One child, far from every anchor, seen often enough with one gradient; returns what grew.

    The first level keeps half of its candidates by chance; the seed is one that keeps this one.
    """
    field, adam = make_field(voxel)
    with torch.no_grad():
        field.offsets.zero_()
        field.offsets[3, 4] = torch.tensor([0.0, 0.0, 200.0]) / field.scalings[3, :3].exp()
    before = len(field.anchors)
    slots = before * CHILDREN
    seed = next(s for s in range(99) if torch.rand(slots, generator=torch.Generator().manual_seed(s))[34] > 0.5)
    strategy = make_strategy(seed, statistics_from=0, growth_from=0, every=100, min_opacity=0.0, **options)
    strategy._resize(before, CHILDREN, torch.device("cpu"))
    strategy.drawn[34] = 41.0  # one more than 100 * 0.8 * 0.5
    strategy.gradient_sum[34] = 41.0 * gradient
    done = strategy.after_backward(100, field, adam, make_output([0], [0.0]))
    return field, adam, before, done


def test_growth_adds_one_anchor_with_the_parents_feature():
    field, adam, before, done = grow_once(1.0, levels=1, coarsest_cell=1, max_log_scale=None)
    assert done == {"grown": 1, "pruned": 0}
    assert len(field.anchors) == before + 1
    torch.testing.assert_close(field.features[-1], field.features[3])
    assert field.offsets[-1].abs().sum() == 0
    torch.testing.assert_close(field.scalings[-1], torch.full((6,), math.log(2.0)))
    cells = field.anchors[-1] / 2.0
    torch.testing.assert_close(cells, cells.round())
    assert field.anchors[-1, 2] == pytest.approx(220.0, abs=1.0)
    for name in field.anchor_parameters:
        (parameter,) = adam[name].param_groups[0]["params"]
        assert parameter is getattr(field, name)
        moments = adam[name].state[parameter]
        assert moments["exp_avg"].shape == parameter.shape
        assert moments["exp_avg"][-1].abs().sum() == 0
        assert moments["exp_avg"][:-1].abs().sum() > 0


def test_small_gradients_grow_nothing():
    *_, done = grow_once(0.0001, levels=1, coarsest_cell=1)
    assert done["grown"] == 0


def test_occupied_cells_grow_nothing():
    field, adam = make_field()
    with torch.no_grad():
        field.offsets.zero_()  # every child sits on its own anchor
    strategy = make_strategy(statistics_from=0, growth_from=0, min_opacity=0.0)
    strategy._resize(len(field.anchors), CHILDREN, torch.device("cpu"))
    strategy.drawn.fill_(50.0)
    strategy.gradient_sum.fill_(50.0)
    assert strategy.after_backward(100, field, adam, make_output([0], [0.0]))["grown"] == 0
    assert strategy.drawn.sum() == 0  # used candidates start counting anew


def test_coarse_cells_first_then_finer_ones():
    """Many eager children far away: the coarse level opens the way, births have their cell's size."""
    field, adam = make_field()
    with torch.no_grad():
        field.offsets.copy_(torch.rand(field.offsets.shape, generator=torch.Generator().manual_seed(3)) * 60)
    before = len(field.anchors)
    strategy = make_strategy(statistics_from=0, growth_from=0, min_opacity=0.0, max_log_scale=None)
    strategy._resize(before, CHILDREN, torch.device("cpu"))
    strategy.drawn.fill_(50.0)
    strategy.gradient_sum.fill_(50.0)
    grown = strategy.after_backward(100, field, adam, make_output([0], [0.0]))["grown"]
    sizes = field.scalings[before:, 0].exp().detach()
    counts = [int(((sizes - size).abs() < 1e-3).sum()) for size in (32.0, 8.0, 2.0)]
    assert all(counts)
    assert sum(counts) == grown == len(field.anchors) - before
    for size, count in zip((32.0, 8.0, 2.0), counts, strict=True):
        own = field.anchors[before:][(sizes - size).abs() < 1e-3]
        assert len(torch.unique((own / size).round(), dim=0)) == count  # one anchor a cell


def test_faint_anchors_go_and_the_rest_keeps_its_moments():
    field, adam = make_field()
    before = field.features.detach().clone()
    moments = adam["features"].state[field.features]["exp_avg"].clone()
    strategy = make_strategy(statistics_from=0, growth_from=0)
    strategy._resize(len(before), CHILDREN, torch.device("cpu"))
    strategy.seen.fill_(81.0)
    strategy.opacity_sum.fill_(81.0)
    strategy.opacity_sum[[2, 7]] = 81.0 * 0.004
    strategy.seen[9] = 10.0  # too rarely seen to judge
    strategy.opacity_sum[9] = 0.0
    done = strategy.after_backward(100, field, adam, make_output([], [], visible=torch.zeros(0, dtype=torch.long)))
    assert done == {"grown": 0, "pruned": 2}
    kept = [i for i in range(len(before)) if i not in (2, 7)]
    assert torch.equal(field.features.detach(), before[kept])
    assert torch.equal(adam["features"].state[field.features]["exp_avg"], moments[kept])
    assert len(strategy.seen) == len(kept) == len(field.anchors)
    assert strategy.seen[7] == 10.0  # anchor 9, moved up by two, keeps counting
    assert strategy.seen.sum() == 10.0
    assert field.scalings[:, 3:].max() <= 0.05


def test_never_prunes_everything():
    field, adam = make_field()
    strategy = make_strategy(statistics_from=0, growth_from=0)
    strategy._resize(len(field.anchors), CHILDREN, torch.device("cpu"))
    strategy.seen.fill_(100.0)
    count = len(field.anchors)
    output = make_output([], [], visible=torch.zeros(0, dtype=torch.long))
    assert strategy.after_backward(100, field, adam, output)["pruned"] == 0
    assert len(field.anchors) == count


def test_state_round_trip():
    field, adam = make_field()
    strategy, other = make_strategy(), make_strategy()
    strategy.after_backward(600, field, adam, make_output([0, 11], [0.01, 0.02]))
    other.load_state_dict(strategy.state_dict())
    assert all(torch.equal(other.state_dict()[k], v) for k, v in strategy.state_dict().items())


def test_rows_without_an_optimizer_change_too():
    field, adam = make_field()
    del adam["features"]
    count = len(field.features)
    append_rows(field, adam, {"features": torch.ones(2, 32)})
    assert len(field.features) == count + 2
    keep_rows(field, adam, ("features",), torch.arange(count + 2) < 5)
    assert len(field.features) == 5


def test_after_growth_adam_steps_on():
    field, adam, _, _ = grow_once(1.0, levels=1, coarsest_cell=1, max_log_scale=None)
    for name in field.anchor_parameters:
        getattr(field, name).grad = torch.ones_like(getattr(field, name))
        adam[name].step()
        assert torch.isfinite(getattr(field, name)).all()
