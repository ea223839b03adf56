"""Volume rendering against closed forms, and a small radiance field trained on batches of pixels."""

from __future__ import annotations

import math

import pytest
import torch
from torch import nn

from coliags_plugin.config import registry
from coliags_plugin.config.method_config import load_method
from coliags_plugin.contracts import RadianceField, RadianceSamples
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scenes import Frame, PointCloud, Scene
from coliags_plugin.core.settings import Settings
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.engine.scoring import Scorer
from coliags_plugin.engine.trainer import Trainer
from coliags_plugin.renderers.volume_renderer import VolumeRenderer, VolumeRendererSettings
from tests.scenes import camera_at

COLOR = (0.8, 0.3, 0.1)


class Fog(RadianceField):
    """Even density everywhere, or only beyond a plane."""

    def __init__(self, density, start=0.0):
        super().__init__()
        self.density = nn.Parameter(torch.tensor(float(density), dtype=torch.float64))
        self.start = start

    @classmethod
    def from_scene(cls, scene, settings, generator):
        raise NotImplementedError

    @classmethod
    def from_state(cls, state, settings):
        raise NotImplementedError

    def parameter_groups(self):
        return {"density": [self.density]}

    def query(self, positions, directions, camera):
        beyond = (positions[..., 2] > self.start).to(positions)
        return RadianceSamples(self.density * beyond, positions.new_tensor(COLOR).expand(positions.shape))


def make(**options):
    return VolumeRenderer(VolumeRendererSettings(**options))


def test_even_fog_absorbs_exponentially():
    camera = camera_at(0, 0, 0)
    output = make(near_plane=1.0, far_plane=9.0, samples=7, background=(0.0, 1.0, 0.0)).render(Fog(0.2), camera)
    lengths = camera.rays().norm(dim=-1)
    alpha = 1 - torch.exp(-0.2 * 8.0 * lengths)
    torch.testing.assert_close(output.alpha, alpha)
    expected = alpha[..., None] * torch.tensor(COLOR) + (1 - alpha[..., None]) * torch.tensor([0.0, 1.0, 0.0])
    torch.testing.assert_close(output.rgb, expected.double())


def test_depths_of_a_hard_surface_are_z_depths():
    kinds = ("depth_accumulated", "depth_expected", "depth_median", "inverse_depth_accumulated")
    output = make(near_plane=1.0, far_plane=21.0, samples=2000).render(
        Fog(500.0, start=12.0), camera_at(0, 0, 0), kinds
    )
    for kind in kinds[:3]:
        torch.testing.assert_close(output[kind], torch.full_like(output.alpha, 12.0), rtol=0, atol=0.02)
    torch.testing.assert_close(output[kinds[3]], torch.full_like(output.alpha, 1 / 12), rtol=2e-3, atol=0)
    empty = make(near_plane=1.0, far_plane=5.0).render(Fog(0.0), camera_at(0, 0, 0), kinds)
    assert not any(empty[kind].any() for kind in kinds)


def test_some_pixels_are_those_of_the_whole_image():
    renderer, field, camera = make(samples=16, rays_at_once=100), Fog(0.05), camera_at(0.3, 0.1, -2.0, yaw=0.2)
    whole = renderer.render(field, camera, ("depth_expected",))
    pixels = torch.tensor([[0, 0], [31, 23], [7, 19]])
    some = renderer.render(field, camera, ("depth_expected",), pixels)
    column, row = pixels.unbind(1)
    assert some.rgb.shape == (3, 1, 3) and some.alpha.shape == some["depth_expected"].shape == (3, 1)
    torch.testing.assert_close(some.rgb[:, 0], whole.rgb[row, column])
    torch.testing.assert_close(some["depth_expected"][:, 0], whole["depth_expected"][row, column])


def test_refusals():
    with pytest.raises(InputError, match="no renderer output 'normals'"):
        make().render(Fog(1.0), camera_at(0, 0, 0), ("normals",))
    with pytest.raises(ValueError, match=r"far_plane 1\.0 does not lie beyond near_plane 2\.0"):
        make(near_plane=2.0, far_plane=1.0)


# --- a radiance field as a third party would add one ------------------------------------------------------------------


class GridSettings(Settings):
    cells: int = 24
    half_width: float = 2.0


