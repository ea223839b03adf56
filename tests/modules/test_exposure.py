"""Gains per frame and the response curve: known ones are found again, and other views get what is promised."""

from __future__ import annotations

import copy
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from coliags_plugin.config.method_config import load_method
from coliags_plugin.core.render_output import RenderOutput
from coliags_plugin.core.scenes import View
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.engine.trainer import Trainer
from coliags_plugin.modules.exposure import CameraResponse, FrameGain, FrameGainSettings, ResponseSettings
from tests.pretended_cuda import PretendedCuda
from tests.scenes import wall_scene


def make(logs=None, scene=None, **options):
    """The module of a scene, by default the wall's frames 1 to 7, with these logarithms."""
    module = FrameGain(FrameGainSettings(**options), scene or wall_scene())
    if logs is not None:
        with torch.no_grad():
            module.log_gain.copy_(torch.as_tensor(logs).reshape(module.log_gain.shape))
    return module


LOGS = (0.1, 0.3, -0.2, 0.0, 0.4, -0.5, -0.1)


def test_gains_of_other_views():
    module = make(LOGS)
    zero = module.log_gain.mean()
    trained = module.gain(View("0003", 3.0, True)).log().item()
    assert trained == pytest.approx((module.log_gain[2] - zero).item())
    between = module.gain(View("0002b", 2.25, False)).log().item()
    # Akima (1970): slopes at 2 and 3 are (.7 * .2 + .7 * -.5) / 1.4 and (.2 * -.5 + .7 * .2) / .9.
    assert between == pytest.approx(0.84375 * 0.3 + 0.140625 * -0.15 + 0.15625 * -0.2 - 0.046875 * 0.04 / 0.9)
    assert module.gain(View("0000", 0.0, False)).log().item() == pytest.approx(0.1 - zero.item())
    assert module.gain(View("0008", 8.0, False)).log().item() == pytest.approx(-0.1 - zero.item())
    assert module.gain(None).item() == pytest.approx(1.0)
    # A held-out view is never taken for the training frame of that name.
    held_out = module.gain(View("0003", 3.5, False)).log().item()
    assert held_out == pytest.approx(0.5 * -0.2 + 0.125 * 0.04 / 0.9 - 0.125 * 0.27)  # .27: (1.3 * .2 + .7 * .4) / 2


def test_gains_turn_within_a_held_out_stretch_where_slopes_say_so():
    scene = wall_scene(41).without({f"{index:04d}" for index in range(14, 27)})
    times = torch.tensor([float(frame.index) for frame in scene.train])
    middle = View("held out", 20.0, False)
    steady = make(0.03 * times, scene)
    assert steady.gain(middle).log().item() == pytest.approx(0.03 * (20.0 - float(times.mean())), abs=1e-6)
    # Falling before the stretch, rising after it; a straight line would stay at the height of its ends.
    turning = make(0.002 * (times - 20.0) ** 2, scene)
    lowest = turning.log_gains().min().item()
    assert turning.gain(middle).log().item() < lowest - 0.05
    bounded = make(0.002 * (times - 20.0) ** 2, scene, max_gain=math.exp(0.02 - lowest))
    assert bounded.gain(middle).log().item() == pytest.approx(lowest - 0.02)


@pytest.mark.parametrize("channels", [1, 3])
def test_shading_multiplies_the_colours_alone(channels):
    module = make(torch.linspace(-0.4, 0.4, 7 * channels), channels=channels)
    output = RenderOutput(torch.rand(2, 3, 3), torch.rand(2, 3), None, {"normals": torch.rand(2, 3, 3)})
    shaded = module.shade(output, View("0003", 3.0, True))
    torch.testing.assert_close(shaded.rgb, output.rgb * (module.log_gain[2] - module.log_gain.mean(0)).exp())
    assert shaded.alpha is output.alpha and shaded.maps is output.maps


def test_views_beside_the_video_have_the_gain_of_the_nearest_training_camera():
    scene = wall_scene()
    aside = replace(scene.train[4], name="turned-0", index=0)  # taken where the fifth training frame was
    module = make(LOGS, replace(scene, test_sets={**scene.test_sets, "rotation": [aside]}))
    assert module.gain(aside.view(trained=False)).item() == pytest.approx(module.log_gains().exp()[4].item())


def test_gains_stay_within_their_bounds_and_frames_at_a_bound_are_named():
    module = make((0.0, 0.0, 0.0, 70.0, 0.0, 0.0, 0.0), max_gain=2.0)
    gains = module.log_gains().exp()
    assert gains.max().item() == pytest.approx(2.0) and gains.min().item() == pytest.approx(0.5)
    assert "0004" in module.learned["at_bound"] and module.learned["gains"]["0004"] == pytest.approx([2.0])
    assert make().learned["at_bound"] == []


