"""REIM-NeRF: sizes by hand, the lamp, units of length, refusals, and training."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from pydantic import ValidationError

from coliags_plugin.config.method_config import load_method
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.provenance import Provenance
from coliags_plugin.core.scenes import Frame, PointCloud, Scene
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.engine.trainer import Trainer
from coliags_plugin.fields.mlp import cosine_embedding
from coliags_plugin.fields.reim_nerf import RadianceMLP, ReimNerf, ReimNerfFieldSettings, surface_distances
from coliags_plugin.renderers.volume_renderer import VolumeRenderer, VolumeRendererSettings
from tests.scenes import camera_at, wall_scene

SMALL = {"layers": 3, "width": 32, "skip": 1, "color_width": 16}


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def make(scene=None, **options):
    settings = ReimNerfFieldSettings(**{**SMALL, **options})
    return ReimNerf.from_scene(scene or wall_scene(), settings, generator())


# ------------------------------------------------------------------------------------------------------------- network


def test_published_layers_and_parameters():
    network = RadianceMLP(ReimNerfFieldSettings(), generator())
    assert [layer.in_features for layer in network.trunk] == [63, 256, 256, 256, 256 + 63, 256, 256, 256]
    assert network.color.in_features == 256 + 27 + 27 and network.color.out_features == 128
    by_hand = (63 + 1) * 256 + 6 * (256 + 1) * 256 + (256 + 63 + 1) * 256  # trunk
    by_hand += (256 + 1) + (256 + 1) * 256 + (256 + 54 + 1) * 128 + (128 + 1) * 3  # density, feature, colour, rgb
    assert sum(value.numel() for value in network.parameters()) == by_hand == 599_300
    bound = math.sqrt(6 / (256 + 256))
    assert 0.98 * bound < network.trunk[1].weight.abs().max() <= bound and not network.trunk[1].bias.any()
    plain = RadianceMLP(ReimNerfFieldSettings(light=False), generator())
    assert plain.color.in_features == 256 + 27


@pytest.mark.parametrize("light", [True, False])
def test_the_network_is_that_of_a_plain_forward_pass(light):
    """Network as it is usually written: everything concatenated, one layer after the other."""
    settings = ReimNerfFieldSettings(**SMALL, light=light)
    network = RadianceMLP(settings, generator()).double()
    with torch.no_grad():
        for value in network.parameters():
            value.add_(0.1 * torch.randn(value.shape, generator=generator(1), dtype=torch.float64))
    positions = torch.rand(5, 7, 3, generator=generator(2), dtype=torch.float64) * 2 - 1
    directions = torch.nn.functional.normalize(torch.randn(5, 3, generator=generator(3), dtype=torch.float64), dim=1)
    lamp = torch.tensor([0.2, -0.4, 0.9], dtype=torch.float64)
    embedded = cosine_embedding(positions, 10)
    hidden = network.trunk[0](embedded).relu()
    hidden = network.trunk[1](torch.cat([hidden, embedded], -1)).relu()
    hidden = network.trunk[2](hidden).relu()
    seen = [cosine_embedding(directions, 4), *([cosine_embedding(lamp, 4).expand(5, -1)] if light else [])]
    per_point = torch.cat(seen, -1)[:, None].expand(-1, 7, -1)
    rgb = network.rgb(network.color(torch.cat([network.feature(hidden), per_point], -1)).relu()).sigmoid()
    found = network.hidden(positions)
    torch.testing.assert_close(network.densities(found, 5), network.density(hidden)[..., 0].relu())
    torch.testing.assert_close(network.colors(found, directions, lamp), rgb)
    ours = torch.autograd.grad(network.colors(network.hidden(positions), directions, lamp).sum(), network.color.weight)
    theirs = torch.autograd.grad(rgb.sum(), network.color.weight)
    torch.testing.assert_close(ours, theirs)


def test_the_lamp_changes_colours_and_not_densities():
    positions = torch.rand(4, 6, 3, generator=generator()) * 10 + torch.tensor([0.0, 0.0, 10.0])
    directions = torch.nn.functional.normalize(torch.randn(4, 3, generator=generator(1)), dim=1)
    here, there = camera_at(0, 0, 0), camera_at(3, -2, 1)
    for light in (True, False):
        field = make(light=light).float()
        first, second = (field.query(positions, directions, camera.to(dtype=torch.float32)) for camera in (here, there))
        assert torch.equal(first.density, second.density)
        assert torch.equal(first.rgb, second.rgb) != light
        assert torch.equal(first.density, field.query_density(positions, directions, here))


def test_bfloat16_is_of_rendering_alone():
    positions = torch.rand(64, 8, 3, generator=generator()) * 10 + torch.tensor([0.0, 0.0, 10.0])
    directions = torch.nn.functional.normalize(torch.randn(64, 3, generator=generator(1)), dim=1)
    camera = camera_at(0, 0, 0).to(dtype=torch.float32)
    full, half = (make(render_precision=precision, density_noise=0.0).float() for precision in ("float32", "bfloat16"))
    where = (positions, directions, camera)
    trained, drawn = ([field.query(*where), field.query(*where, generator())] for field in (full, half))
    for one, other in zip(trained, drawn, strict=True):
        assert torch.equal(one.density, other.density) and torch.equal(one.rgb, other.rgb)
    with torch.no_grad():
        exact, reduced = (field.query(*where) for field in (full, half))
        still = half.query(*where, generator())
    assert torch.equal(exact.density, trained[0].density) and torch.equal(still.density, trained[0].density)
    assert reduced.density.dtype == reduced.rgb.dtype == torch.float32
    for one, other in ((exact.density, reduced.density), (exact.rgb, reduced.rgb)):
        assert not torch.equal(one, other)
        torch.testing.assert_close(one, other, rtol=0, atol=float(0.01 * one.max()))


# ----------------------------------------------------------------------------------------------------- units of length


def moved(scene, factor, shift):
    """A scene in other units and elsewhere."""

    def placed(frame):
        pose = frame.camera.camera_to_world.clone()
        pose[:3, 3] = factor * pose[:3, 3] + shift
        return replace(frame.with_maps(depth=frame.depth * factor), camera=replace(frame.camera, camera_to_world=pose))

    points = PointCloud(factor * scene.points.positions.double() + shift)
    return replace(scene, train=[placed(frame) for frame in scene.train], points=points)


def test_a_scene_in_other_units_elsewhere_looks_the_same():
    scene, factor, shift = wall_scene(), 8.0, torch.tensor([40.0, -30.0, 10.0], dtype=torch.float64)
    other = moved(scene, factor, shift)
    fields = [make(s).double() for s in (replace(scene, points=PointCloud(scene.points.positions.double())), other)]
    for field in fields:
        field.load_state_dict(field.state_dict() | {k: v for k, v in fields[0].state_dict().items() if "network" in k})
    renderer = VolumeRenderer(
        VolumeRendererSettings(far_plane=None, spacing="distance", samples=16, importance_samples=16)
    )
    wants = ("depth_accumulated", "rgb_coarse")
    ours, theirs = (
        renderer.render(field, replace(s.train[3].camera, near_plane=0.0), wants)
        for field, s in zip(fields, (scene, other), strict=True)
    )
    assert 0.01 < ours.alpha.mean() < 0.9999
    torch.testing.assert_close(theirs.rgb, ours.rgb, rtol=0, atol=2e-5)
    torch.testing.assert_close(theirs.alpha, ours.alpha, rtol=0, atol=2e-5)
    torch.testing.assert_close(theirs["depth_accumulated"], factor * ours["depth_accumulated"], rtol=1e-4, atol=1e-3)
    assert float(fields[1].length_unit) == pytest.approx(factor * float(fields[0].length_unit))


def test_points_are_centred_and_the_largest_coordinate_is_one():
    scene = wall_scene()
    field = make(scene)
    inside = field.normalisation(scene.points.positions)
    assert inside.abs().max().item() == pytest.approx(1.0)
    assert inside.mean(0).abs().max().item() < 1e-5


def test_rays_reach_a_tenth_beyond_the_points_in_view():
    scene = wall_scene()
    points = torch.tensor([[0.0, 0.0, 20.0], [0.0, 0.0, -5.0], [4.0, 1.0, 28.0], [300.0, 0.0, 20.0]])
    near, far = surface_distances(replace(scene, points=PointCloud(points))).tolist()
    distances = [(points[[0, 2]].double() - frame.camera.center).norm(dim=1) for frame in scene.train]
    assert near == pytest.approx(0.9 * min(pair.min().item() for pair in distances))
    assert far == pytest.approx(1.1 * max(pair.max().item() for pair in distances))


# ------------------------------------------------------------------------------------------------------------ refusals


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda scene: replace(scene, train=scene.train[:1]), "1 training frame of scene 'wall'"),
        (lambda scene: replace(scene, points=PointCloud(torch.zeros(0, 3))), "no initial points"),
        (lambda scene: replace(scene, points=PointCloud(torch.ones(5, 3))), "all at one place"),
        (
            lambda scene: replace(scene, points=PointCloud(scene.points.positions * torch.tensor([1.0, 1.0, -1.0]))),
            "no training camera has an initial point in view",
        ),
    ],
)
def test_scenes_that_will_not_do_are_refused(tmp_path, change, message):
    with pytest.raises(InputError, match=message):
        trainer(tmp_path / "run", scene=change(wall_scene()))
    assert not (tmp_path / "run").exists()


def test_other_refusals(tmp_path):
    with pytest.raises(ValidationError, match="skip 3 with layers 3"):
        ReimNerfFieldSettings(layers=3, skip=3)
    for override, message in (
        ("near_plane=500.0", r"start at 500 and end at"),
        ("losses.more={name: d-ssim, weight: 0.2}", "loss term 'more' needs whole images"),
        ("losses.more={name: scale-volume, weight: 0.2}", "loss term 'more' is about Gaussians"),
    ):
        with pytest.raises(InputError, match=message):
            trainer(tmp_path / "run", [override])
    with pytest.raises(InputError, match="outputs needed by the losses: rgb_coarse"):
        load = load_method("3dgs", ["losses.l1={name: mse, weight: 1.0, image: rgb_coarse}"])
        Trainer(load, wall_scene(), "wall", RunFolder(tmp_path / "run"), 0, torch.device("cpu"))
    assert not (tmp_path / "run").exists()


# ------------------------------------------------------------------------------------------------------------ training

TINY = (
    *(f"field.{key}={value}" for key, value in SMALL.items()),
    "field.position_frequencies=4",
    "renderer.samples=16",
    "renderer.importance_samples=16",
    "sampler.pixels=128",
    "sampler.frames=4",
    "schedule.log_every=1",
    "optimizers.coarse.lr=0.005",
    "optimizers.fine.lr=0.005",
)


def trainer(folder, overrides=(), scene=None, steps=20):
    method = load_method("reim-nerf", [*TINY, f"schedule.steps={steps}", *overrides])
    return Trainer(method, scene or wall_scene(), "wall", RunFolder(folder), 0, torch.device("cpu"))


def test_noise_and_jitter_are_of_training_alone(tmp_path):
    even = ["renderer.jitter=false", "field.render_precision=float32"]
    run = trainer(tmp_path / "run", even)
    camera, pixels = wall_scene().train[0].camera, torch.tensor([[4, 5], [20, 12]])
    still = run.model.render(camera, pixels=pixels)
    noisy = [run.model.render(camera, pixels=pixels, generator=generator(seed)) for seed in (0, 0, 1)]
    assert torch.equal(noisy[0].rgb, noisy[1].rgb) and not torch.equal(noisy[0].rgb, noisy[2].rgb)
    assert torch.equal(still.rgb, run.model.render(camera, pixels=pixels).rgb)
    silent = trainer(tmp_path / "run", [*even, "field.density_noise=0.0"])
    silent = silent.model.render(camera, pixels=pixels, generator=generator())
    assert torch.equal(silent.rgb, still.rgb)


def sphere_scene():
    """A ball of radius 1, red above, green to the left and blue in front, before black, seen from a ring."""
    frames = []
    for index in range(12):
        angle = 2 * math.pi * index / 12
        camera = camera_at(-6 * math.sin(angle), 0.8 * math.sin(3 * angle), -6 * math.cos(angle), 40, 32, yaw=angle)
        rays = torch.nn.functional.normalize(camera.rays(), dim=-1)
        along = -(rays * camera.center).sum(-1)
        nearest = (camera.center + along[..., None] * rays).norm(dim=-1)
        reach = along - (1 - nearest.clamp_max(1) ** 2).sqrt()
        points = camera.center + reach[..., None] * rays
        color = torch.where(nearest[..., None] < 1, 0.5 + 0.4 * points, 0.0)
        depth = torch.where(nearest < 1, reach / camera.rays().norm(dim=-1), torch.nan).float()
        image = (255 * color.clamp(0, 1)).round().to(torch.uint8)
        frames.append(Frame.of(f"{index:04d}", index, image, camera, depth))
    train, test = [f for f in frames if f.index % 6], [f for f in frames if f.index % 6 == 0]
    points = torch.cat([f.camera.unproject(f.depth.double())[f.depth.isfinite()] for f in train])
    return Scene("ball", train, {"test": test}, PointCloud(points), Provenance(fingerprint="ball"))


@pytest.mark.thorough
def test_a_ball_is_learnt_in_colour_and_depth(tmp_path):
    scene = sphere_scene()
    options = ["losses.depth.share=1.0", "losses.depth-coarse.share=1.0", "renderer.opaque_end=false"]
    options += ["sampler.pixels=320", "sampler.frames=10", "field.density_noise=0.0"]
    options += ["optimizers.coarse.lr=0.01", "optimizers.fine.lr=0.01"]
    run = trainer(tmp_path / "run", options, scene, steps=200)
    rows = [run.take_step() for _ in range(200)]
    assert sum(row["psnr"] for row in rows[-10:]) / 10 > 22 and "gaussians" not in rows[0]
    for frame, error in ((scene.train[0], 0.1), (scene.test_sets["test"][1], 0.4)):  # of a ball of radius 1, 6 away
        with torch.no_grad():
            output = run.model.render(frame.camera, ("depth_accumulated",))
        hit = frame.depth.isfinite()
        assert output.alpha[hit].mean() > 0.95
        assert (output["depth_accumulated"] - frame.depth)[hit].abs().median() < error


def test_rates_are_halved_at_shares_of_the_run(tmp_path):
    run = trainer(tmp_path / "run", steps=8)
    rates = [run.optimizers.rate("fine", step) for step in range(1, 9)]
    assert rates == [0.005] * 4 + [0.0025] * 2 + [0.00125] * 2
    assert {group["eps"] for adam in run.optimizers.adam.values() for group in adam.param_groups} == {1e-8}
    with pytest.raises(InputError, match="halve_at"):
        load_method("reim-nerf", ["optimizers.fine.halve_at=[1.5]"])
