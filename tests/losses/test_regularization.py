"""Normals of depth maps, and the losses of surfels, opacity, gains and Gaussians."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from coliags_plugin.contracts import Schedule
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.gaussians import rotation_matrices
from coliags_plugin.engine.model import Model
from coliags_plugin.losses.regularization import depth_normals
from coliags_plugin.modules.exposure import FrameGain
from tests.fields.made import make_field
from tests.losses import terms
from tests.losses.terms import make, make_output
from tests.renderers.test_surfels import facing_along, make_surfels
from tests.renderers.test_torch_renderer import render_gaussians, rigid
from tests.scenes import plain_frame as make_frame
from tests.scenes import wall_scene


def off_centre(width=23, height=17, pose=None):
    pose = torch.eye(4, dtype=torch.float64) if pose is None else pose
    return Camera(31.0, 27.0, 9.3, 8.9, width, height, pose)


# --- normals of depth -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("normal", [[0.0, 0.0, -1.0], [0.4, -0.3, -0.8], [-0.6, 0.2, -0.5]])
def test_normals_of_a_plane_are_exact(normal):
    normal = torch.nn.functional.normalize(torch.tensor(normal, dtype=torch.float64), dim=0)
    camera = off_centre()
    depth = -5.0 / (camera.rays() @ normal)  # n . z r = -5: the plane is seen from its front
    assert (depth > 0).all()
    gradients = depth_normals(depth, dataclasses.replace(camera, camera_to_world=rigid(3)[0]), depth > 0)
    torch.testing.assert_close(gradients[1:-1, 1:-1], normal.expand(15, 21, 3))
    border = gradients.clone()
    border[1:-1, 1:-1] = 0
    assert not border.any()


@pytest.mark.parametrize(("pixels", "bound"), [(24, 4e-3), (96, 3e-4)])
def test_normals_of_a_sphere_converge_to_the_second_order(pixels, bound):
    # Seen from inside at its centre plus an offset, so that all rays meet it.
    centre, radius = torch.tensor([0.3, -0.2, 1.0], dtype=torch.float64), 4.0
    camera = Camera(0.8 * pixels, 0.9 * pixels, 0.45 * pixels, 0.55 * pixels, pixels, pixels, torch.eye(4).double())
    rays = camera.rays()
    along, squared = (rays * centre).sum(-1), rays.square().sum(-1)
    depth = (along + torch.sqrt(along**2 - squared * (centre @ centre - radius**2))) / squared
    true = (centre - camera.unproject(depth)) / radius
    error = (depth_normals(depth, camera, depth > 0) - true)[1:-1, 1:-1].norm(dim=-1)
    assert error.max() < bound


def test_unknown_depths_reach_their_neighbours_only():
    camera, depth = off_centre(), torch.full((17, 23), 5.0, dtype=torch.float64)
    spoiled, known = depth.clone(), torch.ones(17, 23, dtype=torch.bool)
    spoiled[8, 10], known[8, 10] = torch.nan, False
    spoiled.requires_grad_()
    gradients, whole = depth_normals(spoiled, camera, known), depth_normals(depth, camera, depth > 0)
    beside = torch.zeros_like(known)
    beside[[7, 9, 8, 8], [10, 10, 9, 11]] = True
    assert not gradients[beside].any()
    torch.testing.assert_close(gradients[~beside], whole[~beside])
    gradients[..., 0].sum().backward()
    assert spoiled.grad.isfinite().all() and spoiled.grad[8, 10] == 0 and spoiled.grad.any()


@pytest.mark.parametrize("size", [(1, 1), (2, 5), (5, 2), (3, 3)])
def test_maps_too_small_for_differences_have_no_normals(size):
    camera = Camera(5.0, 5.0, 1.0, 1.0, size[1], size[0], torch.eye(4))
    gradients = depth_normals(torch.ones(size), camera, torch.ones(size, dtype=torch.bool))
    assert gradients.shape == (*size, 3)
    assert gradients.any() == (size == (3, 3))


# --- losses -----------------------------------------------------------------------------------------------------------


def frame(mask=None):
    return make_frame(torch.zeros(17, 23, 3, dtype=torch.uint8), mask=mask)


@pytest.mark.parametrize("depth", ["depth_expected", "depth_median"])
@pytest.mark.parametrize("tilt", [0.0, 40.0])
def test_a_plane_of_surfels_is_consistent(depth, tilt):
    term = make("normal-consistency", depth=depth)
    assert term.loss.wants == {"normals", depth} and term.loss.whole_image
    turn = math.radians(tilt)
    normal = torch.tensor([[0.0, -math.sin(turn), math.cos(turn)]], dtype=torch.float64)
    quats = facing_along(normal)
    steps = torch.cartesian_prod(*[0.5 * torch.arange(-13, 14, dtype=torch.float64)] * 2)
    means = 5.0 * math.cos(turn) * normal + steps @ rotation_matrices(quats)[0].T[:2]
    surfels = make_surfels(means, 0.35, 0.9, quats=quats.expand(len(means), 4))
    output = render_gaussians(surfels, off_centre(), ("normals", depth))
    alpha = output.alpha
    inside = torch.zeros(17, 23, dtype=torch.bool)
    inside[1:-1, 1:-1] = True
    # <N, n> = alpha there, times the detached alpha; the border enters as 1.
    expected = torch.where(inside, 1 - alpha**2, 1.0).mean()
    assert term(output, frame()).item() == pytest.approx(expected.item(), abs=1e-9)
    assert expected < 0.3


def test_alpha_of_the_weight_has_no_gradient():
    normals = torch.zeros(17, 23, 3)
    normals[..., 2] = -1.0
    alpha = torch.full((17, 23), 0.5, requires_grad=True)
    output = make_output(torch.zeros(17, 23, 3), alpha=alpha, normals=normals.requires_grad_(),
                         depth_expected=torch.full((17, 23), 5.0, requires_grad=True))  # fmt: skip
    output = dataclasses.replace(output, camera=off_centre())
    value = make("normal-consistency")(output, frame())
    assert value.item() == pytest.approx(1 - 0.5 * 15 * 21 / (17 * 23), rel=1e-6)
    value.backward()
    assert alpha.grad is None and normals.grad.any()


# --- opacity ----------------------------------------------------------------------------------------------------------


def test_opacity_is_the_mean_transparency_of_valid_pixels_and_distortion_the_mean_of_its_output():
    alpha = torch.tensor([[1.0, 0.75], [0.25, torch.nan]], requires_grad=True)
    mask = torch.tensor([[True, True], [True, False]])
    frame = make_frame(torch.zeros(2, 2, 3, dtype=torch.uint8), mask=mask)
    output = make_output(torch.zeros(2, 2, 3), alpha=alpha, distortion=torch.tensor([[0.1, 0.2], [0.6, torch.nan]]))
    term = make("opacity")(output, frame)
    term.backward()
    assert term.item() == pytest.approx((0.0 + 0.25 + 0.75) / 3)
    assert alpha.grad.flatten().tolist() == pytest.approx([-1 / 3, -1 / 3, -1 / 3, 0.0])
    assert make("distortion")(output, frame).item() == pytest.approx(0.3)
    output = make_output(torch.zeros(4, 1, 3), normals=torch.zeros(4, 1, 3), depth_expected=torch.zeros(4, 1))
    with pytest.raises(InputError, match="whole images"):
        make("normal-consistency")(output, make_frame(torch.zeros(4, 1, 3)))


# --- gains ------------------------------------------------------------------------------------------------------------


def of_gains(values, frames=9, **options):
    module = FrameGain(FrameGain.Settings(**options), wall_scene(frames))
    with torch.no_grad():
        module.log_gain.copy_(values)
    model = SimpleNamespace(view_modules={"exposure": module}, field=None)
    loss = make("smooth-gain").loss
    loss.check(model)
    return loss(terms.step(None, model=model))


def test_steady_changes_cost_nothing_and_others_their_squared_curvature():
    steady = 0.05 * torch.arange(1.0, 8.0)[:, None]
    assert of_gains(steady).item() == pytest.approx(0.0, abs=1e-12)
    bent = steady + torch.tensor([0, 0, 0, 0.1, 0, 0, 0])[:, None]  # changes of slope .1, -.2, .1 of five
    assert of_gains(bent).item() == pytest.approx((0.01 + 0.04 + 0.01) / 5, rel=1e-5)
    assert of_gains(bent.expand(-1, 3), channels=3).item() == pytest.approx((0.01 + 0.04 + 0.01) / 5, rel=1e-5)
    # Slopes are per frame of the video; frame 8 of ten is held out: a straight line over the gap costs nothing.
    times = torch.tensor([float(frame.index) for frame in wall_scene(11).train])
    assert of_gains(0.1 * times[:, None], frames=11).item() == pytest.approx(0.0, abs=1e-10)
    # A bend at frame 7, one frame behind the last and two before the next, is one of seven.
    bent = 0.1 * (times - 7.0).relu()[:, None]
    assert of_gains(bent, frames=11).item() == pytest.approx(0.01 / 1.5 / 7, rel=1e-5)
    few = of_gains(torch.tensor([[0.3]]), frames=2)
    assert few.item() == 0.0 and few.requires_grad


@pytest.mark.parametrize(("modules", "message"), [((), "a module 'gain'"), (("exposure",), "module 'exposur'")])
def test_other_methods_are_refused(modules, message):
    gains = FrameGain(FrameGain.Settings(), wall_scene())
    with pytest.raises(InputError, match=message):
        make("smooth-gain", module="exposur").loss.check(
            SimpleNamespace(view_modules=dict.fromkeys(modules, gains), field=None)
        )


# Losses of the Gaussians: factors of the diffuse reflection, variances of channels, volumes and normals


def of_channel(name, values, step=1, schedule=None, **options):
    """A loss of Gaussians with this channel."""
    output = make_output(torch.zeros(2, 2, 3), torch.zeros(len(values), 3))
    channel = options.get("attribute", "diffuse_factor")
    splats = replace(output.splats, gaussians=replace(output.splats.gaussians, features={channel: values}))
    return make(name, **options).loss(terms.step(replace(output, splats=splats), number=step, schedule=schedule))


FACTORS = torch.tensor([[1.0, 2.0, 1.0], [1.0, 1.0, -1.0]])


@pytest.mark.parametrize(
    ("step", "schedule", "share", "options"),
    [
        *(
            (step, Schedule(steps, 40_000), share, {"from_step": 1000, "until_step": 20_000})
            for step, steps, share in (
                (1001, 40_000, 18_999 / 19_000),
                *((10_500, 40_000, 0.5), (20_000, 40_000, 0.0), (25_000, 40_000, 0.0)),
                *((105, 400, 0.5), (5, 400, 1.0)),
            )
        ),
        (50, Schedule(100, 100), 0.5, {}),  # without an end, it ends with the run
    ],
)
def test_factors_are_held_near_one_less_and_less(step, schedule, share, options):
    term = of_channel("diffuse-factor", FACTORS, step, schedule, **options)
    assert term.item() == pytest.approx(share * (1 + 4) / 6)


def test_the_variance_is_around_the_mean_of_each_component():
    values = torch.tensor([[1.0, 10.0], [3.0, 10.0], [5.0, 13.0]], requires_grad=True)
    term = of_channel("attribute-variance", values, attribute="albedo")
    assert term.item() == pytest.approx(values.var(0, unbiased=False).mean().item())
    term.backward()
    assert values.grad[0, 0] < 0 < values.grad[2, 0]
    assert values.grad[1, 0] == 0


@pytest.mark.parametrize(
    ("name", "options", "channels", "words"),
    [
        ("diffuse-factor", {}, {"albedo"}, "'diffuse_factor' of the Gaussians, and the field has albedo"),
        ("attribute-variance", {"attribute": "albdo"}, {"albedo", "f0"}, "Did you mean 'albedo'"),
        ("attribute-variance", {"attribute": "albedo"}, set(), "and the field has none.*lit-gaussians"),
    ],
)
def test_a_field_without_the_channel_is_refused(name, options, channels, words):
    model = SimpleNamespace(field=SimpleNamespace(feature_channels=frozenset(channels)))
    with pytest.raises(InputError, match=words):
        make(name, **options).loss.check(model)


# Scales


def anisotropy(scales, **options):
    return make("anisotropy", **options)(make_output(torch.zeros(2, 2, 3), scales), make_frame(torch.zeros(2, 2, 3)))


def test_anisotropy_counts_needles_and_neither_discs_nor_spheres():
    disc, sphere, needle = [0.01, 2.0, 2.0], [1.0, 1.0, 1.0], [8.0, 0.5, 0.01]
    assert anisotropy(torch.tensor([disc, sphere])).item() == 0.0
    assert anisotropy(torch.tensor([disc, needle])).item() == pytest.approx(math.log(16 / 4) / 2)
    assert anisotropy(torch.tensor([needle[:2]]), max_ratio=2.0).item() == pytest.approx(math.log(16 / 2))


@given(scale=st.floats(1e-3, 1e3), ratio=st.floats(4.1, 1e4))
def test_anisotropy_needs_no_unit_of_length_and_pulls_alike_at_every_ratio(scale, ratio):
    scales = torch.tensor([[ratio, 1.0, 0.3]]).mul(scale).log().requires_grad_()
    term = anisotropy(scales.exp())
    term.backward()
    assert term.item() == pytest.approx(math.log(ratio / 4), abs=1e-4)
    assert scales.grad[0].tolist() == pytest.approx([1.0, -1.0, 0.0], abs=1e-4)


def test_anisotropy_of_a_scale_that_underflows_has_a_finite_gradient():
    scales = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]], requires_grad=True)
    anisotropy(scales).backward()
    assert scales.grad.tolist() == [[0.5, 0.0, 0.0], [0.0, 0.0, 0.0]]


def volume(scales):
    return make("scale-volume")(make_output(torch.zeros(2, 2, 3), scales), make_frame(torch.zeros(2, 2, 3)))


def test_scale_volume_is_the_mean_product_and_a_scale_of_zero_keeps_its_gradient_finite():
    scales = torch.tensor([[1.0, 2.0, 3.0], [0.5, 0.5, 4.0]])
    assert volume(scales).item() == (6.0 + 1.0) / 2
    assert volume(scales[:, :2]).item() == (2.0 + 0.25) / 2
    scales = torch.tensor([[0.0, 2.0, 3.0]], requires_grad=True)
    volume(scales).backward()
    assert scales.grad.tolist() == [[6.0, 0.0, 0.0]]


# Normals


def turned_field(degrees, scales=(1.0, 1.0, 0.1)):
    """Gaussians on the wall z = 20 whose shortest axes are turned away from its normal."""
    field = make_field("gaussians", normal_neighbours=10)
    half = math.radians(degrees) / 2
    with torch.no_grad():
        field.scales.copy_(torch.tensor(scales).log().expand_as(field.scales))
        field.quats.copy_(torch.tensor([math.cos(half), math.sin(half), 0.0, 0.0]).expand_as(field.quats))
    return field


def value(field, step=2, **options):
    output, model = make_output(torch.zeros(2, 2, 3)), Model(field, None, {})
    return make("surface-normals", **options).loss(terms.step(output, model=model, number=step))


@pytest.mark.parametrize("degrees", [0.0, 30.0, 90.0, 150.0])
def test_one_minus_the_cosine_of_the_shortest_axis_to_the_surface(degrees):
    expected = 1.0 - abs(math.cos(math.radians(degrees)))
    assert value(turned_field(degrees)).item() == pytest.approx(expected, abs=1e-6)
    other = 1.0 - abs(math.sin(math.radians(degrees)))
    assert value(turned_field(degrees, scales=(1.0, 0.1, 1.0))).item() == pytest.approx(other, abs=1e-6)


def test_only_every_so_many_steps_and_towards_the_surface():
    field = turned_field(30.0)
    zeros = [value(field, step, every=3).item() == 0.0 for step in range(1, 7)]
    assert zeros == [True, True, False, True, True, False]
    value(field).backward()
    assert field.scales.grad is None
    with torch.no_grad():
        field.quats -= 0.3 * len(field.means) * field.quats.grad
    assert value(field) < value(turned_field(30.0))


def test_fields_without_references_are_refused():
    with pytest.raises(InputError, match=r"and the field has none.*normal_neighbours=10"):
        make("surface-normals").loss.check(Model(make_field("gaussians"), None, {}))
