"""Growing and pruning anchors, with counters, moments and windows."""

from __future__ import annotations

import pytest
import torch

from coliags_plugin.config.components import make_component
from coliags_plugin.contracts import Schedule
from coliags_plugin.strategies.densification import one_per_free_cell
from tests.fields.made import make_field
from tests.strategies.steps import after_backward, stepped_optimizers
from tests.strategies.steps import make_output as drawn_output

CHILDREN = 10


def make(appearance="plain"):
    field = make_field("anchors", geometry_head="plain", appearance_head=appearance, voxel_size=2.0)
    return field, stepped_optimizers(field, 0.01)


def make_strategy(steps=30_000, **options):
    component = make_component("strategies", {"name": "anchor-growth", **options})
    return component.target(component.settings, torch.Generator(), Schedule(steps, 30_000), 10.0)


def make_judged(field, drawn=0.0, gradient=0.0, seen=0.0, **options):
    """A strategy, at work from the first step, with these counts of every anchor and child."""
    strategy = make_strategy(statistics_from=0, growth_from=0, **options)
    strategy._resize(len(field.anchors), CHILDREN, torch.device("cpu"))
    for name, value in (("drawn", drawn), ("gradient_sum", gradient), ("seen", seen), ("opacity_sum", seen)):
        getattr(strategy, name).fill_(value)
    return strategy


