"""Densification: what is cloned, split, grown, pruned and reset, and when; with counters, moments and windows."""

from __future__ import annotations

import math
from functools import partial

import pytest
import torch

from coliags_plugin.config.method_config import OptimizerSettings
from coliags_plugin.contracts import Schedule, TrainingStep
from coliags_plugin.core.components import make_component
from coliags_plugin.core.gaussians import Gaussians, rotation_matrices
from coliags_plugin.core.render_output import RenderOutput, Splats
from coliags_plugin.engine.model import Model
from coliags_plugin.engine.optimizers import Optimizers
from coliags_plugin.strategies.densification import one_per_free_cell
from tests.fields.made import make_field

CHILDREN = 10


def stepped_optimizers(field, lr):
    """Optimizers of a field that have taken one step along random gradients, which are still there."""
    settings = {name: OptimizerSettings(lr=lr) for name in field.parameter_groups()}
    rows = Optimizers(Model(field, None, {}), settings, 100, 1.0)
    for optimizer in rows.adam.values():
        for parameter in optimizer.param_groups[0]["params"]:
            parameter.grad = torch.randn(parameter.shape, generator=torch.Generator().manual_seed(1))
        optimizer.param_groups[0]["lr"] = lr
        optimizer.step()
    return rows


def after_backward(strategy, step, field, rows, output):
    """Changes by a strategy after ``backward`` of a step with this output."""
    return strategy.after_backward(TrainingStep(output, None, rows.model, step, strategy.schedule), rows)


def make_output(slots, gradients, radii=None, visible=None, opacity=1.0, width=200, height=100):
    """Gaussians of these slots whose projected centres have these gradients along x, in normalised image units."""
    count = len(slots)
    means2d = torch.zeros(count, 2, requires_grad=True)
    means2d.grad = torch.stack([torch.as_tensor(gradients) / (0.5 * width), torch.zeros(count)], dim=1)
    sources = torch.as_tensor(slots, dtype=torch.long)
    none, opacities = torch.zeros(count, 3), torch.full((count,), opacity)
    seen = sources if visible is None else visible
    gaussians = Gaussians(none, torch.zeros(count, 4), none, opacities, none, sources, seen)
    image = torch.zeros(height, width)
    drawn = torch.ones(count) if radii is None else torch.as_tensor(radii)
    return RenderOutput(image[..., None].expand(-1, -1, 3), image, None, splats=Splats(gaussians, means2d, drawn))


def make_strategy(name, steps=30_000, **options):
    component = make_component("strategies", {"name": name, **options})
    return component.target(component.settings, torch.Generator().manual_seed(0), Schedule(steps, 30_000), 10.0)


make_density, make_growth = (partial(make_strategy, name) for name in ("adaptive-density", "anchor-growth"))


def make_gaussians(**options):
    field = make_field("gaussians", **options)
    with torch.no_grad():
        field.opacities.fill_(0.0)
        field.scales.fill_(math.log(0.05))  # small: below 0.01 of the extent
    return field, stepped_optimizers(field, 0.0)


def make_anchors(appearance="plain"):
    field = make_field("anchors", geometry_head="plain", appearance_head=appearance, voxel_size=2.0)
    return field, stepped_optimizers(field, 0.01)


