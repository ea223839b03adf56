"""Decoding by kernels against the definition in PyTorch, in float64."""

from __future__ import annotations

import copy
from dataclasses import replace
from importlib.util import find_spec

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from coliags_plugin.fields import anchors
from coliags_plugin.fields.heads import PlainAppearanceHead, PlainGeometryHead
from coliags_plugin.fields.points import DRAWN_SIGMAS, spheres_in_frustum
from tests.fields.made import make_field
from tests.scenes import camera_at

OUTPUTS = ("means", "quats_wxyz", "scales", "opacities", "colors")
#: Sees a part of the anchors.
CAMERA = camera_at(4.0, 0.5, 8.0, yaw=0.4)
FIELDS = {
    "coliags": {"geometry_head": "imve", "appearance_head": "imia"},
    "scaffold": {"geometry_head": "plain", "appearance_head": {"name": "plain", "distance": True}, "children": 3},
    "odd sizes": {
        "geometry_head": {"name": "imve", "hidden": 20, "frequencies": 1},
        "appearance_head": {"name": "imia-glints", "hidden": 41},
        "children": 17,
        "features": 13,
    },
    "attenuated": {"geometry_head": "imve", "appearance_head": {"name": "attenuated", "head": "imia"}, "children": 1},
    "with incidence": {
        "geometry_head": "plain",
        "appearance_head": {"name": "attenuated", "head": "imia", "incidence_exponent": 0.3},
    },
    "one channel": {
        "geometry_head": "plain",
        "appearance_head": {"name": "attenuated", "head": "imia", "channels": 1},
        "children": 5,
    },
}


def make(name, **options):
    """A field of some hundred anchors, of four tiles of triton's kernels, float32."""
    field = make_field(**{"name": "anchors", "voxel_size": 2.5, **FIELDS[name], **options})
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        field.offsets.uniform_(-1, 1, generator=generator)
        field.features.uniform_(-1, 1, generator=generator)
        field.scalings.uniform_(-1, 0, generator=generator)
        for parameter in (*field.geometry_head.parameters(), *field.appearance_head.parameters()):
            parameter.add_(torch.randn(parameter.shape, generator=generator), alpha=0.1)
    return field


NUMBA, CUDA = "numba", pytest.param("cuda", marks=pytest.mark.gpu)


@pytest.fixture(params=[NUMBA, pytest.param("triton", marks=pytest.mark.thorough), CUDA])
def made(request, monkeypatch):
    """:func:`make`, of fields that either kernels decode: triton's in its interpreter, or on a device."""
    if request.param == "numba":
        return make
    if find_spec("triton") is None:
        pytest.skip("triton is not installed")
    from coliags_plugin.fields.triton_kernels import children

    monkeypatch.setattr(children, "SLABS", 2)  # fewer programs than tiles
    if request.param == "triton":
        monkeypatch.setattr(anchors, "fit_triton_kernels", lambda tensor: tensor.dtype == torch.float32)
        return make
    return lambda *names, **options: make(*names, **options).to(request.param)


def derived(field, camera):
    """Gaussians, and derivatives of a random weighting of all that they have."""
    drawn = field.gaussians(camera)
    moved = {name: getattr(drawn, name).cpu() for name in (*OUTPUTS, "source_index", "visible_sources")}
    drawn = replace(drawn, **moved)
    generator = torch.Generator().manual_seed(2)
    values = [getattr(drawn, name).double() for name in OUTPUTS]
    weights = [torch.randn(value.shape, generator=generator, dtype=torch.float64) for value in values]
    torch.stack([(value * weight).sum() for value, weight in zip(values, weights, strict=True)]).sum().backward()
    return drawn, {name: parameter.grad.cpu() for name, parameter in field.named_parameters()}


