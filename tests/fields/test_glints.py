"""Appearance heads: glints of facets, and the law of attenuation."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from coliags_plugin.config.components import make_component
from coliags_plugin.contracts import SeenAnchors
from coliags_plugin.core.lamps import FlattenedLight, LightOfCamera
from coliags_plugin.fields.attenuation import MAX_OFFSET, AttenuatedAppearanceHead
from coliags_plugin.fields.heads import MAX_TILT, WIDTHS, GlintAppearanceHead, tangent_components
from coliags_plugin.fields.mlp import embedded_inputs
from tests.fields.made import make_field
from tests.scenes import camera_at


def make_head(name: str = "imia-glints") -> Any:
    head = make_component("appearance_heads", name)
    return head.target(head.settings, 4, 2, torch.Generator().manual_seed(0))


def unit(*vectors: tuple[float, float, float]) -> torch.Tensor:
    return torch.nn.functional.normalize(torch.tensor(vectors), dim=1)


def seen(directions: torch.Tensor, normals: torch.Tensor) -> SeenAnchors:
    """Anchors of one feature, 7 mm in front of the lens."""
    count = len(directions)
    return SeenAnchors(torch.ones(count, 4), directions, torch.full((count, 1), 7.0), torch.ones(count, 1), normals)


def embedded(head: GlintAppearanceHead, directions: torch.Tensor, normals: torch.Tensor) -> torch.Tensor:
    return embedded_inputs(head.networks(seen(directions, normals)))


@settings(deadline=None)
@given(st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6))
def test_the_components_along_a_wall_have_the_sine_of_the_angle_as_their_length(numbers):
    pair = torch.tensor(numbers, dtype=torch.float64).view(2, 1, 3)
    normal, direction = (torch.nn.functional.normalize(vector, dim=1) for vector in pair)
    along = tangent_components(direction, normal)
    expected = torch.linalg.cross(direction, normal).norm(dim=1)
    if normal.norm() > 0.5:
        torch.testing.assert_close(along.norm(dim=1), expected, atol=1e-12, rtol=0.0)


def test_axes_of_normals_along_z_of_either_sign():
    directions, normals = unit((0.6, 0.0, 0.8), (0.6, 0.0, 0.8)), unit((0, 0, 1.0), (0, 0, -1.0))
    torch.testing.assert_close(tangent_components(directions, normals), torch.tensor([[0.6, 0.0], [0.6, 0.0]]))


def test_a_facet_without_tilt_glints_where_it_is_seen_along_the_normal():
    """Lobes are 1 there, on either side of the wall, and 1/e at the sine of their widths."""
    head, normal = make_head(), unit((0.0, 0.0, 1.0))
    lobes = slice(5, 5 + len(WIDTHS))
    torch.testing.assert_close(embedded(head, unit((0.0, 0.0, -3.0)), normal)[:, lobes], torch.ones(1, len(WIDTHS)))
    for index, width in enumerate(WIDTHS):
        aside = torch.tensor([[width, 0.0, math.sqrt(1.0 - width**2)]])
        torch.testing.assert_close(embedded(head, aside, normal)[0, 5 + index].item(), math.exp(-1.0))
    assert embedded(head, unit((0.0, 0.0, 1.0)), normal).shape == (1, head.color_mlp[0].in_features - 4)
    assert embedded(head, unit((0.0, 0.0, 1.0)), normal)[0, 5 + len(WIDTHS)] == 7.0


def test_a_tilted_facet_glints_beside_the_normal():
    head, normal = make_head(), unit((0.0, 0.0, 1.0))
    with torch.no_grad():
        head.tilt_layer.bias.copy_(torch.atanh(torch.tensor([0.3, -0.1]) / MAX_TILT))
    facing = torch.tensor([[0.3, -0.1, math.sqrt(0.9)]])
    torch.testing.assert_close(embedded(head, facing, normal)[:, 5 : 5 + len(WIDTHS)], torch.ones(1, len(WIDTHS)))
    beside = embedded(head, normal, normal)[0, 5 : 5 + len(WIDTHS)]
    beside.sum().backward()
    assert beside[0].item() < 1e-4 and head.tilt_layer.bias.grad.all()  # it can be learned


@pytest.mark.parametrize(
    "appearance",
    [
        *("imia-glints", {"name": "attenuated", "head": "imia-glints"}),
        {"name": "attenuated", "head": "plain", "incidence_exponent": 0.3},
    ],
)
def test_a_field_keeps_the_normals_of_the_wall_for_heads_that_see_them(appearance):
    field = make_field("anchors", geometry_head="plain", appearance_head=appearance)
    torch.testing.assert_close(field.normals[:, 2].abs(), torch.ones(len(field.anchors)))
    assert torch.equal(type(field).from_state(field.state_dict(), field.settings).normals, field.normals)
    gaussians = field.gaussians(camera_at(0.5, 0.0, 1.0))
    assert gaussians.colors.isfinite().all()
    gaussians.colors.sum().backward()
    gradients = [value.grad for value in field.appearance_head.parameters() if value.grad is not None]
    assert all(gradient.isfinite().all() for gradient in gradients)
    without = make_field("anchors", geometry_head="plain", appearance_head="plain")
    assert without.normals is None and "normals" not in without.state_dict()


# The law of attenuation: closed forms, and that other heads are left as they are


make_anchors = partial(make_field, "anchors", geometry_head="plain")


def make_attenuated(**options) -> AttenuatedAppearanceHead:
    head = make_component("appearance_heads", {"name": "attenuated", "head": "plain", "channels": 1, **options})
    return head.target(head.settings, 4, 2, torch.Generator().manual_seed(0))


def turned_camera():
    return camera_at(1.0, 2.0, 3.0, yaw=0.4).to("cpu", torch.float32)


def test_the_factor_is_the_law_about_the_median_distance():
    exponents = [[-0.8, 1.5], [-0.5, 0.0], [-1.0, 2.0]]  # of each channel
    head = make_attenuated(channels=3)
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
    head, camera = make_attenuated(cosine_exponent=1.0), turned_camera()
    with torch.no_grad():
        head.lamp_offset.copy_(MAX_OFFSET * torch.atanh(torch.tensor([0.0, -4.0, -3.0]) / MAX_OFFSET))
    torch.testing.assert_close(head.offset, torch.tensor([0.0, -4.0, -3.0]))
    local = torch.tensor([[0.0, 0.0, 9.0], [3.0, -4.0, 9.0]])  # the second is 3 mm beside the lamp's axis
    points = camera.center + local @ camera.camera_to_world[:3, :3].T
    lit = head.apply_light(torch.full((2, 3), 0.5), points, None, camera, None)
    expected = [length**-0.9 * 12 / length for length in (math.hypot(4, 12), math.hypot(3, 12))]
    torch.testing.assert_close(lit[:, 0], 0.5 * torch.tensor(expected))


def test_a_held_light_takes_the_place_of_the_lamp():
    head = make_attenuated(cosine_exponent=2.0)
    lit = head.apply_light(torch.ones(3, 3), torch.rand(3, 3), None, camera_at(0, 0, 0), FlattenedLight(4.0, 0.5))
    torch.testing.assert_close(lit, torch.full((3, 3), 4.0**-0.9 * 0.25))


def test_incidence_counts_on_either_side_of_the_wall_and_not_under_a_flattened_light():
    head, camera = make_attenuated(distance_exponent=0.0, cosine_exponent=0.0, incidence_exponent=0.5), turned_camera()
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
    head = make_attenuated()
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