PLANS = [
    ("adaptive-density", 30_000, "at 144 steps, from 600 to 14900, and resets opacities at 4 steps, from 3000 to 12000",
     range(600, 14_901, 100)),
    ("adaptive-density", 3000, "at 45 steps, from 64 to 1472, and resets opacities at 4 steps, from 300 to 1200",
     range(64, 1500, 32)),
    ("adaptive-density", 1999, "at 30 steps, from 64 to 992, and resets opacities at 4 steps, from 200 to 800",
     range(64, 999, 32)),
    ("adaptive-density", 1990, "and resets opacities never", range(64, 995, 32)),
    ("adaptive-density", 20, "at 2 steps, from 4 to 8, and resets opacities never", [4, 8]),
    ("adaptive-density", 12, "at step 4, and resets opacities never", [4]),
    ("adaptive-density", 2, "densifies nor prunes: its 2 steps leave no multiple of 4 between steps 0 and 1", []),
    ("anchor-growth", 30_000, "at 134 steps, from 1600 to 14900", range(1600, 14_901, 100)),
    ("anchor-growth", 3000, "at 42 steps, from 160 to 1472", range(160, 1500, 32)),
    ("anchor-growth", 200, "at 3 steps, from 32 to 96", [32, 64, 96]),
    ("anchor-growth", 20, "at 2 steps, from 4 to 8", [4, 8]),
    ("anchor-growth", 12, "at step 4", [4]),
    ("anchor-growth", 2, "grows nor prunes anchors: its 2 steps leave no multiple of 4 between steps 0 and 1", []),
]  # fmt: skip


@pytest.mark.parametrize(("name", "steps", "plan", "expected"), PLANS)
def test_the_plan_is_what_happens(name, steps, plan, expected):
    strategy, (field, rows) = make_strategy(name, steps), make_anchors() if "anchor" in name else make_gaussians()
    assert plan in strategy.plan()
    output = half_transparent if "anchor" in name else make_output
    every = 50 if steps > 3000 else 8 if steps > 1000 else 1
    tried = range(every, steps + 1, every)
    assert [s for s in tried if after_backward(strategy, s, field, rows, output([0], [0.0]))] == [*expected]


# Explicit Gaussians


def test_small_ones_are_cloned():
    field, rows = make_gaussians()
    strategy, before = make_density(), field.means.detach().clone()
    done = after_backward(strategy, 600, field, rows, make_output([3, 7, 9], [0.0003, 0.0001, 0.0002]))
    assert done == {"grown": 2, "pruned": 0}
    assert torch.equal(field.means.detach(), torch.cat([before, before[[3, 9]]]))
    for name in field.row_parameters:
        assert torch.equal(getattr(field, name)[-2:], getattr(field, name)[[3, 9]])
        assert rows.adam[name].param_groups[0]["params"] == [getattr(field, name)]
    assert not rows.adam["means"].state[field.means]["exp_avg"][-2:].any()


def test_large_ones_are_split_into_two_smaller_within_them():
    field, rows = make_gaussians()
    with torch.no_grad():
        field.scales[5] = torch.tensor([0.5, 0.1, 0.1]).log()
        field.quats[5] = quat = torch.tensor([math.cos(math.pi / 4), 0.0, 0.0, math.sin(math.pi / 4)])  # x becomes y
    center, count = field.means[5].detach().clone(), len(field.means)
    strategy = make_density()
    assert after_backward(strategy, 600, field, rows, make_output([5], [0.001]))["grown"] == 1
    assert len(field.means) == count + 1  # two came, one went
    torch.testing.assert_close(field.scales[-2:].exp(), torch.tensor([[0.5, 0.1, 0.1]] * 2) / 1.6)
    assert not (field.means == center).all(dim=1).any()
    shifts = strategy._shifts(torch.tensor([[0.5, 0.1, 0.1]] * 600).log(), quat.expand(600, 4))
    # The parts are drawn from the Gaussian that they replace.
    torch.testing.assert_close(shifts.std(0), torch.tensor([0.1, 0.5, 0.1]), rtol=0.12, atol=0)
    torch.testing.assert_close(shifts.mean(0), torch.zeros(3), rtol=0, atol=0.06)


