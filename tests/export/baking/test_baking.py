"""Parts of baking, against closed forms."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.gaussians import Gaussians, rotation_matrices
from coliags_plugin.core.lamps import FlattenedLight, LightOfCamera
from coliags_plugin.engine.held_light import mean_camera
from coliags_plugin.export.baking.baking import GaussianAverages, SeenColors, blending_weights, fit_harmonics
from coliags_plugin.export.baking.distillation import beside
from coliags_plugin.export.splats.cloud import field_of_cloud
from coliags_plugin.fields.spherical_harmonics import basis, colors
from coliags_plugin.renderers.torch_renderer import TorchRenderer, TorchRendererSettings
from tests.scenes import camera_at


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def some_gaussians(count: int) -> Gaussians:
    """Random Gaussians within 10 mm of the origin."""
    index, drawn = torch.arange(count), torch.rand(count, 10, generator=torch.Generator().manual_seed(0))
    means, scales, opacities, colors = drawn.split((3, 3, 1, 3), dim=1)
    turns = random(count, 4)
    return Gaussians(
        20.0 * means - 10.0, turns, 0.1 + 0.9 * scales, 0.05 + 0.95 * opacities[:, 0], colors, index, index
    )


def test_harmonics_reproduce_colours_of_their_own_kind():
    true = 0.1 * random(5, 16, 3)
    views = []
    for seed in range(60):
        directions = torch.nn.functional.normalize(random(5, 3, seed=seed + 1), dim=1)
        rgb = (basis(directions, 3)[..., None] * true).sum(1) + 0.5
        views.append(SeenColors(torch.tensor([2, 3, 5, 8, 9]), torch.rand(5) + 0.5, directions, rgb))
    slots = torch.tensor([2, 5, 9])
    fitted = fit_harmonics(views, slots, torch.full((3, 3), 0.3), 3)
    directions = torch.nn.functional.normalize(random(3, 3, seed=99), dim=1)
    expected = colors(true[[0, 2, 4]], directions, 3)
    torch.testing.assert_close(colors(fitted, directions, 3), expected, atol=0.05, rtol=0)
    # The ridge costs little where views abound.
    assert (fitted - true[[0, 2, 4]]).norm() < 0.2 * true[[0, 2, 4]].norm()


def test_one_view_gives_its_colour_and_none_the_mean():
    direction = torch.tensor([[0.0, 0.6, 0.8]])
    view = SeenColors(torch.tensor([4]), torch.ones(1), direction, torch.tensor([[0.9, 0.2, 0.1]]))
    fitted = fit_harmonics([view], torch.tensor([4, 7]), torch.tensor([[0.9, 0.2, 0.1], [0.1, 0.7, 0.4]]), 3)
    torch.testing.assert_close(colors(fitted[:1], direction, 3), torch.tensor([[0.9, 0.2, 0.1]]), atol=1e-4, rtol=0)
    torch.testing.assert_close(colors(fitted[1:], direction, 3), torch.tensor([[0.1, 0.7, 0.4]]), atol=1e-6, rtol=0)
    torch.testing.assert_close(fitted[1, 1:], torch.zeros(15, 3))


def test_blending_weights_add_up_to_alpha():
    gaussians, camera = some_gaussians(12), camera_at(0.0, 0.0, -15.0)
    renderer = TorchRenderer(TorchRendererSettings())
    weights = blending_weights(renderer, gaussians, camera)
    alpha = renderer.draw(gaussians, camera, ("rgb", "alpha")).alpha
    assert float(weights.sum()) == pytest.approx(float(alpha.sum()), rel=1e-5)
    assert float(weights.min()) >= 0.0


def test_averages_of_the_same_gaussians_are_these():
    gaussians = some_gaussians(12)
    averages, camera = GaussianAverages(12, 1, 3, torch.device("cpu")), camera_at(0, 0, 0)
    for flip in (1.0, -1.0, 2.5):  # a quaternion and its negative are the same rotation
        averages.add(replace(gaussians, quats_wxyz=flip * gaussians.quats_wxyz), torch.rand(12) + 0.1, camera)
    field = field_of_cloud(averages.cloud(averages.visible(), torch.zeros(12, 16, 3)))
    assert int(field.degree) == 3
    torch.testing.assert_close(field.means, gaussians.means)
    torch.testing.assert_close(field.scales.exp(), gaussians.scales)
    torch.testing.assert_close(field.opacities.sigmoid(), gaussians.opacities)
    torch.testing.assert_close(averages.mean_colors(averages.visible()), gaussians.colors)
    expected = rotation_matrices(gaussians.quats_wxyz)
    torch.testing.assert_close(rotation_matrices(field.quats), expected, atol=1e-5, rtol=0)


def test_a_child_that_is_absent_from_a_view_counts_as_transparent():
    gaussians = some_gaussians(2)
    both = replace(gaussians, opacities=torch.tensor([0.8, 0.6]))
    first = Gaussians(*(value[:1] for value in (both.means, both.quats_wxyz, both.scales, both.opacities, both.colors)),
                      source_index=torch.tensor([0]), visible_sources=torch.tensor([0]))  # fmt: skip
    averages = GaussianAverages(1, 2, 3, torch.device("cpu"))
    averages.add(both, torch.tensor([3.0, 1.0]), camera_at(0, 0, 0))
    averages.add(first, torch.tensor([4.0]), camera_at(0, 0, 0))
    field = field_of_cloud(averages.cloud(averages.visible(), torch.zeros(2, 1, 3)))
    # Both views show 4 pixels of the anchor; the second child is in the first view only.
    torch.testing.assert_close(field.opacities.sigmoid(), torch.tensor([0.8, 0.3]))
    torch.testing.assert_close(field.means, both.means)


def test_the_heaviest_gaussians_are_kept():
    averages = GaussianAverages(6, 1, 3, torch.device("cpu"))
    averages.add(some_gaussians(6), torch.zeros(6), camera_at(0, 0, 0))
    with pytest.raises(InputError, match="visible"):
        averages.visible()
    averages.add(some_gaussians(6), torch.tensor([3.0, 10.0, 0.0, 1.0, 5.0, 1.0]), camera_at(0, 0, 0))
    assert averages.heaviest(3).tolist() == [0, 1, 4]
    assert averages.heaviest(9).tolist() == [0, 1, 3, 4, 5]  # one fills no pixel
    assert averages.heaviest(9, 0.75).tolist() == [1, 4]  # 15 of 20 pixels
    assert averages.heaviest(1, 0.75).tolist() == [1]


def test_the_mean_camera_is_between_the_cameras():
    mean = mean_camera([camera_at(0.0, 1.0, 2.0, yaw=0.3), camera_at(4.0, 1.0, 0.0, yaw=-0.1)])
    torch.testing.assert_close(mean.center, torch.tensor([2.0, 1.0, 1.0], dtype=torch.float64))
    expected = camera_at(0, 0, 0, yaw=0.1).camera_to_world[:3, :3]
    torch.testing.assert_close(mean.camera_to_world[:3, :3], expected)
    third = mean_camera([camera_at(0.0, 0.0, 0.0), camera_at(4.0, 0.0, 8.0)], (0.75, 0.25))
    torch.testing.assert_close(third.center, torch.tensor([1.0, 0.0, 2.0], dtype=torch.float64))


def test_cameras_beside_a_path_are_near_it():
    generator = torch.Generator().manual_seed(0)
    path = [camera_at(float(x), 0.0, 0.0) for x in range(9)]
    places = torch.stack([camera.center for _ in range(40) for camera in beside(path, generator)])
    assert 0.25 < float(places[:, 1:].std()) < 0.35  # the steps are 1 mm
    between = places[:, 0] - torch.arange(8).repeat(40)  # one in each step
    assert float(between.mean()) == pytest.approx(0.5, abs=0.1)
    assert float(between.min()) > -1.5 and float(between.max()) < 2.5
    (alone,) = beside(path[:1], generator)
    torch.testing.assert_close(alone.center, path[0].center)
    assert alone.camera_to_world.dtype == path[0].camera_to_world.dtype


def test_held_lights():
    points = torch.tensor([[3.0, 0.0, 4.0], [0.0, 0.0, -2.0]])
    normals = torch.tensor([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    lamp = LightOfCamera(camera_at(0.0, 0.0, 0.0))
    distances, cosines = lamp.incidence(points)
    torch.testing.assert_close(distances, torch.tensor([5.0, 2.0]))
    torch.testing.assert_close(cosines, torch.tensor([0.8, 0.0]))  # nothing shines backwards
    torch.testing.assert_close(lamp.towards(points, normals)[0], torch.tensor([-0.6, 0.0, -0.8]))
    flat = FlattenedLight(30.0, math.cos(0.5))
    distances, cosines = flat.incidence(points)
    assert distances.tolist() == [30.0, 30.0]
    torch.testing.assert_close(cosines, torch.full((2,), math.cos(0.5)))
    assert torch.equal(flat.towards(points, normals), normals)