def assert_as_defined(field, camera=CAMERA):
    """Check that Gaussians and gradients are those of the definition in float64; return the Gaussians."""
    wide = copy.deepcopy(field).cpu().double()
    (drawn, gradients), (expected, expected_found) = derived(field, camera), derived(wide, camera)
    assert torch.equal(drawn.source_index, expected.source_index)
    assert torch.equal(drawn.visible_sources, expected.visible_sources)
    for output in OUTPUTS:
        actual, expected_values = getattr(drawn, output), getattr(expected, output)
        # Of a direction's octaves, 512 times 1e-7 is left.
        torch.testing.assert_close(actual.double(), expected_values, rtol=3e-5, atol=3e-5)
    assert gradients.keys() == expected_found.keys()
    for key, expected_values in expected_found.items():
        scale = expected_values.abs().max().clamp_min(1e-6)
        torch.testing.assert_close(gradients[key].double() / scale, expected_values / scale, rtol=0, atol=1e-4)
    return drawn


@pytest.mark.parametrize("name", FIELDS)
def test_gaussians_and_derivatives_are_those_of_the_definition(name, made):
    field = made(name)
    drawn = assert_as_defined(field)
    assert 0 < len(drawn.visible_sources) < field.element_count
    assert 0 < len(drawn) < len(drawn.visible_sources) * field.slots_per_element


@pytest.mark.parametrize(("opacity", "share"), [(-1.0, 0.0), (1.0, 1.0)])
def test_all_or_none_of_the_children_are_drawn(opacity, share, made):
    field = made("scaffold")
    with torch.no_grad():
        field.geometry_head.opacity_mlp[2].weight.mul_(0.1)
        field.geometry_head.opacity_mlp[2].bias.fill_(opacity)
    drawn = assert_as_defined(field)
    assert len(drawn) == share * len(drawn.visible_sources) * field.slots_per_element
    assert len(drawn.visible_sources) > 0


def test_a_single_anchor(made):
    field = made("scaffold", voxel_size=100.0)
    assert field.element_count == 1
    assert len(assert_as_defined(field, camera_at(0.0, 0.0, -20.0))) > 0


# On a device every example would be compiled for seconds.
@pytest.mark.thorough
@pytest.mark.parametrize("made", [NUMBA, "triton"], indirect=True)
@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    children=st.integers(1, 20), features=st.integers(1, 50), units=st.tuples(st.integers(1, 70), st.integers(1, 70)),
    frequencies=st.integers(0, 10), yaw=st.floats(-2.0, 2.0),
    appearance=st.sampled_from(["imia", "imia-glints", "plain"]),
)  # fmt: skip
def test_any_sizes(children, features, units, frequencies, yaw, appearance, made):
    geometry = {"name": "imve", "hidden": units[0], "frequencies": frequencies}
    heads = {"geometry_head": geometry, "appearance_head": {"name": appearance, "hidden": units[1]}}
    field = made("scaffold", children=children, features=features, voxel_size=4.0, **heads)
    assert_as_defined(field, camera_at(4.0, 0.5, 8.0, yaw=yaw))


@pytest.mark.parametrize("name", ["coliags", "scaffold", "with incidence"])
def test_derivatives_with_respect_to_the_pose(name, made):
    """Derivatives reach the viewing directions, distances and cosines, and gamma of them."""
    gradients = []
    for field in (made(name), make(name).double()):
        pose = CAMERA.camera_to_world.to(field.anchors.dtype, copy=True).requires_grad_()
        derived(field, replace(CAMERA, camera_to_world=pose))
        gradients.append(pose.grad.double())
    assert gradients[1].abs().max() > 0
    torch.testing.assert_close(gradients[0], gradients[1], rtol=2e-3, atol=2e-4 * float(gradients[1].abs().max()))


def test_any_number_of_threads_gives_the_same_bits():
    results = []
    for count in (1, 2, 3, 5):
        torch.set_num_threads(count)
        results.append(derived(make("coliags"), CAMERA))
    for drawn, gradients in results[1:]:
        assert all(torch.equal(getattr(drawn, name), getattr(results[0][0], name)) for name in OUTPUTS)
        assert all(torch.equal(gradients[name], results[0][1][name]) for name in gradients)


