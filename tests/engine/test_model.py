"""The model: modules around a field, their names, and what they are asked."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import nn

from coliags_plugin.contracts import ViewModule
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scenes import View
from coliags_plugin.engine.model import Model
from coliags_plugin.renderers.torch_renderer import TorchRenderer, TorchRendererSettings
from tests.renderers.test_torch_renderer import FieldOf, pinhole, random_gaussians


class Shift(ViewModule):
    """Moves the camera along x and multiplies the colours."""

    untrained_views = "all views alike"

    def __init__(self, step, factor, wants=()):
        super().__init__()
        self.step, self.factor, self.asked = step, factor, []
        self.weight = nn.Parameter(torch.ones(()))
        self._wants = frozenset(wants)

    @property
    def wants(self):
        return self._wants

    @classmethod
    def from_scene(cls, scene, settings, generator):
        raise NotImplementedError

    def parameter_groups(self):
        return {"weight": [self.weight]}

    def adjust_camera(self, camera, view):
        self.asked.append((camera.center[0].item(), view))
        shift = torch.zeros(4, 4)
        shift[0, 3] = self.step
        return replace(camera, camera_to_world=camera.camera_to_world + shift)

    def shade(self, output, view):
        return replace(output, rgb=output.rgb * self.factor)


def make_model(**modules):
    field = FieldOf(random_gaussians(40, 0))
    return Model(field, TorchRenderer(TorchRendererSettings()), modules)


def test_modules_act_in_their_order_on_camera_and_output():
    first, second = Shift(1.0, 2.0), Shift(0.5, 3.0, wants=("normals",))
    model, camera, view = make_model(a=first, b=second), pinhole(24, 20, 30.0, 30.0), View("0003", 3.0, True)
    output = model.render(camera, ("depth_expected",), view)
    start = camera.center[0].item()
    assert first.asked == [(start, view)] and second.asked == [(start + 1.0, view)]
    assert output.camera.center[0].item() == pytest.approx(start + 1.5)
    moved = replace(camera, camera_to_world=output.camera.camera_to_world)
    plain = make_model().render(moved, ("depth_expected",))
    torch.testing.assert_close(output.rgb, 6.0 * plain.rgb)
    torch.testing.assert_close(output["depth_expected"], plain["depth_expected"])
    assert set(output.maps) == {"depth_expected", "normals"}
    groups = model.parameter_groups()
    assert groups["a.weight"][0] is first.weight and groups["b.weight"][0] is second.weight


def test_outputs_that_nobody_delivers_are_refused():
    with pytest.raises(InputError, match="needed by protocol 'x': albedo"):
        make_model().check_outputs(("rgb", "albedo"), "protocol 'x'")
    with pytest.raises(InputError, match="needed by module 'lamp': albedo"):
        make_model(lamp=Shift(0.0, 1.0, wants=("albedo",))).check_outputs(("rgb",), "the losses")
