"""The law of attenuation: closed forms, and that other heads are left as they are."""

from __future__ import annotations

import math
from functools import partial

import pytest
import torch

from coliags_plugin.config.components import make_component
from coliags_plugin.fields.attenuation import MAX_OFFSET, AttenuatedAppearanceHead
from coliags_plugin.lighting.lamps import FlattenedLight, LightOfCamera
from tests.fields.made import make_field
from tests.scenes import camera_at

make_anchors = partial(make_field, "anchors", geometry_head="plain")


def make_head(**options) -> AttenuatedAppearanceHead:
    head = make_component("appearance_heads", {"name": "attenuated", "head": "plain", "channels": 1, **options})
    return head.target(head.settings, 4, 2, torch.Generator().manual_seed(0))


def turned_camera():
    return camera_at(1.0, 2.0, 3.0, yaw=0.4).to("cpu", torch.float32)


def test_the_factor_is_the_law_about_the_median_distance():
    exponents = [[-0.8, 1.5], [-0.5, 0.0], [-1.0, 2.0]]  # of each channel
    head = make_head(channels=3)
    head.init_from_distances(torch.tensor([10.0, 20.0, 70.0]))
    with torch.no_grad():
        head.exponents.copy_(torch.tensor(exponents))
    distances, cosines = torch.tensor([20.0, 40.0, 10.0]), torch.tensor([1.0, 0.9, 0.5])
    expected = [
        [share**far * cosine**aside for far, aside in exponents] for share, cosine in ((1, 1), (2, 0.9), (0.5, 0.5))
    ]
    torch.testing.assert_close(head.law(distances, cosines), torch.tensor(expected))


def test_distance_and_angle_are_those_at_the_lamp():
    """A lamp 3 mm behind the lens and 4 mm above it, in a camera that is turned and moved."""
    head, camera = make_head(cosine_exponent=1.0), turned_camera()
    with torch.no_grad():
        head.lamp_offset.copy_(MAX_OFFSET * torch.atanh(torch.tensor([0.0, -4.0, -3.0]) / MAX_OFFSET))
    torch.testing.assert_close(head.offset, torch.tensor([0.0, -4.0, -3.0]))
    local = torch.tensor([[0.0, 0.0, 9.0], [3.0, -4.0, 9.0]])  # the second is 3 mm beside the lamp's axis
    points = camera.center + local @ camera.camera_to_world[:3, :3].T
    lit = head.apply_light(torch.full((2, 3), 0.5), points, None, camera, None)
    expected = [length**-0.9 * 12 / length for length in (math.hypot(4, 12), math.hypot(3, 12))]
    torch.testing.assert_close(lit[:, 0], 0.5 * torch.tensor(expected))


def test_a_held_light_takes_the_place_of_the_lamp():
    head = make_head(cosine_exponent=2.0)
    lit = head.apply_light(torch.ones(3, 3), torch.rand(3, 3), None, camera_at(0, 0, 0), FlattenedLight(4.0, 0.5))
    torch.testing.assert_close(lit, torch.full((3, 3), 4.0**-0.9 * 0.25))


