"""The response curve: increasing, the identity below its knee, and of known values and gradients."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from coliags_plugin.core.render_output import RenderOutput
from coliags_plugin.core.scenes import View
from coliags_plugin.modules.response import CameraResponse, ResponseSettings
from coliags_plugin.phantom.response import encode
from tests.pretended_cuda import PretendedCuda
from tests.scenes import wall_scene


def make(**options):
    return CameraResponse.from_scene(wall_scene(), ResponseSettings(**options), torch.Generator())


def test_it_begins_as_the_identity_for_every_view():
    module = make()
    output = RenderOutput(2.0 * torch.rand(4, 5, 3), torch.rand(4, 5), None, {})
    for view in (None, View("0001", 1.0, True), View("0000", 0.0, False)):
        torch.testing.assert_close(module.shade(output, view).rgb, output.rgb)


def test_it_is_numpys_interpolation_of_its_points():
    module = make(knee=0.4, segments=5)
    with torch.no_grad():
        module.log_slope.copy_(torch.tensor([0.3, -1.0, -3.0, 1.0, -0.5]))
    colors, values = module.learned["colors"], module.learned["values"]
    assert (colors[0], values[0], colors[-1]) == pytest.approx((0.4, 0.4, 1.5))
    asked = torch.linspace(0.0, 1.5, 301)
    expected = np.interp(asked, [0.0, *colors], [0.0, *values])
    np.testing.assert_allclose(module.curve(asked).detach(), expected, atol=1e-6)
    assert module.curve(torch.tensor(2.5)).item() == pytest.approx(values[-1] + np.exp(-0.5), abs=1e-6)  # goes on


def test_the_curve_of_a_device_is_that_of_the_cpu():
    module = make(knee=0.4, segments=5)
    with torch.no_grad():
        module.log_slope.copy_(torch.tensor([0.3, -1.0, -3.0, 1.0, -0.5]))
    colors, weights = torch.linspace(-0.1, 2.0, 200), torch.rand(200)
    results = []
    for device in ("cpu", "cuda"):
        with PretendedCuda():
            seen = colors.clone().to(device).requires_grad_()
            there = copy.deepcopy(module).to(device)
            values = there.curve(seen)
            (values * weights.to(device)).sum().backward()
            results.append([values.detach().cpu(), seen.grad.cpu(), there.log_slope.grad.cpu()])
    for of_cpu, of_device in zip(*results, strict=True):
        torch.testing.assert_close(of_device, of_cpu, atol=2e-6, rtol=2e-6)


def test_colours_that_are_not_finite_stay_so():
    values = make().curve(torch.tensor([float("nan"), float("inf"), 0.25]))
    assert values.isnan().tolist() == [True, False, False]
    assert values[1].isinf() and values[2] == 0.25


@given(st.lists(st.floats(-50.0, 50.0), min_size=3, max_size=3), st.floats(0.0, 3.0), st.floats(1e-3, 3.0))
def test_it_increases(slopes, color, more):
    module = CameraResponse(ResponseSettings(segments=3))
    with torch.no_grad():
        module.log_slope.copy_(torch.tensor(slopes))
    below, above = module.curve(torch.tensor([color, color + more], dtype=torch.float64)).tolist()
    assert above - below >= 0.019 * more


def test_its_gradient_is_that_of_differences():
    module = make(segments=3).double()
    with torch.no_grad():
        module.log_slope.copy_(torch.tensor([-0.5, 0.2, -1.0]))
    colors = torch.tensor([0.2, 0.6, 0.9, 1.3, 1.7], dtype=torch.float64, requires_grad=True)
    module.forward = module.curve

    def curve(colors, slope):
        return torch.func.functional_call(module, {"log_slope": slope}, (colors,))

    assert torch.autograd.gradcheck(curve, (colors, module.log_slope.detach().clone().requires_grad_()))


@pytest.mark.thorough
def test_a_known_shoulder_is_found():
    """Colours under five gains through the phantom's tone curve: the curve is found to half a percent."""
    generator = torch.Generator().manual_seed(0)
    colors = torch.rand(400, 1, generator=generator) * 0.9
    gains = torch.tensor([0.6, 0.8, 1.0, 1.2, 1.5])
    seen = torch.from_numpy(encode(((colors * gains).numpy()) ** 2.2, 2.2)).float()
    module = make()
    log_colors, log_gains = (torch.zeros(shape, requires_grad=True) for shape in (colors.shape, gains.shape))
    with torch.no_grad():
        log_colors.copy_(seen[:, 2:3].clamp_min(1e-3).log())
    adam = torch.optim.Adam([log_colors, log_gains, module.log_slope], lr=0.02)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(adam, 800)
    for _ in range(800):
        adam.zero_grad()
        drawn = log_colors.exp() * (log_gains - log_gains[2]).exp()
        (module.curve(drawn) - seen).abs().mean().backward()
        adam.step()
        schedule.step()
    asked = torch.linspace(0.1, 1.3, 25)
    expected = encode(asked.numpy() ** 2.2, 2.2)
    np.testing.assert_allclose(module.curve(asked).detach(), expected, atol=0.005)
    np.testing.assert_allclose((log_gains - log_gains[2]).exp().detach(), gains, rtol=0.005)
