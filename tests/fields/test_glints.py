"""Glints: what the head sees of a facet, and the field's normals."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from coliags_plugin.config.components import make_component
from coliags_plugin.fields.appearance_heads import MAX_TILT, WIDTHS, GlintAppearanceHead, tangent_components
from coliags_plugin.fields.mlp import embedded_inputs
from tests.fields.made import make_field
from tests.scenes import camera_at


def make_head(name: str = "imia-glints") -> Any:
    head = make_component("appearance_heads", name)
    return head.target(head.settings, 4, 2, torch.Generator().manual_seed(0))


def unit(*vectors: tuple[float, float, float]) -> torch.Tensor:
    return torch.nn.functional.normalize(torch.tensor(vectors), dim=1)


def embedded(head: GlintAppearanceHead, directions: torch.Tensor, normals: torch.Tensor) -> torch.Tensor:
    count = len(directions)
    distances, cosines = torch.full((count, 1), 7.0), torch.ones(count, 1)
    return embedded_inputs(head.networks(torch.ones(count, 4), directions, distances, cosines, normals))


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
    assert embedded(head, normal, normal)[0, 5].item() < 1e-4


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


@pytest.mark.thorough
def test_a_glint_beside_the_normal_is_learned():
    """One anchor that glints about a direction 10 degrees off the wall's normal: IMIA finds none of it."""
    generator = torch.Generator().manual_seed(0)
    offsets = 0.5 * torch.rand(150, 2, generator=generator) - 0.25
    directions = torch.cat([offsets, (1.0 - offsets.square().sum(1, keepdim=True)).sqrt()], dim=1)
    glint = torch.exp(-(offsets - torch.tensor([0.17, 0.0])).square().sum(1) / 0.06**2)
    normals, distances = unit((0.0, 0.0, 1.0)).expand(150, 3), torch.full((150, 1), 7.0)
    errors = {}
    for name in ("imia", "imia-glints"):
        head = make_head(name)
        head.init_from_distances(torch.linspace(5.0, 9.0, 5))
        fit = torch.optim.Adam(head.parameters(), lr=0.02)
        for _ in range(400):
            fit.zero_grad()
            colors = head(torch.ones(150, 4), directions, distances, torch.ones(150, 1), normals)
            error = (colors - (0.3 + 0.6 * glint)[:, None, None]).square().mean()
            error.backward()
            fit.step()
        errors[name] = float(error.detach())
    assert errors["imia-glints"] < 0.75 * errors["imia"]