def test_faint_ones_go_and_after_the_first_reset_oversized_ones_too():
    field, rows = make_gaussians()
    with torch.no_grad():
        field.opacities[2] = -6.0  # 0.0025
        field.scales[4] = math.log(1.1)  # above a tenth of the extent
    strategy, count = make_density(), len(field.means)
    early = make_output([4, 6], [0.0, 0.0], radii=[3.0, 21.0])
    assert after_backward(strategy, 600, field, rows, early) == {"grown": 0, "pruned": 1}
    late = make_output([4, 6], [0.0, 0.0], radii=[3.0, 21.0])
    assert after_backward(strategy, 3100, field, rows, late)["pruned"] == 2  # rows 3 and 6 as they are counted now
    assert len(field.means) == count - 3


def test_opacities_are_reset_and_adam_forgets_them():
    field, rows = make_gaussians()
    with torch.no_grad():
        field.opacities[1] = -5.0  # 0.0067: below the reset, above the pruning
    strategy = make_density()
    after_backward(strategy, 3000, field, rows, make_output([0], [0.0]))
    opacities = field.opacities.sigmoid()
    assert opacities[:2].tolist() == pytest.approx([0.01, 0.006693], rel=1e-4)
    state = rows.adam["opacities"].state[field.opacities]
    assert not state["exp_avg"].any() and not state["exp_avg_sq"].any()
    assert rows.adam["means"].state[field.means]["exp_avg"].any()


def test_statistics_are_means_over_the_views_that_draw():
    field, rows = make_gaussians()
    strategy = make_density()
    for gradient, radius in ((0.0003, 2.0), (0.00005, 2.0), (0.9, 0.0)):
        after_backward(strategy, 599, field, rows, make_output([8], [gradient], radii=[radius]))
    assert strategy.drawn[8] == 2.0
    assert (strategy.gradient_sum[8] / strategy.drawn[8]).item() == pytest.approx(0.000175)
    other = make_density()
    other.load_state_dict(strategy.state_dict())
    assert torch.equal(other.gradient_sum, strategy.gradient_sum)
    assert after_backward(other, 600, field, rows, make_output([8], [0.0]))["grown"] == 0


def test_parts_spread_along_the_normal_by_a_share_and_those_of_surfels_stay_in_their_planes():
    quats = torch.nn.functional.normalize(torch.randn(200, 4, generator=torch.Generator().manual_seed(2)), dim=1)
    axes = rotation_matrices(quats).mT

    def along(scales, **options):
        shifts = make_density(**options)._shifts(torch.tensor([scales] * 200).log(), quats)
        return (axes @ shifts[..., None]).squeeze(-1)

    expected = along([0.5, 0.2, 0.1]) * torch.tensor([1.0, 1.0, 0.1])
    torch.testing.assert_close(along([0.5, 0.2, 0.1], split_normal_share=0.1), expected, rtol=1e-4, atol=1e-6)
    surfels = along([0.5, 0.01], split_normal_share=0.1)
    torch.testing.assert_close(surfels[:, 2], torch.zeros(200), rtol=0, atol=1e-6)
    torch.testing.assert_close(surfels[:, :2].std(0), torch.tensor([0.5, 0.01]), rtol=0.15, atol=0)


@pytest.mark.parametrize(
    ("faint", "prune_above", "pruned"), [(slice(2, 3), 10_000, 0), (slice(2, 3), 0, 1), (slice(None), 0, 0)]
)
def test_prunes_only_where_enough_would_stay_and_never_everything(faint, prune_above, pruned):
    field, rows = make_gaussians()
    with torch.no_grad():
        field.opacities[faint] = -9.0
    count, strategy = len(field.means), make_density(prune_above=prune_above)
    assert after_backward(strategy, 600, field, rows, make_output([3], [0.0]))["pruned"] == pruned
    assert len(field.means) == count - pruned


