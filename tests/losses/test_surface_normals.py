"""The loss on normals of Gaussians, and Huber's loss of depth."""

from __future__ import annotations

import math

import pytest
import torch

from coliags_plugin.config.components import make_component
from coliags_plugin.contracts import Schedule, TrainingStep
from coliags_plugin.core.errors import InputError
from coliags_plugin.engine.model import Model
from tests.losses.terms import make, make_output
from tests.scenes import wall_scene


def turned_field(degrees, scales=(1.0, 1.0, 0.1)):
    """Gaussians on the wall z = 20 whose shortest axes are turned away from its normal."""
    component = make_component("fields", {"name": "gaussians", "normal_neighbours": 10})
    field = component.target.from_scene(wall_scene(), component.settings, torch.Generator())
    half = math.radians(degrees) / 2
    with torch.no_grad():
        field.scales.copy_(torch.tensor(scales).log().expand_as(field.scales))
        field.quats.copy_(torch.tensor([math.cos(half), math.sin(half), 0.0, 0.0]).expand_as(field.quats))
    return field


def value(field, step=2, **options):
    output = make_output(torch.zeros(2, 2, 3))
    model = Model(field, None, {})
    return make("surface-normals", **options).loss(TrainingStep(output, None, model, step, Schedule(10, 10)))


@pytest.mark.parametrize("degrees", [0.0, 30.0, 90.0, 150.0])
def test_one_minus_the_cosine_to_the_surface(degrees):
    expected = 1.0 - abs(math.cos(math.radians(degrees)))
    assert value(turned_field(degrees)).item() == pytest.approx(expected, abs=1e-6)


def test_the_axis_is_that_of_the_smallest_scale():
    assert value(turned_field(0.0, scales=(1.0, 0.1, 1.0))).item() == pytest.approx(1.0, abs=1e-6)


def test_its_gradient_turns_gaussians_towards_the_surface():
    field = turned_field(30.0)
    rates = {"quats": 0.3}
    for _ in range(400):
        value(field).mul(len(field.means)).backward()
        with torch.no_grad():
            for name, rate in rates.items():
                parameter = getattr(field, name)
                parameter -= rate * parameter.grad
        assert field.scales.grad is None
        field.zero_grad()
    assert value(field).item() < 1e-4


def test_only_every_so_many_steps():
    field = turned_field(30.0)
    zeros = [value(field, step, every=3).item() == 0.0 for step in range(1, 7)]
    assert zeros == [True, True, False, True, True, False]


def test_fields_without_references_are_refused():
    component = make_component("fields", "gaussians")
    field = component.target.from_scene(wall_scene(), component.settings, torch.Generator())
    with pytest.raises(InputError, match=r"and the field has none.*normal_neighbours=10"):
        make("surface-normals").loss.check(Model(field, None, {}))
