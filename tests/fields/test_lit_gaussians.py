"""Gaussians lit by a lamp: closed forms of their colours, the network's part, noise, bounds and other lamps."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from coliags_plugin.contracts import Schedule
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.lamps import Lamp
from coliags_plugin.core.scenes import PointCloud
from coliags_plugin.fields import lit_gaussians
from coliags_plugin.fields.lit_gaussians import _ROWS, GAMMA, PINK, THICKNESS, Cosines, DiffuseNetwork, reflection
from tests.fields.made import colored_wall, make_field
from tests.renderers.test_torch_renderer import render_gaussians
from tests.scenes import camera_at, wall_scene

SCHEDULE = Schedule(100, 100)
OPTIONS = {"network_from": 50, "hidden": 16, "hidden_layers": 2, "network_precision": "float32"}


def make(scene=None, **options):
    return make_field("lit-gaussians", scene or colored_wall(), 3, **{**OPTIONS, **options})


def varied(**options):
    """Materials and rotations that differ between Gaussians."""
    field = make(**options)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        field.roughness.uniform_(0.1, 0.6, generator=generator)
        field.f0.uniform_(0.01, 0.03, generator=generator)
        field.quats += 0.2 * torch.randn(field.quats.shape, generator=generator)
        field.lamp_parameters.copy_(torch.tensor([2.5, 0.7, 1.6]))
    return field


def trained(**options):
    """Field as varied, at a step at which the network counts, with weights that matter."""
    field = varied(**options)
    with torch.no_grad():
        for layer in field.diffuse_network.layers:
            layer.weight.mul_(3.0)
    field.before_step(60, SCHEDULE)
    return field


def expected_colors(field, gaussians, camera, lamp_at, spread):
    """The published colour of every Gaussian seen, in a loop, without the network."""
    colors = []
    axes = field.normals().detach().double()[gaussians.source_index].numpy()
    intensity, falloff, exponent = field.lamp_parameters.tolist()
    for mean, axis, row in zip(
        gaussians.means.detach().double().numpy(), axes, gaussians.source_index.tolist(), strict=True
    ):
        view, lamp = camera.center.numpy() - mean, lamp_at - mean
        normal = axis if axis @ view >= 0 else -axis
        distance = np.linalg.norm(lamp) / field.extent.item()
        arriving = intensity / (1 + falloff * distance**exponent) * spread(-lamp / np.linalg.norm(lamp))
        if normal @ lamp <= 0:
            colors.append(np.full(3, 1e-6 ** (1 / GAMMA)))
            continue
        diffuse, mirrored = by_hand(view, lamp, normal, field.roughness[row].item(), field.f0[row].item())
        light = (field.albedos[row].detach().double().numpy() * diffuse + mirrored) * arriving
        colors.append(np.maximum(light, 1e-6) ** (1 / GAMMA))
    return torch.tensor(np.array(colors), dtype=torch.float32)


def test_colours_are_the_closed_form_under_the_camera_s_lamp_and_another():
    field, camera = varied(), camera_at(0.5, -1.0, 4.0, yaw=0.2)
    gaussians = field.gaussians(camera)
    assert len(gaussians) > 300
    expected = expected_colors(field, gaussians, camera, camera.center.numpy(), lambda directions: 1.0)
    torch.testing.assert_close(gaussians.colors, expected, rtol=2e-4, atol=1e-5)
    lit = field.with_lamp(Lamp(offset=(3.0, -2.0, 1.0), turn=(20.0, -10.0), power=6.0, intensity=1.5)).gaussians(camera)
    pose = camera.camera_to_world.numpy()
    position = pose[:3, 3] + pose[:3, :3] @ [3.0, -2.0, 1.0]
    up, right = math.radians(20), math.radians(-10)
    turned_up = np.array([0.0, -math.sin(up), math.cos(up)])  # about x: towards -y
    about_y = np.array([[math.cos(right), 0, math.sin(right)], [0, 1, 0], [-math.sin(right), 0, math.cos(right)]])
    axis = pose[:3, :3] @ about_y @ turned_up
    expected = expected_colors(field, lit, camera, position, lambda out: 1.5 * max(out @ axis, 0.0) ** 6.0)
    torch.testing.assert_close(lit.colors, expected, rtol=2e-4, atol=1e-5)
    assert not torch.allclose(lit.colors, gaussians.colors, atol=0.05)
    assert torch.equal(field.gaussians(camera).colors, gaussians.colors)


def test_a_lamp_that_shines_away_lights_nothing():
    gaussians = varied().with_lamp(Lamp(turn=(0.0, 180.0), power=1.0)).gaussians(camera_at(0, 0, 0))
    torch.testing.assert_close(gaussians.colors, torch.full_like(gaussians.colors, 1e-6 ** (1 / GAMMA)))


def test_flat_faint_discs_with_mixed_linear_colours_at_the_points():
    scene = colored_wall()
    field = make(scene, pink_share=0.25)
    gaussians = field.gaussians(camera_at(0, 0, -50))
    torch.testing.assert_close(gaussians.opacities, torch.full((len(gaussians),), 0.1))
    assert torch.equal(gaussians.scales[:, 2], torch.full((len(gaussians),), THICKNESS))
    assert field.scales.shape[1] == 2
    stored = scene.points.colors[gaussians.source_index] / 255.0
    mixed = 0.75 * stored + 0.25 * torch.tensor(PINK)
    torch.testing.assert_close(gaussians.features["albedo"], mixed.pow(GAMMA))
    assert field.extent.item() == pytest.approx(scene.extent)


def test_points_without_colours_are_pink_and_cameras_that_do_not_move_are_refused(caplog):
    albedos = make(wall_scene()).albedos
    torch.testing.assert_close(albedos, torch.tensor(PINK).pow(GAMMA).expand_as(albedos))
    assert "no colours" in caplog.text
    scene = colored_wall()
    with pytest.raises(InputError, match="at one place"):
        make(replace(scene, train=scene.train[:1]))
    with pytest.raises(InputError, match="no initial points"):
        make(replace(scene, points=PointCloud(torch.zeros(0, 3))))


@pytest.mark.parametrize(
    "option", [{"roughness_range": (0.7, 0.1)}, {"roughness_range": (0.0, 0.7)}, {"f0_range": (0, 2)}]
)
def test_ranges_ascend(option):
    with pytest.raises(ValidationError, match="expected two numbers that ascend"):
        make(**{name: tuple(map(float, value)) for name, value in option.items()})


def test_the_network_is_inert_until_its_step():
    field, camera = make(), camera_at(0, 0, 0)
    field.before_step(50, SCHEDULE)
    before = field.gaussians(camera)
    before.colors.sum().backward()
    assert torch.equal(before.features["diffuse_factor"], torch.ones(len(before), 3))
    assert all(weight.grad is None for weight in field.diffuse_network.parameters())
    with torch.no_grad():
        for weight in field.diffuse_network.parameters():
            weight.add_(1.0)
    assert torch.equal(field.gaussians(camera).colors, before.colors)
    field.before_step(51, SCHEDULE)
    field.gaussians(camera).colors.sum().backward()
    assert all(weight.grad.abs().sum() > 0 for weight in field.diffuse_network.parameters())
    field.before_step(51, Schedule(200, 100))  # at step 100 of a run of twice the length
    assert torch.equal(field.gaussians(camera).features["diffuse_factor"], before.features["diffuse_factor"])


def test_a_new_network_changes_little():
    field, camera = make(hidden=128, hidden_layers=3), camera_at(0, 0, 0)
    field.before_step(51, SCHEDULE)
    assert (field.gaussians(camera).features["diffuse_factor"] - 1).abs().max() < 0.25


def test_factors_multiply_the_diffuse_light_alone():
    field, camera = trained(), camera_at(0, 0, 0)
    with torch.no_grad():
        whole = field.gaussians(camera)
        field.albedos.zero_()
        mirrored = field.gaussians(camera).colors.pow(GAMMA)
        diffuse = whole.colors.pow(GAMMA) - mirrored
        field.albedos.copy_(trained().albedos)
        field.network_on.fill_(False)
        plain = field.gaussians(camera).colors.pow(GAMMA) - mirrored
    factors = whole.features["diffuse_factor"].clamp_min(0.0)
    assert factors.std() > 0.05
    torch.testing.assert_close(diffuse, plain * factors, rtol=1e-3, atol=1e-5)


def in_training(field, seed=5):
    return field.gaussians(camera_at(0, 0, 0), generator=torch.Generator().manual_seed(seed))


def test_noise_is_of_training_alone_and_the_generators():
    field = trained()
    noisy, again, other = (in_training(field, seed).features["diffuse_factor"] for seed in (5, 5, 6))
    assert torch.equal(noisy, again) and not torch.equal(noisy, other)
    clean = field.gaussians(camera_at(0, 0, 0)).features["diffuse_factor"]
    assert 0 < (noisy - clean).abs().mean() < 0.01
    silent = trained(input_noise=0.0, network_precision="float32")
    torch.testing.assert_close(in_training(silent).features["diffuse_factor"], clean)


def test_half_precision_is_of_training_alone_and_changes_little():
    camera = camera_at(0, 0, 0)
    full, half = trained(network_precision="float32"), trained(network_precision="bfloat16")
    difference = (in_training(full).colors - in_training(half).colors).abs()
    assert 0 < difference.max() < 0.01
    assert torch.equal(full.gaussians(camera).colors, half.gaussians(camera).colors)


def test_parameters_return_from_beyond_their_bounds_with_a_gradient():
    field, camera = make(), camera_at(0, 0, 0)
    with torch.no_grad():
        field.f0.fill_(0.05)
        field.roughness.fill_(0.9)
        field.albedos.fill_(-0.1)
        field.scales.fill_(9.0)
        field.lamp_parameters[1] = -1.0
    field._in_view = lambda camera: torch.ones(len(field.means), dtype=torch.bool)
    drawn = field.gaussians(camera)
    assert drawn.features["f0"].max().item() == pytest.approx(0.035)
    assert drawn.features["roughness"].max().item() == pytest.approx(0.7)
    assert drawn.features["albedo"].min() == 0.0
    assert drawn.scales.max().item() == pytest.approx(0.1 * field.extent.item())
    field.before_step(1, SCHEDULE)
    again = field.gaussians(camera)
    assert torch.equal(again.colors, drawn.colors)
    (again.colors.sum() + again.scales.sum()).backward()
    for name in ("f0", "roughness", "albedos", "scales"):
        assert getattr(field, name).grad.abs().sum() > 0, name
    assert field.lamp_parameters.tolist() == [2.0, 0.0, 2.0]


def test_gradients_are_those_of_finite_differences():
    field = trained(input_noise=0.0).double()
    camera = camera_at(0.5, -1.0, 4.0)

    def value():
        gaussians = field.gaussians(camera)
        weights = torch.linspace(0.5, 1.5, len(gaussians), dtype=torch.float64)[:, None]
        return (weights * gaussians.colors).sum()

    value().backward()
    row = field.gaussians(camera).source_index[40]
    lamp, weight = field.lamp_parameters, field.diffuse_network.layers[0].weight
    checked = [(getattr(field, name), (row,)) for name in ("roughness", "f0")]
    checked += [(getattr(field, name), (row, 1)) for name in ("means", "quats", "albedos")]
    checked += [(lamp, (index,)) for index in range(3)] + [(weight, (2, 5))]
    for parameter, index in checked:
        with torch.no_grad():
            step, ends = 1e-6, []
            for sign in (1, -1):
                parameter[index] += sign * step
                ends.append(value().item())
                parameter[index] -= sign * step
        assert parameter.grad[index].item() == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-4, abs=1e-7)


def test_names_and_the_gradient_of_the_pose():
    field, camera = varied(), camera_at(0, 0, 0)
    rows = ["means", "scales", "quats", "opacities", "albedos", "roughness", "f0"]
    assert list(field.parameter_groups()) == [*rows, "lamp", "diffuse_network"]
    pose = camera.camera_to_world.float().requires_grad_()
    gaussians = field.gaussians(replace(camera, camera_to_world=pose))
    gaussians.colors.sum().backward()
    assert pose.grad[:3, 3].abs().min() > 0
    assert gaussians.features.keys() == field.feature_channels == {"albedo", "diffuse_factor", "f0", "roughness"}
    output = render_gaussians(gaussians, camera, tuple(field.feature_channels))
    assert 0.1 < (output["roughness"][12, 16] / output.alpha[12, 16]).item() < 0.6


def test_gaussians_too_faint_to_be_drawn_are_left_out(monkeypatch):
    field, camera = varied(), camera_at(0.3, 0.2, 3.0, yaw=0.3)
    with torch.no_grad():
        field.opacities[::3] = math.log(0.999 / 254)  # just below 1/255
        field.opacities[1::3] = 2.0
    gaussians = field.gaussians(camera)
    assert not (gaussians.source_index % 3 == 0).any()
    monkeypatch.setattr(lit_gaussians, "MIN_OPACITY", 0.0)
    everything = field.gaussians(camera)
    assert len(gaussians) < len(everything)
    images = [render_gaussians(each, camera).rgb for each in (gaussians, everything)]
    torch.testing.assert_close(*images, rtol=0, atol=2e-6)


def test_padding_of_reduced_products_changes_no_gradient():
    network = DiffuseNetwork(16, 2, "bfloat16", torch.Generator().manual_seed(0))
    inputs = [torch.rand(50, width, generator=torch.Generator().manual_seed(width)) for width in (3, 1, 3, 3)]
    network(*inputs, True).sum().backward()
    padded = [parameter.grad.clone() for parameter in network.parameters()]
    network.zero_grad()
    network(*(value.repeat(_ROWS // 50 + 1, 1)[:_ROWS] for value in inputs), True)[:50].sum().backward()
    for parameter, gradient in zip(network.parameters(), padded, strict=True):
        torch.testing.assert_close(parameter.grad, gradient, rtol=2e-2, atol=1e-3)
    assert padded[-1].tolist() == [50.0] * 3


# Reflectance: the published formulas and reciprocity


UP = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)


def double(*values):
    return torch.tensor(values, dtype=torch.float64)


def direction(polar, azimuth):
    return double(math.sin(polar) * math.cos(azimuth), math.sin(polar) * math.sin(azimuth), math.cos(polar))[None]


def brdf(view, lamp, roughness, f0):
    """Diffuse of albedo 1, and specular. 1 / sr"""
    cosines = Cosines.of(UP, view, lamp)
    terms = reflection(cosines, double(f0), double(roughness))
    return [(term / cosines.normal_lamp).item() for term in terms]


def by_hand(view, lamp, normal, roughness, f0):
    """The published formulas, on vectors of three numbers."""
    view, lamp, normal = (np.asarray(v, float) / np.linalg.norm(v) for v in (view, lamp, normal))
    half = (view + lamp) / np.linalg.norm(view + lamp)
    nv, nl, nh, hv = normal @ view, normal @ lamp, normal @ half, half @ view
    f = f0 + (1 - f0) * (1 - hv) ** 5
    a2 = roughness**4
    d = a2 / (math.pi * (nh**2 * (a2 - 1) + 1) ** 2)
    k = (roughness + 1) ** 2 / 8
    g = nv / (nv * (1 - k) + k) * nl / (nl * (1 - k) + k)
    return (1 - f) / math.pi * nl, nl * f * d * g / (4 * nv * nl)


angles = st.floats(0.0, 1.5), st.floats(0.0, 6.3)


@given(*angles, *angles, st.floats(0.05, 0.7), st.floats(0.0, 0.035))
def test_the_published_formulas_and_reciprocity(view_polar, view_azimuth, lamp_polar, lamp_azimuth, roughness, f0):
    view, lamp = direction(view_polar, view_azimuth), direction(lamp_polar, lamp_azimuth)
    there = brdf(view, lamp, roughness, f0)
    expected = np.array(by_hand(view[0].numpy(), lamp[0].numpy(), UP[0].numpy(), roughness, f0))
    assert there == pytest.approx(expected / math.cos(lamp_polar), rel=1e-6)
    assert there == pytest.approx(brdf(lamp, view, roughness, f0), rel=1e-9)


def test_gradients_are_those_of_finite_differences_and_finite_at_grazing_angles():
    view, lamp = direction(0.6, 0.2), direction(0.9, 2.0)
    roughness, f0 = double(0.4).requires_grad_(), double(0.03).requires_grad_()
    normal = torch.nn.functional.normalize(double(0.1, -0.2, 1.0)[None]).requires_grad_()

    def value(normal, view, lamp, roughness, f0):
        return sum(reflection(Cosines.of(normal, view, lamp), f0, roughness))

    torch.autograd.gradcheck(value, (normal, view.requires_grad_(), lamp.requires_grad_(), roughness, f0))
    grazing = direction(math.pi / 2, 0.0)
    value(normal, grazing, lamp, roughness, f0).sum().backward()
    assert all(tensor.grad.isfinite().all() for tensor in (normal, roughness, f0))
