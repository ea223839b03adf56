"""Gains and fall-off fitted to surface points before training."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import replace
from functools import cache

import pytest
import torch

from coliags_plugin.api.scenes import load_scene
from coliags_plugin.core.components import make_component
from coliags_plugin.core.photometry import Cavity, fit_light
from coliags_plugin.core.scenes import Frame, PointCloud
from coliags_plugin.modules.exposure import FrameGain
from coliags_plugin.phantom.generate import generate
from coliags_plugin.phantom.settings import PhantomSettings
from tests.scenes import camera_at, wall_color, wall_scene


def wall(every=3, **options):
    """The wall with every third of its points, which are enough."""
    scene = wall_scene(**options)
    return replace(scene, points=PointCloud(scene.points.positions[::every]))


def gained(gains, every=5, **options):
    """The wall, lit by a lamp at the camera, with the images of the training frames multiplied by gains."""
    scene = wall(every, width=64, height=48, **options)
    train = [
        frame.with_maps(image=(frame.rgb * gain * 255).round().to(torch.uint8))
        for frame, gain in zip(scene.train, gains, strict=True)
    ]
    return replace(scene, train=train)


GAINS = torch.tensor([0.8, 0.5, 0.7, 0.9, 0.6, 0.75, 0.65])


def test_wrong_depth_and_masked_or_clipped_pixels_do_not_count():
    scene = gained(GAINS)
    spoilt = list(scene.train)
    image, mask = spoilt[2].image.clone(), torch.ones(48, 64, dtype=torch.bool)
    image[:20], mask[:20] = 120, False
    image[20:30] = 255
    depth = spoilt[2].depth.clone()
    depth[30:36], image[30:36] = 11.0, 90
    spoilt[2] = spoilt[2].with_maps(image=image, mask=mask, depth=depth)
    fit = fit_light(replace(scene, train=spoilt)).log_gains
    torch.testing.assert_close(fit, GAINS.log() - GAINS.log().mean(), atol=0.015, rtol=0.0)


def test_frames_that_show_nothing_known():
    scene = gained(GAINS, every=12)
    black = scene.train[3].with_maps(image=torch.zeros_like(scene.train[3].image))
    fit = fit_light(replace(scene, train=[*scene.train[:3], black, *scene.train[4:]])).log_gains
    assert fit.isfinite().all() and fit.abs().max() < 1.0
    hidden = [frame.with_maps(mask=torch.zeros(48, 64, dtype=torch.bool)) for frame in scene.train]
    fit = fit_light(replace(scene, train=hidden))
    assert fit.log_gains.tolist() == [0.0] * 7 and fit.cosine_exponents.tolist() == [0.0] * 3


def test_masked_pixels_have_no_influence_to_the_bit():
    scene = gained(GAINS, every=12)
    mask = torch.ones(48, 64, dtype=torch.bool)
    mask[10:30, 5:40] = False
    masked = [frame.with_maps(mask=mask) for frame in scene.train]
    painted = []
    for frame in masked:
        image, depth = frame.image.clone(), frame.depth.clone()
        image[~mask], depth[~mask] = 200, torch.nan
        painted.append(frame.with_maps(image=image, depth=depth))
    first, second = (fit_light(replace(scene, train=frames)) for frames in (masked, painted))
    assert torch.equal(first.log_gains, second.log_gains)
    assert torch.equal(first.cosine_exponents, second.cosine_exponents)


def test_the_module_starts_with_them_where_there_is_depth():
    settings = FrameGain.Settings(channels=3, initial="points")
    module = FrameGain(settings, gained(GAINS))
    assert module.log_gains().exp().tolist() == [[1.0] * 3] * 7
    module.prepare(gained(GAINS))
    expected = (GAINS.log() - GAINS.log().mean()).exp()
    for channel in module.log_gains().exp().detach().T:
        assert channel.tolist() == pytest.approx(expected.tolist(), rel=0.015)
    before = module.log_gains().exp().detach().log()
    optimizer = torch.optim.SGD(module.parameters(), lr=1.0)
    module.log_gains()[2].sum().backward()
    optimizer.step()
    # The sum of three logarithms, relative to their mean over seven frames: both factors are a tenth.
    moved = (module.log_gains().exp().detach().log() - before).abs().max()
    assert moved.item() == pytest.approx(0.1 * 0.1 * 6 / 7, rel=1e-3)
    without = FrameGain(settings, gained(GAINS, depth=False))
    without.prepare(gained(GAINS, depth=False))
    assert without.log_gains().exp().tolist() == [[1.0] * 3] * 7
    few = replace(wall_scene(), train=wall_scene().train[:2])
    assert fit_light(few) is None
    estimated = [frame.with_maps(depth_confidence=torch.ones_like(frame.depth)) for frame in wall_scene().train]
    assert fit_light(replace(wall_scene(), train=estimated)) is None


OFFSET = torch.tensor([1.0, -0.5, -2.5], dtype=torch.float64)
EXPONENTS = {"cosine": [0.4, 0.8, 1.2], "incidence": [0.1, 0.3, 0.5]}


@cache
def lit_wall(offset, frames=24):
    """The wall, seen from 6 to 15 mm away at all angles, under a lamp beside the lens, with gains."""
    scene = wall(width=96, height=72)
    exponents = {name: torch.tensor(values, dtype=torch.float64) for name, values in EXPONENTS.items()}
    train, gains = [], 0.8 + 0.2 * torch.sin(torch.arange(frames, dtype=torch.float64))
    for index, gain in enumerate(gains):
        x, z, yaw = 5.0 * math.sin(0.7 * index), 9.5 + 4.5 * math.sin(1.1 * index), 0.6 * math.sin(1.9 * index)
        camera = camera_at(x, 2.0 * math.cos(0.9 * index), z, 96, 72, yaw)
        depth = (20.0 - z) / camera.rays()[..., 2]
        points = camera.center + depth[..., None] * camera.rays()
        rays = (points - camera.center) @ camera.camera_to_world[:3, :3] - offset
        lengths = rays.norm(dim=-1, keepdim=True)
        facing = (rays @ camera.camera_to_world[2, :3])[..., None] / lengths
        light = (lengths / 14.0) ** (-2 / 2.2) * (rays[..., 2:] / lengths) ** exponents["cosine"]
        rgb = 0.6 * gain * wall_color(points) * light * facing ** exponents["incidence"]
        image = (rgb.clamp(0.0, 1.0) * 255).round().to(torch.uint8)
        train.append(Frame.of(f"{index:04d}", index, image, camera, depth.float()))
    return replace(scene, train=train), gains.log() - gains.log().mean()


@pytest.mark.parametrize("offset", [OFFSET, torch.zeros(3, dtype=torch.float64)])
def test_lamp_and_exponents_and_gains_are_found(offset):
    scene, log_gains = lit_wall(offset)
    fit = fit_light(scene)
    torch.testing.assert_close(fit.lamp_offset.double(), offset, atol=0.1, rtol=0.0)
    torch.testing.assert_close(fit.cosine_exponents, torch.tensor(EXPONENTS["cosine"]), atol=0.06, rtol=0.0)
    torch.testing.assert_close(fit.incidence_exponents, torch.tensor(EXPONENTS["incidence"]), atol=0.06, rtol=0.0)
    torch.testing.assert_close(fit.log_gains.double(), log_gains, atol=0.01, rtol=0.0)


@pytest.mark.thorough
def test_a_wall_that_lights_itself(tmp_path):
    """Fit on a phantom's wall, whose gains err by 3 % where its interreflections are not part of the fit."""
    size = {"width": 96, "height": 77, "supersampling": 1, "mesh_spacing": 1.0, "texture_spacing": 0.4}
    settings = PhantomSettings(seed=4, trajectory="inspection", frames=30, rotation_views=0, specular=0.0, **size)
    generate(settings, tmp_path / "phantom")
    scene, truth = load_scene(tmp_path / "phantom"), json.loads((tmp_path / "phantom/truth/light.json").read_text())
    with (tmp_path / "phantom/truth/gain.csv").open() as rows:
        gains = {int(row["frame"]): float(row["gain_g"]) for row in csv.DictReader(rows)}
    expected = torch.tensor([gains[frame.index] for frame in scene.train]).log() / truth["gamma"]
    fit = fit_light(scene)
    assert fit_light(scene.with_near_plane(scene.train[0].camera.near_plane)) is fit, "once for all of its runs"
    errors = fit.log_gains - expected
    assert float((errors - errors.mean()).square().mean().sqrt()) < 0.015
    torch.testing.assert_close(fit.lamp_offset, torch.tensor(truth["lamp"]["offset"]).float(), atol=0.5, rtol=0.0)
    # Albedo of green .29; mutual visibility of folds is neglected.
    assert fit.albedo == pytest.approx(0.35, abs=0.1)