def test_reference_normals_follow_their_gaussians():
    (field, rows), strategy = make_gaussians(normal_neighbours=10), make_density()
    with torch.no_grad():
        field.scales[5] = math.log(0.5)
        field.opacities[2] = -6.0
        marks = torch.arange(len(field.means), dtype=torch.float32)
        field.references.of_rows[:, 0] = marks
        field.references.normals[:, 0] = marks
    after_backward(strategy, 600, field, rows, make_output([3, 5], [0.1, 0.1]))
    count = len(marks)
    kept = [row for row in range(count) if row not in (2, 5)]
    # Cloned from 3, and two parts of 5, whose nearest initial points lie around it.
    assert field.references.of_rows[: count - 2, 0].tolist() == kept
    assert field.references.of_rows[count - 2, 0] == 3
    nearest = torch.cdist(field.means[-2:].detach(), field.references.points).argmin(1)
    assert field.references.of_rows[-2:, 0].tolist() == nearest.tolist()
    assert len(field.references.of_rows) == len(field.means)


# Anchors


def make_judged(field, drawn=0.0, gradient=0.0, seen=0.0, **options):
    """A strategy, at work from the first step, with these counts of every anchor and child."""
    strategy = make_growth(statistics_from=0, growth_from=0, **options)
    strategy._resize(len(field.anchors), CHILDREN, torch.device("cpu"))
    for name, value in (("drawn", drawn), ("gradient_sum", gradient), ("seen", seen), ("opacity_sum", seen)):
        getattr(strategy, name).fill_(value)
    return strategy