def test_incidence_counts_on_either_side_of_the_wall_and_not_under_a_flattened_light():
    head, camera = make_head(distance_exponent=0.0, cosine_exponent=0.0, incidence_exponent=0.5), turned_camera()
    local = torch.tensor([[0.0, 0.0, 10.0], [3.0, 0.0, 4.0], [0.0, 0.0, 7.0]])
    normals = torch.tensor([[0.6, 0.0, 0.8], [-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])  # the last at a right angle
    axes = camera.camera_to_world[:3, :3]
    points, turned = camera.center + local @ axes.T, normals @ axes.T
    lit = head.apply_light(torch.ones(3, 3), points, turned, camera, None)
    torch.testing.assert_close(lit[:, 0], torch.tensor([0.8, 0.6, 0.1]).sqrt())
    torch.testing.assert_close(lit, head.apply_light(torch.ones(3, 3), points, -turned, camera, None))
    flattened = head.apply_light(torch.ones(3, 3), points, turned, camera, FlattenedLight(4.0, 0.5))
    torch.testing.assert_close(flattened, torch.ones(3, 3))
    beside = head.apply_light(torch.ones(3, 3), points, turned, camera_at(0, 0, 0), LightOfCamera(camera))
    torch.testing.assert_close(beside, lit)


def test_the_lamp_stays_within_its_bounds_and_nothing_overflows():
    head = make_head()
    with torch.no_grad():
        head.lamp_offset.fill_(1e6)
    assert head.offset.abs().max() <= MAX_OFFSET
    points = torch.tensor([[MAX_OFFSET, MAX_OFFSET, MAX_OFFSET], [0.0, 0.0, 0.0], [0.0, 0.0, -5.0]])
    lit = head.apply_light(torch.ones(3, 3), points, None, camera_at(0, 0, 0).to("cpu", torch.float32), None)
    lit.sum().backward()
    assert lit.isfinite().all() and head.exponents.grad.isfinite().all() and head.lamp_offset.grad.isfinite().all()


@pytest.mark.parametrize("inner", ["plain", "imia"])
def test_exponents_of_zero_are_the_head_alone(inner):
    options = {"distance_exponent": 0.0, "cosine_exponent": 0.0}
    plain, lit = (
        make_anchors(appearance_head=inner),
        make_anchors(appearance_head={"name": "attenuated", "head": inner, **options}),
    )
    camera = camera_at(0.5, 0.0, 1.0)
    first, second = plain.gaussians(camera), lit.gaussians(camera)
    torch.testing.assert_close(first.colors, second.colors, rtol=2e-7, atol=0.0)  # the kernel's power of 0 is 1 + 7e-8
    assert torch.equal(first.means, second.means)
    assert plain.learned == {}
    assert lit.learned["distance_exponent"] == [0.0] * 3 and lit.learned["lamp_offset"] == [0.0, 0.0, 0.0]


def test_colors_do_not_move_gaussians():
    field = make_anchors(appearance_head={"name": "attenuated", "head": "plain"})
    field.gaussians(camera_at(0.0, 0.0, 0.0)).colors.sum().backward()
    assert not field.offsets.grad.any() and field.appearance_head.exponents.grad.abs().max() > 0


@pytest.mark.thorough
def test_the_law_of_a_lamp_is_found():
    """Gaussians of one albedo under an inverse-square lamp 3.6 mm behind the lens, spread as cos^1.2, at gamma 2.2."""
    generator = torch.Generator().manual_seed(0)
    camera, head = camera_at(0, 0, 0).to("cpu", torch.float32), make_head(cosine_exponent=0.0)
    points = torch.rand(2000, 3, generator=generator) * torch.tensor([16.0, 16.0, 40.0]) + torch.tensor([-8.0, -8, 5])
    distances = (points - torch.tensor([0.0, 0.0, -3.6])).norm(dim=1)
    true = 0.5 * (distances / 20.0) ** (-2 / 2.2) * ((points[:, 2] + 3.6) / distances) ** (1.2 / 2.2)
    head.init_from_distances(torch.tensor([20.0]))
    albedo = torch.tensor(0.3, requires_grad=True)
    fit = torch.optim.LBFGS([head.exponents, head.lamp_offset, albedo], max_iter=200, line_search_fn="strong_wolfe")

    def error() -> torch.Tensor:
        fit.zero_grad()
        lit = head.apply_light(albedo.expand(2000, 3), points, None, camera, None)
        value = (lit[:, 0].log() - true.log()).square().mean()
        value.backward()
        return value

    for _ in range(3):
        fit.step(error)
    learned = head.learned
    assert learned["distance_exponent"][0] == pytest.approx(-2 / 2.2, rel=0.02)
    assert learned["cosine_exponent"][0] == pytest.approx(1.2 / 2.2, rel=0.05)
    assert learned["lamp_offset"] == pytest.approx([0.0, 0.0, -3.6], abs=0.2)