@pytest.mark.thorough
def test_known_gains_are_found(tmp_path):
    """An evenly lit wall whose images were multiplied by 0.74 to 1.1: found to one percent, up to a common factor."""
    generator = torch.Generator().manual_seed(3)
    scene = wall_scene(frames=10, width=48, height=36, lamp=False)
    gains = torch.exp(torch.rand(len(scene.train), generator=generator) * 0.4 - 0.3)
    train = [
        frame.with_maps(image=(frame.rgb * gain * 255).round().to(torch.uint8))
        for frame, gain in zip(scene.train, gains, strict=True)
    ]
    overrides = ["schedule.steps=400", "datamanager.points_count=1000", "strategy=none", "field.sh_degree=0"]
    overrides += ["optimizers.sh0.lr=0.01", "modules.exposure=gain"]
    method = load_method("3dgs-depth", [*overrides, 'optimizers."exposure.gain"={lr: 0.02, final_lr: 0.0005}'])
    trainer = Trainer(method, replace(scene, train=train), "wall", RunFolder(tmp_path / "run"), 0, torch.device("cpu"))
    for _ in range(400):
        trainer.take_step()
    learned = trainer.model.view_modules["exposure"].log_gains().exp().detach()[:, 0]
    expected = gains / math.exp(gains.log().mean().item())
    assert (learned / expected - 1).abs().max() < 0.01


def rendering(level):
    """A rendering of one grey level."""
    return RenderOutput(torch.full((24, 32, 3), level), torch.ones(24, 32), None, {})


def with_depths(scene, depths):
    """The scene with one depth throughout each training frame."""
    pairs = zip(scene.train, depths, strict=True)
    train = [frame.with_maps(depth=torch.full((24, 32), float(z))) for frame, z in pairs]
    return replace(scene, train=train)


def exposed(frames=33, answer=-0.6, gap=1):
    """A module whose gains answer the brightness of training frames exactly, its scene, and that law's constant."""
    scene = wall_scene(frames)
    kept = range(0, len(scene.train), gap)
    scene = replace(scene, train=[scene.train[index] for index in kept])
    levels = torch.tensor([0.5 + 0.2 * math.sin(0.9 * index) for index in kept])
    scene = with_depths(scene, 10.0 / levels)
    module = make(scene=scene, untrained="metered")
    for frame, level in zip(scene.train, levels, strict=True):
        module.after_step(frame.view(trained=True), rendering(float(level)))
    brightness = levels.double().log()
    gains = answer * (brightness - brightness.mean())
    with torch.no_grad():
        module.log_gain.copy_(gains[:, None])
    return module, scene, float((gains - answer * brightness).mean())


@pytest.mark.parametrize(("answer", "gap"), [(-0.6, 1), (-0.3, 1), (-0.6, 2)])
def test_held_out_frames_are_exposed_as_training_frames_of_their_brightness(answer, gap):
    module, scene, constant = exposed(answer=answer, gap=gap)
    for frame, level in zip(scene.test_sets["test"], (0.2, 0.4, 0.6, 0.3, 0.5), strict=True):
        output = rendering(level)
        gain = float((module.shade(output, frame.view(trained=False)).rgb.detach() / output.rgb)[0, 0, 0])
        assert math.log(gain) == pytest.approx(answer * math.log(level) + constant, abs=1e-4)


def fitted_response(answer, noise, kind, gap, seed):
    """The module's response to an exposure that answers brightness, fitted with noise.

    ``noise``: standard deviation of log gain and log brightness; ``kind``: whether their errors are opposite, or each
    has its own.
    """
    rng = np.random.default_rng(seed)
    time, phase = np.arange(120), rng.uniform(0, 2 * np.pi, 2)
    near = 0.3 * np.sin(0.5 * time + phase[0]) + 0.3 * np.sin(0.15 * time + phase[1])
    brightness = 0.9 * near + rng.normal(0.0, 0.01, 120)
    error = rng.normal(0.0, noise, 120)
    gains = answer * brightness + error
    rendered = brightness + (-error if kind == "opposite" else rng.normal(0.0, noise, 120))
    scene = wall_scene(1)
    frame = scene.test_sets["test"][0].with_maps(mask=None)
    frames = [replace(frame, name=f"{index:04d}", index=index) for index in time]
    module = make(
        scene=with_depths(replace(scene, train=frames, test_sets={}), 20.0 * np.exp(-near)), untrained="metered"
    )
    module.metering.brightness.copy_(torch.from_numpy(np.exp(rendered - 2.0)))
    return module.metering.response(torch.from_numpy(gains), 40, 40 + gap)


@pytest.mark.thorough
@pytest.mark.parametrize("answer", [0.0, -0.3, -0.7, -1.0])
@pytest.mark.parametrize("gap", [2, 20])
@pytest.mark.parametrize("kind", ["opposite", "own"])
def test_the_response_is_found_whatever_the_errors_of_gain_and_brightness(answer, gap, kind):
    for noise in (0.0, 0.01, 0.03):
        learned = np.mean([fitted_response(answer, noise, kind, gap, seed) for seed in range(12)])
        assert learned == pytest.approx(answer, abs=0.03 if noise else 1e-5), noise


