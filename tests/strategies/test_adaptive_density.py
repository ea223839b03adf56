"""Adaptive density control: what is cloned, split, pruned and reset, and when."""

from __future__ import annotations

import math

import pytest
import torch

from coliags_plugin.config.components import make_component
from coliags_plugin.contracts import Schedule
from coliags_plugin.core.gaussians import rotation_matrices
from tests.fields.made import make_field
from tests.strategies.steps import after_backward, make_output, stepped_optimizers

EXTENT = 10.0


def make(**options):
    field = make_field("gaussians", **options)
    with torch.no_grad():
        field.opacities.fill_(0.0)
        field.scales.fill_(math.log(0.05))  # small: below 0.01 of the extent
    return field, stepped_optimizers(field, 0.0)


def make_strategy(steps=30_000, **options):
    component = make_component("strategies", {"name": "adaptive-density", **options})
    return component.target(component.settings, torch.Generator().manual_seed(0), Schedule(steps, 30_000), EXTENT)


def test_small_ones_are_cloned():
    field, rows = make()
    strategy, before = make_strategy(), field.means.detach().clone()
    done = after_backward(strategy, 600, field, rows, make_output([3, 7, 9], [0.0003, 0.0001, 0.0002]))
    assert done == {"grown": 2, "pruned": 0}
    assert torch.equal(field.means.detach(), torch.cat([before, before[[3, 9]]]))
    for name in field.row_parameters:
        assert torch.equal(getattr(field, name)[-2:], getattr(field, name)[[3, 9]])
        assert rows.adam[name].param_groups[0]["params"] == [getattr(field, name)]
    assert not rows.adam["means"].state[field.means]["exp_avg"][-2:].any()


def test_large_ones_are_split_into_two_smaller_within_them():
    field, rows = make()
    with torch.no_grad():
        field.scales[5] = torch.tensor([0.5, 0.1, 0.1]).log()
        field.quats[5] = quat = torch.tensor([math.cos(math.pi / 4), 0.0, 0.0, math.sin(math.pi / 4)])  # x becomes y
    center, count = field.means[5].detach().clone(), len(field.means)
    strategy = make_strategy()
    assert after_backward(strategy, 600, field, rows, make_output([5], [0.001]))["grown"] == 1
    assert len(field.means) == count + 1  # two came, one went
    torch.testing.assert_close(field.scales[-2:].exp(), torch.tensor([[0.5, 0.1, 0.1]] * 2) / 1.6)
    assert not (field.means == center).all(dim=1).any()
    shifts = strategy._shifts(torch.tensor([[0.5, 0.1, 0.1]] * 600).log(), quat.expand(600, 4))
    # The parts are drawn from the Gaussian that they replace.
    torch.testing.assert_close(shifts.std(0), torch.tensor([0.1, 0.5, 0.1]), rtol=0.12, atol=0)
    torch.testing.assert_close(shifts.mean(0), torch.zeros(3), rtol=0, atol=0.06)


def test_faint_ones_go_and_after_the_first_reset_oversized_ones_too():
    field, rows = make()
    with torch.no_grad():
        field.opacities[2] = -6.0  # 0.0025
        field.scales[4] = math.log(1.1)  # above a tenth of the extent
    strategy, count = make_strategy(), len(field.means)
    early = make_output([4, 6], [0.0, 0.0], radii=[3.0, 21.0])
    assert after_backward(strategy, 600, field, rows, early) == {"grown": 0, "pruned": 1}
    late = make_output([4, 6], [0.0, 0.0], radii=[3.0, 21.0])
    assert after_backward(strategy, 3100, field, rows, late)["pruned"] == 2  # rows 3 and 6 as they are counted now
    assert len(field.means) == count - 3


def test_opacities_are_reset_and_adam_forgets_them():
    field, rows = make()
    with torch.no_grad():
        field.opacities[1] = -5.0  # 0.0067: below the reset, above the pruning
    strategy = make_strategy()
    after_backward(strategy, 3000, field, rows, make_output([0], [0.0]))
    opacities = field.opacities.sigmoid()
    assert opacities[:2].tolist() == pytest.approx([0.01, 0.006693], rel=1e-4)
    state = rows.adam["opacities"].state[field.opacities]
    assert not state["exp_avg"].any() and not state["exp_avg_sq"].any()
    assert rows.adam["means"].state[field.means]["exp_avg"].any()


@pytest.mark.parametrize(
    ("steps", "plan", "expected"),
    [
        (30_000, "at 144 steps, from 600 to 14900, and resets opacities at 4 steps, from 3000 to 12000",
         range(600, 14_901, 100)),
        (3000, "at 45 steps, from 64 to 1472, and resets opacities at 4 steps, from 300 to 1200", range(64, 1500, 32)),
        (1999, "at 30 steps, from 64 to 992, and resets opacities at 4 steps, from 200 to 800", range(64, 999, 32)),
        (1990, "and resets opacities never", range(64, 995, 32)),
        (20, "at 2 steps, from 4 to 8, and resets opacities never", [4, 8]),
        (12, "at step 4, and resets opacities never", [4]),
        (2, "neither densifies nor prunes: its 2 steps leave no multiple of 4 between steps 0 and 1", []),
    ],
)  # fmt: skip
def test_the_plan_is_what_happens(steps, plan, expected):
    strategy, (field, rows) = make_strategy(steps=steps), make()
    assert plan in strategy.plan()
    every = 50 if steps > 3000 else 8 if steps > 1000 else 1
    tried = range(every, steps + 1, every)
    events = [step for step in tried if after_backward(strategy, step, field, rows, make_output([0], [0.0]))]
    assert events == [*expected]


def test_statistics_are_means_over_the_views_that_draw():
    field, rows = make()
    strategy = make_strategy()
    for gradient, radius in ((0.0003, 2.0), (0.00005, 2.0), (0.9, 0.0)):
        after_backward(strategy, 599, field, rows, make_output([8], [gradient], radii=[radius]))
    assert strategy.drawn[8] == 2.0
    assert (strategy.gradient_sum[8] / strategy.drawn[8]).item() == pytest.approx(0.000175)
    other = make_strategy()
    other.load_state_dict(strategy.state_dict())
    assert torch.equal(other.gradient_sum, strategy.gradient_sum)
    assert after_backward(other, 600, field, rows, make_output([8], [0.0]))["grown"] == 0


def test_parts_spread_along_the_normal_by_a_share_and_those_of_surfels_stay_in_their_planes():
    quats = torch.nn.functional.normalize(torch.randn(200, 4, generator=torch.Generator().manual_seed(2)), dim=1)
    axes = rotation_matrices(quats).mT

    def along(scales, **options):
        shifts = make_strategy(**options)._shifts(torch.tensor([scales] * 200).log(), quats)
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
    field, rows = make()
    with torch.no_grad():
        field.opacities[faint] = -9.0
    count, strategy = len(field.means), make_strategy(prune_above=prune_above)
    assert after_backward(strategy, 600, field, rows, make_output([3], [0.0]))["pruned"] == pruned
    assert len(field.means) == count - pruned


def test_reference_normals_follow_their_gaussians():
    (field, rows), strategy = make(normal_neighbours=10), make_strategy()
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
