"""Losses on feature channels of the Gaussians drawn: factors of the diffuse reflection, and variances."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from coliags_plugin.config import registry
from coliags_plugin.contracts import Schedule, TrainingStep
from coliags_plugin.core.errors import InputError
from tests.losses.terms import make_output

SCHEDULE = Schedule(100, 100)


@pytest.fixture
def value():
    """A loss of Gaussians with this channel."""

    def value(name, values, step=1, schedule=SCHEDULE, **options):
        output = make_output(torch.zeros(2, 2, 3), torch.zeros(len(values), 3))
        channel = options.get("attribute", "diffuse_factor")
        splats = replace(output.splats, gaussians=replace(output.splats.gaussians, features={channel: values}))
        loss = registry.losses.get(name)
        made = loss(loss.Settings(weight=1.0, **options))
        return made(TrainingStep(replace(output, splats=splats), None, None, step, schedule))

    return value


FACTORS = torch.tensor([[1.0, 2.0, 1.0], [1.0, 1.0, -1.0]])


@pytest.mark.parametrize(
    ("step", "schedule", "share"),
    [
        (1001, Schedule(40_000, 40_000), 18_999 / 19_000),
        (10_500, Schedule(40_000, 40_000), 0.5),
        (20_000, Schedule(40_000, 40_000), 0.0),
        (25_000, Schedule(40_000, 40_000), 0.0),
        (105, Schedule(400, 40_000), 0.5),
        (5, Schedule(400, 40_000), 1.0),
    ],
)
def test_factors_are_held_near_one_less_and_less(value, step, schedule, share):
    term = value("diffuse-factor", FACTORS, step, schedule, from_step=1000, until_step=20_000)
    assert term.item() == pytest.approx(share * (1 + 4) / 6)


def test_without_an_end_the_hold_ends_with_the_run(value):
    assert value("diffuse-factor", FACTORS, 50, Schedule(100, 100)).item() == pytest.approx(0.5 * 5 / 6)


def test_the_variance_is_around_the_mean_of_each_component(value):
    values = torch.tensor([[1.0, 10.0], [3.0, 10.0], [5.0, 13.0]], requires_grad=True)
    term = value("attribute-variance", values, attribute="albedo")
    assert term.item() == pytest.approx(values.var(0, unbiased=False).mean().item())
    term.backward()
    assert values.grad[0, 0] < 0 < values.grad[2, 0]
    assert values.grad[1, 0] == 0


@pytest.mark.parametrize(
    ("name", "options", "channels", "words"),
    [
        ("diffuse-factor", {}, {"albedo"}, "'diffuse_factor' of the Gaussians, and the field has albedo"),
        ("attribute-variance", {"attribute": "albdo"}, {"albedo", "f0"}, "Did you mean 'albedo'"),
        ("attribute-variance", {"attribute": "albedo"}, set(), "and the field has none.*lit-gaussians"),
    ],
)
def test_a_field_without_the_channel_is_refused(name, options, channels, words):
    loss = registry.losses.get(name)
    model = SimpleNamespace(field=SimpleNamespace(feature_channels=frozenset(channels)))
    with pytest.raises(InputError, match=words):
        loss(loss.Settings(weight=1.0, **options)).check(model)