def test_the_law_is_bounded_close_to_the_lamp_and_beside_it():
    """Neither the law nor its derivatives depend on a distance, cosine or incidence at its bound."""
    fields = [make("with incidence"), make("with incidence").double()]
    results = []
    for field in fields:
        head = field.appearance_head
        generator = torch.Generator().manual_seed(4)
        towards = torch.nn.functional.normalize(torch.randn(333, 3, generator=generator, dtype=torch.float64), dim=1)
        steps = torch.logspace(-3, 1, 333, dtype=torch.float64)[:, None] * float(head.reference)
        positions = (CAMERA.center + towards * steps).to(field.anchors.dtype)
        normals = torch.nn.functional.normalize(towards.flip(1) + 0.1, dim=1).to(positions)
        colors = torch.rand(333, 3, generator=generator).to(positions).requires_grad_()
        lit = head.apply_light(colors, positions, normals, CAMERA.to("cpu", positions.dtype), None)
        (lit * torch.rand(lit.shape, generator=generator).to(lit)).sum().backward()
        results.append((lit, colors.grad, head.exponents.grad, head.lamp_offset.grad))
    for name, actual, expected_values in zip(("lit", "colors", "exponents", "offset"), *results, strict=True):
        atol = 2e-5 * float(expected_values.detach().abs().max())
        assert torch.isclose(actual.double(), expected_values, rtol=1e-4, atol=atol).all(), name


def test_nothing_visible_is_nothing_drawn(made):
    field = made("coliags")
    behind = replace(CAMERA, camera_to_world=camera_at(0.0, 0.0, 1e4).camera_to_world)
    drawn, gradients = derived(field, behind)
    assert len(drawn) == len(drawn.visible_sources) == 0
    assert not any(gradient.any() for gradient in gradients.values())


def test_what_is_not_a_number_is_not_hidden(made):
    field = made("coliags")
    first = int(field.visible_anchors(CAMERA)[0])
    kept = field.gaussians(CAMERA).source_index // field.slots_per_element
    assert (kept == first).any()
    with torch.no_grad():
        field.features[first] = torch.nan
    drawn = field.gaussians(CAMERA)
    assert not (drawn.source_index // field.slots_per_element == first).any()  # as nan > 0 is false
    with torch.no_grad():
        field.appearance_head.color_mlp[2].bias[0] = torch.nan
    assert field.gaussians(CAMERA).colors.isnan().any()


def test_visible_anchors_are_those_whose_sphere_is_in_the_frustum(made):
    field = made("coliags")
    with torch.no_grad():
        field.scalings.copy_(3.0 * torch.rand(field.scalings.shape, generator=torch.Generator().manual_seed(3)) - 2.0)
    for camera in (CAMERA, camera_at(0.0, 0.0, 0.0), camera_at(4.0, 3.0, 1.0, yaw=1.0)):
        wide = copy.deepcopy(field).cpu().double()
        reach = (wide.offsets * wide.scalings[:, None, :3].exp()).norm(dim=2).amax(dim=1)
        radii = reach + DRAWN_SIGMAS * wide.scalings[:, 3:].amax(dim=1).exp()
        near = spheres_in_frustum(wide.anchors, radii - 1e-3, camera)
        far = spheres_in_frustum(wide.anchors, radii + 1e-3, camera)
        visible = torch.zeros_like(near)
        visible[field.gaussians(camera).visible_sources.cpu()] = True
        assert near.any() and not far.all()
        assert (near <= visible).all() and (visible <= far).all()


def test_a_head_with_a_forward_of_its_own_says_what_decodes(made):
    """Kernels, which decode by networks, would skip it without notice."""

    def halved(head, visible):
        opacities, covariances = PlainGeometryHead.forward(head, visible)
        return opacities / 2, covariances

    with pytest.raises(TypeError, match="Halved overrides forward"):
        type("Halved", (PlainGeometryHead,), {"forward": halved})
    field = made("scaffold")
    whole = field.gaussians(CAMERA)
    field.geometry_head.__class__ = type("Halved", (PlainGeometryHead,), {"forward": halved, "decoding": "forward"})
    field.appearance_head.__class__ = type("Same", (PlainAppearanceHead,), {})
    half = field.gaussians(CAMERA)
    torch.testing.assert_close(half.opacities, whole.opacities / 2)
    torch.testing.assert_close(half.colors, whole.colors)
