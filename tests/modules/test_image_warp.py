"""Image displacements: pixels are moved as told, and between frames in time."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from scipy.ndimage import map_coordinates

from coliags_plugin.core.render_output import RenderOutput
from coliags_plugin.core.scenes import View
from coliags_plugin.modules.image_warp import ImageWarp, ImageWarpSettings
from tests.scenes import wall_scene

WIDTH, HEIGHT = 40, 30


def make(frames=9, **options):
    scene = wall_scene(frames)
    return scene, ImageWarp.from_scene(scene, ImageWarpSettings(**options), torch.Generator())


def picture(seed=0):
    rgb = torch.rand(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(seed))
    return RenderOutput(rgb, torch.ones(HEIGHT, WIDTH), None)


def of_frame(scene, row):
    return scene.train[row].view(trained=True)


def test_pixels_are_taken_from_where_scipy_takes_them():
    scene, module = make(cells=1)
    with torch.no_grad():
        module.displacement[0] = 100.0 * torch.tensor([2.5, -1.25])[:, None, None] / WIDTH  # the mean of nine is left
    shift = torch.tensor([2.5, -1.25]) * (1.0 - 1.0 / len(scene.train))
    rows, columns = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    at = torch.stack([rows + shift[1], columns + shift[0]]).numpy()
    made = module.shade(picture(), of_frame(scene, 0)).rgb
    for channel in range(3):
        expected = map_coordinates(picture().rgb[..., channel].numpy(), at, order=1, mode="nearest")
        torch.testing.assert_close(made[..., channel], torch.from_numpy(expected), atol=1e-5, rtol=0.0)


@pytest.mark.parametrize(("untrained", "moves"), [("interpolate", True), ("none", False)])
def test_held_out_frames_move_as_the_frames_around_them(untrained, moves):
    scene, module = make(untrained=untrained)
    first, second = of_frame(scene, 2), of_frame(scene, 3)
    with torch.no_grad():
        module.displacement[2:4] = 3.0
    between = View("held out", (first.time + second.time) / 2.0, trained=False)
    expected = module.shade(picture(), first).rgb if moves else picture().rgb
    torch.testing.assert_close(module.shade(picture(), between).rgb, expected)
    assert torch.equal(module.shade(picture(), None).rgb, picture().rgb)


@pytest.mark.thorough
def test_a_motion_is_learned():
    scene, module = make(cells=2)
    smooth = torch.linspace(0.0, 6.0, WIDTH).sin()[None, :] * torch.linspace(0.0, 5.0, HEIGHT).cos()[:, None]
    still = replace(picture(), rgb=smooth[..., None].expand(-1, -1, 3))
    moved = torch.cat([still.rgb[:, 1:], still.rgb[:, -1:]], dim=1)  # every pixel shows what was one to its right
    optimizer = torch.optim.Adam(module.parameters(), lr=0.1)
    for _ in range(200):
        optimizer.zero_grad()
        pairs = [(0, moved), (1, still.rgb)]
        sum((module.shade(still, of_frame(scene, row)).rgb - target).abs().mean() for row, target in pairs).backward()
        optimizer.step()
    shift = (module.displacement[0] - module.displacement[1]).detach() * WIDTH / 100.0
    assert shift[0].mean() == pytest.approx(1.0, abs=0.05) and shift[1].abs().mean() < 0.1