class Grid(RadianceField):
    """Density and colour at the corners of a cubic grid about the origin, interpolated."""

    Settings = GridSettings

    def __init__(self, settings):
        super().__init__()
        self.settings = settings
        self.grid = nn.Parameter(torch.zeros(1, 4, *[settings.cells] * 3))

    @classmethod
    def from_scene(cls, scene, settings, generator):
        return cls(settings)

    @classmethod
    def from_state(cls, state, settings):
        field = cls(settings)
        field.load_state_dict(state)
        return field

    def parameter_groups(self):
        return {"grid": [self.grid]}

    def query(self, positions, directions, camera):
        place = (positions / self.settings.half_width)[None, None]
        values = nn.functional.grid_sample(self.grid, place, padding_mode="border", align_corners=True)[0, :, 0]
        inside = (place[0, 0].abs() < 1).all(-1)
        return RadianceSamples(nn.functional.softplus(values[0] - 1) * inside * 4, values[1:].movedim(0, -1).sigmoid())


def sphere_scene():
    """A ball of radius 1, red above, green to the left and blue in front, before black, seen from a ring."""
    frames = []
    for index in range(12):
        angle = 2 * math.pi * index / 12
        camera = camera_at(-6 * math.sin(angle), 0.8 * math.sin(3 * angle), -6 * math.cos(angle), 40, 32, yaw=angle)
        rays = nn.functional.normalize(camera.rays(), dim=-1)
        along = -(rays * camera.center).sum(-1)
        nearest = (camera.center + along[..., None] * rays).norm(dim=-1)
        hit = nearest < 1
        reach = along - (1 - nearest.clamp_max(1) ** 2).sqrt()
        points = camera.center + reach[..., None] * rays
        color = torch.where(hit[..., None], 0.5 + 0.4 * points, 0.0)
        depth = torch.where(hit, reach / camera.rays().norm(dim=-1), torch.nan).float()
        image = (255 * color.clamp(0, 1)).round().to(torch.uint8)
        frames.append(Frame(f"{index:04d}", index, image, camera, depth))
    train, test = [f for f in frames if f.index % 6], [f for f in frames if f.index % 6 == 0]
    return Scene("ball", train, {"test": test}, PointCloud(torch.zeros(1, 3)), {"fingerprint": "ball"})


METHOD = """
description: a grid of density and colour
datamanager: {name: auto}
field: {name: test-grid}
renderer: {name: volume, near_plane: 3.0, far_plane: 9.0, samples: 64}
sampler: {name: pixels, pixels: 512, frames: 3}
strategy: {name: none}
losses: {l1: {name: l1, weight: 1.0}}
optimizers: {grid: {lr: 0.2, final_lr: 0.02}}
schedule: {steps: 150}
"""


def test_a_radiance_field_on_batches_of_pixels_fits_a_coloured_ball(tmp_path, monkeypatch):
    monkeypatch.setitem(registry.fields._targets, "test-grid", Grid)
    (tmp_path / "grid.yaml").write_text(METHOD, encoding="utf-8")
    method, scene = load_method(str(tmp_path / "grid.yaml")), sphere_scene()
    trainer = Trainer(method, scene, "ball", RunFolder(tmp_path / "run"), 0, torch.device("cpu"))
    trainer.start()
    rows = [trainer.take_step() for _ in range(150)]
    assert "gaussians" not in rows[0]
    scorer = Scorer("paper", only=["psnr", "depth_median_error"])
    scores = [
        scorer.score(scorer.compare(trainer.model, frame, trainer.device)).values for frame in scene.test_sets["test"]
    ]
    assert min(score["psnr"] for score in scores) > 23
    assert max(score["depth_median_error"] for score in scores) < 0.4
    trainer.save()
    other = Trainer(method, scene, "ball", RunFolder(tmp_path / "run"), 0, torch.device("cpu"))
    other.resume()
    assert torch.equal(other.model.field.grid, trainer.model.field.grid)
    assert [draw.frame for draw in other.sampler.next()] == [draw.frame for draw in trainer.sampler.next()]


def test_losses_of_whole_images_are_refused_with_pixel_batches(tmp_path, monkeypatch):
    monkeypatch.setitem(registry.fields._targets, "test-grid", Grid)
    (tmp_path / "grid.yaml").write_text(METHOD, encoding="utf-8")
    for name, message in (("d-ssim", "needs whole images"), ("scale-volume", "is about Gaussians")):
        method = load_method(str(tmp_path / "grid.yaml"), [f"losses.more={{name: {name}, weight: 0.2}}"])
        with pytest.raises(InputError, match=f"loss term 'more' {message}"):
            Trainer(method, sphere_scene(), "ball", RunFolder(tmp_path / "run"), 0, torch.device("cpu"))
    assert not (tmp_path / "run").exists()