@pytest.mark.parametrize("channels", [1, 3])
def test_a_law_starts_with_what_was_found(channels):
    scene, _ = lit_wall(OFFSET)
    appearance = {"name": "attenuated", "head": "plain", "channels": channels, "initial": "points"}
    node = {"name": "anchors", "geometry_head": "plain", "appearance_head": {**appearance, "incidence_exponent": 0.0}}
    component = make_component("fields", node)
    learned = component.target.from_scene(scene, component.settings, torch.Generator()).learned
    for name, exponents in EXPONENTS.items():
        expected = exponents if channels == 3 else [sum(exponents) / 3]
        assert learned[f"{name}_exponent"] == pytest.approx(expected, abs=0.06)
    assert learned["lamp_offset"] == pytest.approx(OFFSET.tolist(), abs=0.1)


# Radiosity of walls whose form factors are known


def sphere(count, radius):
    """Points spread evenly over a sphere, and normals that point to its centre."""
    index = torch.arange(count, dtype=torch.float64) + 0.5
    height, turn = 1.0 - 2.0 * index / count, math.pi * (1.0 + math.sqrt(5.0)) * index
    across = (1.0 - height.square()).sqrt()
    outward = torch.stack([across * turn.cos(), across * turn.sin(), height], dim=-1)
    return radius * outward, -outward