def test_depth_that_tells_nothing_of_the_brightness_gives_no_response():
    module, scene, _ = exposed()
    depths = np.full(len(scene.train), 20.0), np.random.default_rng(0).uniform(10.0, 30.0, len(scene.train))
    bare = replace(scene, train=[frame.with_maps(depth=None) for frame in scene.train])
    for other in (*(with_depths(scene, each) for each in depths), bare):
        metered = make(scene=other, untrained="metered")
        metered.metering.brightness.copy_(module.metering.brightness)
        assert metered.metering.response(module.log_gains().detach().double().mean(1), 3, 4) == 0.0


def test_metering_leaves_other_views_alone_and_keeps_brightness_from_training_alone():
    module, scene, _ = exposed()
    output, train = rendering(0.3), scene.train[3].view(trained=True)
    plain, before = make(module.log_gain.detach(), scene), module.metering.brightness.clone()
    for view in (train, None):
        assert torch.equal(module.shade(output, view).rgb, plain.shade(output, view).rgb)
    module.after_step(scene.test_sets["test"][0].view(trained=False), rendering(0.9))
    assert torch.equal(module.metering.brightness, before)
    module.after_step(train, rendering(0.9))
    before[3] = 0.9
    torch.testing.assert_close(module.metering.brightness, before)
    fixed, scene, _ = exposed(answer=0.0)
    held_out = scene.test_sets["test"][1].view(trained=False)
    torch.testing.assert_close(fixed.shade(output, held_out).rgb, output.rgb)


@pytest.mark.parametrize("frames", [3, 5, 33])
def test_views_are_interpolated_in_short_videos_and_until_all_training_frames_were_rendered(frames):
    module, scene, _ = exposed(frames=frames)
    if frames == 33:
        module.metering.brightness[7] = 0.0
    output, view = rendering(0.3), scene.test_sets["test"][0].view(trained=False)
    torch.testing.assert_close(module.shade(output, view).rgb, output.rgb * module.gain(view).detach())


# The response curve: increasing, the identity below its knee, and of known values and gradients


def make_response(*log_slopes, **options):
    module = CameraResponse(ResponseSettings(segments=len(log_slopes) or 8, **options), wall_scene())
    if log_slopes:
        module.log_slope.data.copy_(torch.tensor(log_slopes))
    return module


def test_it_begins_as_the_identity_for_every_view_and_colours_that_are_not_finite_stay_so():
    module = make_response()
    output = RenderOutput(2.0 * torch.rand(4, 5, 3), torch.rand(4, 5), None, {})
    output.rgb[0, 0] = torch.tensor([torch.nan, torch.inf, 0.25])
    for view in (None, View("0001", 1.0, True), View("0000", 0.0, False)):
        torch.testing.assert_close(module.shade(output, view).rgb, output.rgb, equal_nan=True)


def test_it_is_numpys_interpolation_of_its_points():
    module = make_response(0.3, -1.0, -3.0, 1.0, -0.5, knee=0.4)
    colors, values = module.learned["colors"], module.learned["values"]
    assert (colors[0], values[0], colors[-1]) == pytest.approx((0.4, 0.4, 1.5))
    calls = torch.linspace(0.0, 1.5, 301)
    expected = np.interp(calls, [0.0, *colors], [0.0, *values])
    np.testing.assert_allclose(module.curve(calls).detach(), expected, atol=1e-6)
    assert module.curve(torch.tensor(2.5)).item() == pytest.approx(values[-1] + np.exp(-0.5), abs=1e-6)  # goes on


def test_the_curve_of_a_device_is_that_of_the_cpu():
    module = make_response(0.3, -1.0, -3.0, 1.0, -0.5, knee=0.4)
    colors, weights = torch.linspace(-0.1, 2.0, 200), torch.rand(200)
    results = []
    for device in ("cpu", "cuda"):
        with PretendedCuda():
            rendered = colors.clone().to(device).requires_grad_()
            there = copy.deepcopy(module).to(device)
            values = there.curve(rendered)
            (values * weights.to(device)).sum().backward()
            results.append([values.detach().cpu(), rendered.grad.cpu(), there.log_slope.grad.cpu()])
    for of_cpu, of_device in zip(*results, strict=True):
        torch.testing.assert_close(of_device, of_cpu, atol=2e-6, rtol=2e-6)


@given(st.lists(st.floats(-50.0, 50.0), min_size=3, max_size=3), st.floats(0.0, 3.0), st.floats(1e-3, 3.0))
def test_it_increases(slopes, color, more):
    below, above = make_response(*slopes).curve(torch.tensor([color, color + more], dtype=torch.float64)).tolist()
    assert above - below >= 0.019 * more


def test_its_gradient_is_that_of_differences():
    module = make_response(-0.5, 0.2, -1.0).double()
    colors = torch.tensor([0.2, 0.6, 0.9, 1.3, 1.7], dtype=torch.float64, requires_grad=True)
    module.forward = module.curve

    def curve(colors, slope):
        return torch.func.functional_call(module, {"log_slope": slope}, (colors,))

    assert torch.autograd.gradcheck(curve, (colors, module.log_slope.detach().clone().requires_grad_()))