def make_output(slots, gradients, visible=None, radii=None):
    """Half transparent children of these slots, whose anchors are visible unless others are given."""
    parents = torch.unique(torch.as_tensor(slots, dtype=torch.long) // CHILDREN) if visible is None else visible
    return drawn_output(slots, gradients, radii, parents, 0.5)


def test_counts_only_inside_the_window_and_what_is_drawn():
    field, rows = make()
    strategy, other = make_strategy(), make_strategy()
    assert after_backward(strategy, 500, field, rows, make_output([0], [1.0])) == {} and len(strategy.seen) == 0
    output = make_output([0, 1, 11], [1.0, 9.0, 2.0], visible=torch.tensor([0, 1, 5]), radii=[3.0, 0.0, 3.0])
    after_backward(strategy, 501, field, rows, output)  # child 1 is not drawn, anchor 5 has no children
    assert strategy.seen.nonzero().flatten().tolist() == [0, 1, 5]
    assert strategy.opacity_sum[5] == 0.0 and strategy.opacity_sum[1] == 0.5
    assert strategy.gradient_sum[[0, 11]].tolist() == pytest.approx([1.0, 2.0])
    assert strategy.drawn[[0, 1, 11]].tolist() == [1.0, 0.0, 1.0]
    other.load_state_dict(strategy.state_dict())
    assert all(torch.equal(other.state_dict()[k], v) for k, v in strategy.state_dict().items())


@pytest.mark.parametrize(("steps", "first", "last"), [(1600, 27, 800), (30_000, 500, 15_000), (60_000, 1000, 30_000)])
def test_statistics_keep_their_share_of_the_run(steps, first, last):
    field, rows = make()
    strategy = make_strategy(steps=steps)
    for step, count in ((first, 0), (first + 1, 1), (last - 1, 2), (last, 2), (last + last // 3, 2)):
        after_backward(strategy, step, field, rows, make_output([0], [1.0]))
        assert (strategy.seen.sum() if len(strategy.seen) else 0) == count


@pytest.mark.parametrize(
    ("steps", "plan", "expected"),
    [
        (30_000, "at 134 steps, from 1600 to 14900", range(1600, 14_901, 100)),
        (3000, "at 42 steps, from 160 to 1472", range(160, 1500, 32)),
        (200, "at 3 steps, from 32 to 96", [32, 64, 96]),
        (20, "at 2 steps, from 4 to 8", [4, 8]),
        (12, "at step 4", [4]),
        (2, "neither grows nor prunes anchors: its 2 steps leave no multiple of 4 between steps 0 and 1", []),
    ],
)
def test_the_plan_is_what_happens(steps, plan, expected):
    strategy = make_strategy(steps=steps)
    assert plan in strategy.plan()
    field, rows = make()
    tried = range(0, steps + 1, 50 if steps > 3000 else 8 if steps > 1000 else 1)
    events = [s for s in tried if after_backward(strategy, s, field, rows, make_output([0], [0.0]))]
    assert events == [*expected]


def grow_once(gradient, **options):
    """One child of anchor 3, far from every anchor, drawn often enough with one gradient; returns what grew."""
    field, rows = make()
    with torch.no_grad():
        field.offsets.zero_()
        field.offsets[3, 4] = torch.tensor([0.0, 0.0, 200.0]) / field.scalings[3, :3].exp()
        field.features.copy_(torch.rand(field.features.shape, generator=torch.Generator().manual_seed(2)))
    before = len(field.anchors)
    strategy = make_judged(field, min_opacity=0.0, **options)
    strategy.drawn[34] = 41.0  # one more than 100 * 0.8 * 0.5
    strategy.gradient_sum[34] = 41.0 * gradient
    changes = after_backward(strategy, 100, field, rows, make_output([0], [0.0]))
    return field, rows, before, changes


def test_a_birth_stands_where_its_candidate_stood_and_looks_like_its_parent_and_adam_moves_it_no_faster():
    field, rows, before, changes = grow_once(1.0, levels=1)
    assert changes == {"grown": 1, "pruned": 0}
    assert len(field.anchors) == before + 1
    torch.testing.assert_close(field.anchors[-1], field.child_positions()[3, 4])
    assert torch.equal(field.features[-1], field.features[3])
    assert field.offsets[-1].abs().sum() == 0
    assert (field.scalings[-1] <= torch.minimum(field.scalings[3], field.spacing.log())).all()
    for name in field.row_parameters:
        parameter = getattr(field, name)
        assert rows.adam[name].param_groups[0]["params"] == [parameter]
        moments = rows.adam[name].state[parameter]
        assert moments["exp_avg"].shape == parameter.shape == parameter.grad.shape
        assert moments["exp_avg"][:-1].abs().sum() > 0
        assert moments["exp_avg"][-1].abs().sum() == parameter.grad[-1].abs().sum() == 0
        assert torch.equal(moments["exp_avg_sq"][-1], moments["exp_avg_sq"][3])
        values = parameter.detach().clone()
        rows.adam[name].step()  # nothing is known yet that could move it
        assert torch.equal(parameter[-1], values[-1])
        assert not torch.equal(parameter[:-1], values[:-1])


@pytest.mark.parametrize(("thresholds", "grown"), [(1.05, 0), (2.05, 1), (4.05, 1)])
def test_finer_cells_ask_for_larger_gradients(thresholds, grown):
    """A child beside an anchor, in its cell but not in its quarter: the second level's, from two thresholds on."""
    field, rows = make()
    strategy = make_judged(field, min_opacity=0.0)
    spacing = field.spacing.item()
    center = torch.tensor([0.0, 0.0, 100 * spacing])
    side = torch.tensor([0.2 * spacing, 0.0, 0.0])
    with torch.no_grad():
        field.offsets.zero_()
        field.anchors[7] = center - side
        field.offsets[7, 0] = 2 * side / field.scalings[7, :3].exp()
    strategy.drawn[70] = 41.0
    strategy.gradient_sum[70] = 41.0 * 0.0002 * thresholds
    assert after_backward(strategy, 100, field, rows, make_output([0], [0.0]))["grown"] == grown
    if grown:
        torch.testing.assert_close(field.anchors[-1], center + side)
        assert (field.scalings[-1].exp() <= 0.2501 * spacing).all()


def test_small_gradients_and_cells_below_a_quarter_of_a_voxel_grow_nothing():
    assert grow_once(1.0, levels=1, finest_cell=0.9)[3]["grown"] == 1
    assert grow_once(1.0, levels=1, finest_cell=9.0)[3]["grown"] == grow_once(0.00019)[3]["grown"] == 0


def test_occupied_cells_grow_nothing():
    field, rows = make()
    with torch.no_grad():
        field.offsets.zero_()  # every child sits on its own anchor
    strategy = make_judged(field, drawn=50.0, gradient=50.0, min_opacity=0.0)
    assert after_backward(strategy, 100, field, rows, make_output([0], [0.0]))["grown"] == 0
    assert strategy.drawn.sum() == 0  # used candidates start counting anew


def test_an_event_adds_at_most_one_anchor_for_so_many_pixels():
    field, rows = make()
    with torch.no_grad():
        field.offsets.copy_(torch.rand(field.offsets.shape, generator=torch.Generator().manual_seed(3)) * 60)
    strategy = make_judged(field, drawn=50.0, gradient=50.0, min_opacity=0.0, pixels_per_birth=1000)
    # 200 x 100 pixels
    assert after_backward(strategy, 100, field, rows, make_output([0], [0.0]))["grown"] == 20


def test_strongest_candidate_of_each_free_cell_strongest_cells_first():
    anchors = torch.tensor([[0.0, 0.0, 0.0]])
    positions = torch.tensor([[0.1, 0, 0], [2.1, 0, 0], [1.9, 0, 0], [4.0, 0, 0], [6.2, 0, 0], [5.8, 0, 0]])
    gradients = torch.tensor([9.0, 1.0, 3.0, 5.0, 4.0, 2.0])
    born = one_per_free_cell(anchors, positions, gradients, 2.0, 10)
    assert born.tolist() == [3, 4, 2]  # cells of 4, 6 and 2; that of 0 is taken
    assert one_per_free_cell(anchors, positions, gradients, 2.0, 2).tolist() == [3, 4]
    assert len(one_per_free_cell(anchors, positions[:0], gradients[:0], 2.0, 2)) == 0


@torch.no_grad()
def test_births_have_their_parents_normal_and_survivors_keep_theirs():
    head = {"name": "attenuated", "head": "plain", "incidence_exponent": 0.3}
    field, rows = make(head)
    field.normals = torch.nn.functional.normalize(torch.rand(field.normals.shape), dim=1)
    before = field.normals.clone()
    strategy = make_strategy(statistics_from=0, growth_from=0)
    far = torch.tensor([[0.0, 0.0, 200.0]])
    strategy._add(field, rows, far, torch.tensor([3]), 1.0)
    assert torch.equal(field.normals, torch.cat([before, before[3:4]]))
    strategy._resize(len(field.anchors), CHILDREN, torch.device("cpu"))
    strategy.seen.fill_(81.0)
    strategy.opacity_sum.fill_(81.0)
    strategy.opacity_sum[2] = 0.0
    assert strategy._prune(field, rows, CHILDREN) == 1
    assert torch.equal(field.normals, torch.cat([before[:2], before[3:], before[3:4]]))


def test_base_scales_are_capped_in_spacings():
    field, rows = make()
    with torch.no_grad():
        field.scalings[5, 3:] = 9.0
    strategy = make_strategy(statistics_from=0, growth_from=0)
    before = field.scalings.detach().clone()
    after_backward(strategy, 100, field, rows, make_output([0], [0.0]))
    torch.testing.assert_close(field.scalings[5, 3:].exp(), torch.full((3,), 4 * field.spacing.item()))
    before[5, 3:] = field.scalings[5, 3:].detach()
    assert torch.equal(field.scalings.detach(), before)


def test_faint_anchors_go_and_the_rest_keeps_its_moments():
    field, rows = make()
    before = field.features.detach().clone()
    moments = rows.adam["features"].state[field.features]["exp_avg"].clone()
    strategy = make_judged(field, seen=81.0)
    strategy.opacity_sum[[2, 7]] = 81.0 * 0.004
    strategy.seen[9] = 10.0  # too rarely seen to judge
    strategy.opacity_sum[9] = 0.0
    changes = after_backward(strategy, 100, field, rows, make_output([], [], visible=torch.zeros(0, dtype=torch.long)))
    assert changes == {"grown": 0, "pruned": 2}
    kept = [i for i in range(len(before)) if i not in (2, 7)]
    assert torch.equal(field.features.detach(), before[kept])
    assert torch.equal(rows.adam["features"].state[field.features]["exp_avg"], moments[kept])
    assert len(strategy.seen) == len(kept) == len(field.anchors)
    assert strategy.seen[7] == 10.0  # anchor 9, moved up by two, keeps counting
    assert strategy.seen.sum() == 10.0
    strategy.seen.fill_(100.0)
    strategy.opacity_sum.zero_()  # never all of them
    output = make_output([], [], visible=torch.zeros(0, dtype=torch.long))
    assert after_backward(strategy, 200, field, rows, output)["pruned"] == 0 and len(field.anchors) == len(kept)
