"""Explicit surfels: their start, what a camera sees of them."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from coliags_plugin.config.components import make_component
from coliags_plugin.renderers.torch_renderer import render_gaussians
from tests.scenes import camera_at, wall_scene


def make(seed=0, **options):
    component = make_component("fields", {"name": "surfels", **options})
    return component.target.from_scene(wall_scene(), component.settings, torch.Generator().manual_seed(seed))


def test_one_faint_round_disc_at_every_point_turned_at_random():
    scene, field = wall_scene(), make()
    assert field.primitive == "surfels" and field.elements == "gaussians"
    seen = field.gaussians(camera_at(0, 0, -50))
    assert seen.scales.shape == (len(seen), 2) and torch.equal(seen.scales[:, 0], seen.scales[:, 1])
    torch.testing.assert_close(seen.means, scene.points.positions[seen.source_index])
    torch.testing.assert_close(seen.opacities, torch.full((len(seen),), 0.1))
    # Points on a grid of 0.5 mm: inner ones have three neighbours at that distance.
    assert seen.scales.median().item() == pytest.approx(0.5, rel=1e-5)
    quats = field.quats.detach()
    assert 0 <= quats.min() < 0.01 and 0.99 < quats.max() < 1
    torch.testing.assert_close(quats.mean(0), torch.full((4,), 0.5), rtol=0, atol=0.03)
    assert torch.equal(make(seed=0).quats, field.quats) and not torch.equal(make(seed=1).quats, field.quats)


def test_their_normals_are_those_that_are_drawn():
    field = make()
    with torch.no_grad():
        field.opacities.fill_(5.0)
    camera = camera_at(0.0, 0.0, 0.0)
    seen = field.gaussians(camera.to(dtype=torch.float32))
    index = int(seen.means[:, :2].norm(dim=1).argmin())
    normal = field.normals()[seen.source_index[index]].detach()
    kept = {k: getattr(seen, k)[index : index + 1] for k in ("means", "quats_wxyz", "scales", "opacities", "colors")}
    output = render_gaussians(replace(seen, **kept), camera, ("normals",))
    row, column = divmod(int(output.alpha.argmax()), output.alpha.shape[1])
    drawn = output["normals"][row, column] / output.alpha[row, column]
    torch.testing.assert_close(drawn, normal if normal[2] < 0 else -normal, rtol=1e-4, atol=1e-5)


def test_from_state_restores_any_number():
    field = make()
    state = {name: value[:7] if value.ndim else value for name, value in field.state_dict().items()}
    other = type(field).from_state(state, field.settings)
    assert other.element_count == 7 and other.scales.shape == (7, 2)


def test_references_work_for_surfels_too():
    field = make(normal_neighbours=8)
    assert field.references.of_rows.shape == (field.element_count, 3)
