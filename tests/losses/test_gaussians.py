"""Losses of the Gaussians: factors of the diffuse reflection, variances of channels, volumes and normals."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from coliags_plugin.contracts import Schedule
from coliags_plugin.core.errors import InputError
from coliags_plugin.engine.model import Model
from tests.fields.made import make_field
from tests.losses import terms
from tests.losses.terms import make, make_output
from tests.scenes import plain_frame as make_frame


def of_channel(name, values, step=1, schedule=None, **options):
    """A loss of Gaussians with this channel."""
    output = make_output(torch.zeros(2, 2, 3), torch.zeros(len(values), 3))
    channel = options.get("attribute", "diffuse_factor")
    splats = replace(output.splats, gaussians=replace(output.splats.gaussians, features={channel: values}))
    return make(name, **options).loss(terms.step(replace(output, splats=splats), number=step, schedule=schedule))


FACTORS = torch.tensor([[1.0, 2.0, 1.0], [1.0, 1.0, -1.0]])


@pytest.mark.parametrize(
    ("step", "schedule", "share", "options"),
    [
        *(
            (step, Schedule(steps, 40_000), share, {"from_step": 1000, "until_step": 20_000})
            for step, steps, share in (
                (1001, 40_000, 18_999 / 19_000),
                *((10_500, 40_000, 0.5), (20_000, 40_000, 0.0), (25_000, 40_000, 0.0)),
                *((105, 400, 0.5), (5, 400, 1.0)),
            )
        ),
        (50, Schedule(100, 100), 0.5, {}),  # without an end, it ends with the run
    ],
)
def test_factors_are_held_near_one_less_and_less(step, schedule, share, options):
    term = of_channel("diffuse-factor", FACTORS, step, schedule, **options)
    assert term.item() == pytest.approx(share * (1 + 4) / 6)


def test_the_variance_is_around_the_mean_of_each_component():
    values = torch.tensor([[1.0, 10.0], [3.0, 10.0], [5.0, 13.0]], requires_grad=True)
    term = of_channel("attribute-variance", values, attribute="albedo")
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
    model = SimpleNamespace(field=SimpleNamespace(feature_channels=frozenset(channels)))
    with pytest.raises(InputError, match=words):
        make(name, **options).loss.check(model)


# Volumes


def volume(scales):
    return make("scale-volume")(make_output(torch.zeros(2, 2, 3), scales), make_frame(torch.zeros(2, 2, 3)))


def test_scale_volume_is_the_mean_product():
    scales = torch.tensor([[1.0, 2.0, 3.0], [0.5, 0.5, 4.0]])
    assert volume(scales).item() == (6.0 + 1.0) / 2
    assert volume(scales[:, :2]).item() == (2.0 + 0.25) / 2


def test_a_scale_of_zero_keeps_its_gradient_finite():
    scales = torch.tensor([[0.0, 2.0, 3.0]], requires_grad=True)
    volume(scales).backward()
    assert scales.grad.tolist() == [[6.0, 0.0, 0.0]]


# Normals


def turned_field(degrees, scales=(1.0, 1.0, 0.1)):
    """Gaussians on the wall z = 20 whose shortest axes are turned away from its normal."""
    field = make_field("gaussians", normal_neighbours=10)
    half = math.radians(degrees) / 2
    with torch.no_grad():
        field.scales.copy_(torch.tensor(scales).log().expand_as(field.scales))
        field.quats.copy_(torch.tensor([math.cos(half), math.sin(half), 0.0, 0.0]).expand_as(field.quats))
    return field


def value(field, step=2, **options):
    output, model = make_output(torch.zeros(2, 2, 3)), Model(field, None, {})
    return make("surface-normals", **options).loss(terms.step(output, model=model, number=step))


@pytest.mark.parametrize("degrees", [0.0, 30.0, 90.0, 150.0])
def test_one_minus_the_cosine_of_the_shortest_axis_to_the_surface(degrees):
    expected = 1.0 - abs(math.cos(math.radians(degrees)))
    assert value(turned_field(degrees)).item() == pytest.approx(expected, abs=1e-6)
    other = 1.0 - abs(math.sin(math.radians(degrees)))
    assert value(turned_field(degrees, scales=(1.0, 0.1, 1.0))).item() == pytest.approx(other, abs=1e-6)


def test_only_every_so_many_steps_and_towards_the_surface():
    field = turned_field(30.0)
    zeros = [value(field, step, every=3).item() == 0.0 for step in range(1, 7)]
    assert zeros == [True, True, False, True, True, False]
    value(field).backward()
    assert field.scales.grad is None
    with torch.no_grad():
        field.quats -= 0.3 * len(field.means) * field.quats.grad
    assert value(field) < value(turned_field(30.0))


def test_fields_without_references_are_refused():
    with pytest.raises(InputError, match=r"and the field has none.*normal_neighbours=10"):
        make("surface-normals").loss.check(Model(make_field("gaussians"), None, {}))