def half_transparent(slots, gradients, visible=None, radii=None):
    """Half transparent children of these slots, whose anchors are visible unless others are given."""
    parents = torch.unique(torch.as_tensor(slots, dtype=torch.long) // CHILDREN) if visible is None else visible
    return make_output(slots, gradients, radii, parents, 0.5)


def test_counts_only_inside_the_window_and_what_is_drawn():
    field, rows = make_anchors()
    strategy, other = make_growth(), make_growth()
    assert after_backward(strategy, 500, field, rows, half_transparent([0], [1.0])) == {} and len(strategy.seen) == 0
    output = half_transparent([0, 1, 11], [1.0, 9.0, 2.0], visible=torch.tensor([0, 1, 5]), radii=[3.0, 0.0, 3.0])
    after_backward(strategy, 501, field, rows, output)  # child 1 is not drawn, anchor 5 has no children
    assert strategy.seen.nonzero().flatten().tolist() == [0, 1, 5]
    assert strategy.opacity_sum[5] == 0.0 and strategy.opacity_sum[1] == 0.5
    assert strategy.gradient_sum[[0, 11]].tolist() == pytest.approx([1.0, 2.0])
    assert strategy.drawn[[0, 1, 11]].tolist() == [1.0, 0.0, 1.0]
    other.load_state_dict(strategy.state_dict())
    assert all(torch.equal(other.state_dict()[k], v) for k, v in strategy.state_dict().items())


@pytest.mark.parametrize(("steps", "first", "last"), [(1600, 27, 800), (30_000, 500, 15_000), (60_000, 1000, 30_000)])
def test_statistics_keep_their_share_of_the_run(steps, first, last):
    field, rows = make_anchors()
    strategy = make_growth(steps=steps)
    for step, count in ((first, 0), (first + 1, 1), (last - 1, 2), (last, 2), (last + last // 3, 2)):
        after_backward(strategy, step, field, rows, half_transparent([0], [1.0]))
        assert (strategy.seen.sum() if len(strategy.seen) else 0) == count


def grow_once(gradient, **options):
    """One child of anchor 3, far from every anchor, drawn often enough with one gradient; returns what grew."""
    field, rows = make_anchors()
    with torch.no_grad():
        field.offsets.zero_()
        field.offsets[3, 4] = torch.tensor([0.0, 0.0, 200.0]) / field.scalings[3, :3].exp()
        field.features.copy_(torch.rand(field.features.shape, generator=torch.Generator().manual_seed(2)))
    before = len(field.anchors)
    strategy = make_judged(field, min_opacity=0.0, **options)
    strategy.drawn[34] = 41.0  # one more than 100 * 0.8 * 0.5
    strategy.gradient_sum[34] = 41.0 * gradient
    changes = after_backward(strategy, 100, field, rows, half_transparent([0], [0.0]))
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
    field, rows = make_anchors()
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
    assert after_backward(strategy, 100, field, rows, half_transparent([0], [0.0]))["grown"] == grown
    if grown:
        torch.testing.assert_close(field.anchors[-1], center + side)
        assert (field.scalings[-1].exp() <= 0.2501 * spacing).all()


def test_small_gradients_and_cells_below_a_quarter_of_a_voxel_grow_nothing():
    assert grow_once(1.0, levels=1, finest_cell=0.9)[3]["grown"] == 1
    assert grow_once(1.0, levels=1, finest_cell=9.0)[3]["grown"] == grow_once(0.00019)[3]["grown"] == 0


def test_occupied_cells_grow_nothing():
    field, rows = make_anchors()
    with torch.no_grad():
        field.offsets.zero_()  # every child sits on its own anchor
    strategy = make_judged(field, drawn=50.0, gradient=50.0, min_opacity=0.0)
    assert after_backward(strategy, 100, field, rows, half_transparent([0], [0.0]))["grown"] == 0
    assert strategy.drawn.sum() == 0  # used candidates start counting anew


def test_an_event_adds_at_most_one_anchor_for_so_many_pixels():
    field, rows = make_anchors()
    with torch.no_grad():
        field.offsets.copy_(torch.rand(field.offsets.shape, generator=torch.Generator().manual_seed(3)) * 60)
    strategy = make_judged(field, drawn=50.0, gradient=50.0, min_opacity=0.0, pixels_per_birth=1000)
    # 200 x 100 pixels
    assert after_backward(strategy, 100, field, rows, half_transparent([0], [0.0]))["grown"] == 20


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
    field, rows = make_anchors(head)
    field.normals = torch.nn.functional.normalize(torch.rand(field.normals.shape), dim=1)
    before = field.normals.clone()
    strategy = make_growth(statistics_from=0, growth_from=0)
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
    field, rows = make_anchors()
    with torch.no_grad():
        field.scalings[5, 3:] = 9.0
    strategy = make_growth(statistics_from=0, growth_from=0)
    before = field.scalings.detach().clone()
    after_backward(strategy, 100, field, rows, half_transparent([0], [0.0]))
    torch.testing.assert_close(field.scalings[5, 3:].exp(), torch.full((3,), 4 * field.spacing.item()))
    before[5, 3:] = field.scalings[5, 3:].detach()
    assert torch.equal(field.scalings.detach(), before)


def test_faint_anchors_go_and_the_rest_keeps_its_moments():
    field, rows = make_anchors()
    before = field.features.detach().clone()
    moments = rows.adam["features"].state[field.features]["exp_avg"].clone()
    strategy = make_judged(field, seen=81.0)
    strategy.opacity_sum[[2, 7]] = 81.0 * 0.004
    strategy.seen[9] = 10.0  # too rarely seen to judge
    strategy.opacity_sum[9] = 0.0
    changes = after_backward(strategy, 100, field, rows, half_transparent([], []))
    assert changes == {"grown": 0, "pruned": 2}
    kept = [i for i in range(len(before)) if i not in (2, 7)]
    assert torch.equal(field.features.detach(), before[kept])
    assert torch.equal(rows.adam["features"].state[field.features]["exp_avg"], moments[kept])
    assert len(strategy.seen) == len(kept) == len(field.anchors)
    assert strategy.seen[7] == 10.0  # anchor 9, moved up by two, keeps counting
    assert strategy.seen.sum() == 10.0
    strategy.seen.fill_(100.0)
    strategy.opacity_sum.zero_()  # never all of them
    assert after_backward(strategy, 200, field, rows, half_transparent([], []))["pruned"] == 0
    assert len(field.anchors) == len(kept)