@pytest.mark.parametrize("albedo", [0.0, 0.3, 0.5])
def test_a_sphere_lights_every_point_alike(albedo):
    """The form factor in a sphere of a patch is its share of the area: irradiance of all, from any light."""
    points, normals = sphere(2400, 25.0)
    cavity = Cavity.of(points, normals)
    direct = torch.zeros(len(points[:: cavity.every]), 2, dtype=torch.float64)
    direct[:, 0], direct[:100, 1] = 3.0, 5.0
    irradiance = cavity.indirect(direct, albedo)
    reflections = sum(albedo**bounce for bounce in range(1, 6))
    expected = reflections * direct.mean(0).expand_as(irradiance)
    torch.testing.assert_close(irradiance[:, 0], expected[:, 0], rtol=0.05, atol=1e-9)
    # Near patches are discs, not points: a few points are nearly on one.
    torch.testing.assert_close(irradiance[:, 1].median(), expected[0, 1], rtol=0.05, atol=1e-9)


def test_what_is_flat_or_faces_away_gets_nothing():
    grid = torch.cartesian_prod(torch.arange(20.0), torch.arange(20.0)).double()
    flat = torch.cat([grid, torch.zeros(400, 1, dtype=torch.float64)], dim=1)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(400, 3)
    direct = torch.ones(400, 1, dtype=torch.float64)
    assert Cavity.of(flat, up).indirect(direct, 0.5).abs().max() == 0.0
    points, normals = sphere(400, 10.0)
    assert Cavity.of(points, -normals).indirect(direct, 0.5).abs().max() == 0.0
    points, normals = sphere(3, 10.0)
    assert Cavity.of(points, normals).indirect(direct[:3], 0.5).isfinite().all()
