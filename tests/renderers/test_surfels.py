"""Surfels drawn by the torch renderer, against closed forms and a naive renderer; and what both primitives share."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from coliags_plugin.core import registry
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.render_output import OUTPUTS
from coliags_plugin.engine.model import Model
from coliags_plugin.renderers import compositing, torch_renderer
from coliags_plugin.renderers.torch_renderer import TorchRenderer, TorchRendererSettings
from coliags_plugin.renderers.volume_renderer import VolumeRenderer, VolumeRendererSettings
from tests.renderers.naive import splat, splat_surfels
from tests.renderers.test_torch_renderer import (
    INPUTS,
    SUMS,
    FieldOf,
    cast,
    make,
    moved,
    pinhole,
    random_cotangents,
    random_gaussians,
    relative,
    render_gaussians,
    rigid,
    with_gradients,
)
from tests.renderers.test_torch_renderer import OUTPUTS as SOLID_OUTPUTS
from tests.renderers.test_torch_renderer import SCENES as SCENES_OF_GAUSSIANS
from tests.renderers.test_torch_renderer import scene as scene_of_gaussians

BACKGROUND = (0.3, 0.1, 0.9)
#: Depth of an intersection that tells a ray and a disc are all but parallel, in scenes 9 deep at most: relative errors
#: of such depths, and of what depends on them, are as much larger than those of the input.
GRAZING = 50.0


def as_surfels(gaussians):
    return dataclasses.replace(gaussians, scales=gaussians.scales[:, :2].contiguous())


def solid(gaussians):
    return gaussians


#: Makes of 3D Gaussians what is to be drawn.
of_each = pytest.mark.parametrize("primitive", [solid, as_surfels], ids=["gaussians3d", "surfels"])


def make_surfels(means, scales, opacities, colors=None, quats=None):
    means = torch.as_tensor(means, dtype=torch.float64).reshape(-1, 3)
    scales = torch.as_tensor(scales, dtype=torch.float64).expand(len(means), 2)
    return as_surfels(make(means, torch.nn.functional.pad(scales, (0, 1)), opacities, colors, quats))


def facing_along(normals, seed=0):
    """Quaternions of discs of these normals, turned at random about them."""
    generator = torch.Generator().manual_seed(seed)
    normals = torch.nn.functional.normalize(normals, dim=-1)
    random = torch.randn(normals.shape, generator=generator, dtype=torch.float64)
    first = torch.nn.functional.normalize(torch.linalg.cross(random, normals), dim=-1)
    axes = torch.stack([first, torch.linalg.cross(normals, first), normals], dim=-1)
    xyzw = torch.from_numpy(Rotation.from_matrix(axes.numpy()).as_quat())
    return xyzw[:, [3, 0, 1, 2]]


def scene(name):
    """A camera and surfels, both in a moved world frame, float64."""
    if name not in ("edge-on", "tiny", "across the near plane", "in front of one another"):
        gaussians, camera = scene_of_gaussians(name)
        gaussians = as_surfels(gaussians)
        return dataclasses.replace(gaussians, **{k: getattr(gaussians, k)[:80] for k in INPUTS}), camera
    camera = pinhole(37, 26, 31.0, 27.0, 16.3, 14.9)
    if name == "edge-on":
        gaussians = random_gaussians(60, 1)
        sight = torch.nn.functional.normalize(gaussians.means, dim=-1)
        across = torch.linalg.cross(
            sight, torch.randn(sight.shape, generator=torch.Generator().manual_seed(0)).double()
        )
        tilt = torch.logspace(-4, -1, len(sight), dtype=torch.float64)[:, None]
        quats = facing_along(torch.nn.functional.normalize(across, dim=-1) + tilt * sight)
        gaussians = dataclasses.replace(gaussians, quats_wxyz=quats)
    elif name == "tiny":
        gaussians = random_gaussians(80, 2, scale=(1e-6, 0.3))
    elif name == "across the near plane":
        gaussians = random_gaussians(40, 3, depth=(0.1, 1.0), scale=(0.1, 0.6), opacity=(0.02, 0.3))
    else:
        gaussians = random_gaussians(60, 4, depth=(2.0, 2.3), scale=(0.2, 0.6), opacity=(0.05, 0.4))
    transform, quat = rigid(11)
    return as_surfels(moved(gaussians, transform, quat)), dataclasses.replace(camera, camera_to_world=transform)


#: Scenes and the accuracy of float32 that they allow: outputs, gradients.
SCENES = {
    "random": (2e-5, 1e-4),
    "needles": (2e-4, 1e-3),
    "around the camera": (1e-5, 1e-4),
    "crowd in one tile": (2e-4, 2e-4),
    "opaque": (1e-5, 3e-4),
    "one pixel wide": (1e-5, 1e-4),
    "one pixel": (1e-5, 1e-4),
    "off centre": (1e-5, 1e-4),
    "edge-on": (1e-3, 2e-3),
    "tiny": (1e-5, 1e-4),
    "across the near plane": (1e-5, 1e-4),
    "in front of one another": (1e-5, 1e-4),
}


def outputs_of(gaussians, renderer=TorchRenderer):
    outputs = renderer.outputs_of("surfels" if gaussians.scales.shape[1] == 2 else "gaussians3d")
    return tuple(name for name in OUTPUTS if name in outputs)


def ours(**options):
    def draw(gaussians, camera):
        wants = outputs_of(gaussians)
        output = render_gaussians(gaussians, camera, wants, TorchRendererSettings(background=BACKGROUND, **options))
        return {name: output[name] for name in wants}, output.splats

    return draw


def naive(gaussians, camera, **options):
    return (splat_surfels if gaussians.scales.shape[1] == 2 else splat)(gaussians, camera, BACKGROUND, **options)


def cotangents_of(gaussians, camera, seed=1):
    names = OUTPUTS if gaussians.scales.shape[1] == 2 else SUMS
    return random_cotangents(camera, names, seed, torch.float64)


def without(pixels, cotangents):
    return {k: torch.where(pixels[..., None] if v.ndim == 3 else pixels, 0.0, v) for k, v in cotangents.items()}


# --- against the naive renderer ---------------------------------------------------------------------------------------


ALL_SCENES = [(solid, name) for name in SCENES_OF_GAUSSIANS] + [(as_surfels, name) for name in SCENES]
#: Scenes that are cheap in tiles of one pixel, and in one tile.
SMALL = ("one pixel wide", "one pixel", "off centre")


@pytest.mark.parametrize(("primitive", "name"), ALL_SCENES)
def test_agrees_with_the_naive_renderer(primitive, name):
    are_surfels = primitive is as_surfels
    gaussians, camera = (scene if are_surfels else scene_of_gaussians)(name)
    wants, single = outputs_of(gaussians), SCENES[name] if are_surfels else (1e-5, 1e-5)
    # Numbers that float32 holds exactly, so that both precisions see the same.
    gaussians, camera = cast(gaussians, torch.float32), camera.to(dtype=torch.float32)
    exact, exact_camera = cast(gaussians, torch.float64), camera.to(dtype=torch.float64)
    grazing = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    if are_surfels:
        grazing = naive(exact, exact_camera)[0]["farthest"] > GRAZING
        assert grazing.float().mean() <= 0.05
    cotangents = without(grazing, cotangents_of(gaussians, camera))
    true, centers, true_gradients = with_gradients(naive, exact, exact_camera, cotangents)
    assert true["alpha"].any()
    assert not are_surfels or all(true[key].any() for key in wants if (name, key) != ("one pixel", "depth_median"))
    for dtype, bounds in ((torch.float64, (1e-11, 1e-9 if are_surfels else 1e-11)), (torch.float32, single)):
        for tile_size in (8,) if dtype == torch.float32 else (1, 64) if name in SMALL else (5, 16):
            case = (dtype, tile_size)
            outputs, splats, gradients = with_gradients(
                ours(tile_size=tile_size), cast(gaussians, dtype), camera.to(dtype=dtype), cotangents
            )
            for key in wants:
                assert outputs[key].dtype == dtype
                assert relative(outputs[key][~grazing], true[key][~grazing]) <= bounds[0], (*case, key)
            for key, gradient in gradients.items():
                allowed = 10 * bounds[1] if key == "pose" and dtype == torch.float32 else bounds[1]  # cancels
                if are_surfels and (name, key) == ("crowd in one tile", "scales"):  # all filtered
                    assert not gradient.any() and true_gradients[key].abs().max() < 1e-9
                else:
                    assert relative(gradient, true_gradients[key]) <= allowed, (*case, key)
            for i, center in centers.items():
                torch.testing.assert_close(splats.means2d[i].double(), center, rtol=1e-5, atol=1e-5)


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**31), tile_size=st.integers(1, 9), size=st.floats(1e-3, 3.0), depth=st.floats(0.21, 4.0))
def test_tiles_miss_no_pixel_that_a_surfel_reaches(seed, tile_size, size, depth):
    gaussians = as_surfels(
        random_gaussians(
            1, seed, depth=(depth, 1.5 * depth), scale=(0.1 * size, size), opacity=(0.003, 1.0), spread=1.5
        )
    )
    camera = pinhole(13, 11, 9.0, 8.0)
    output = render_gaussians(gaussians, camera, settings=TorchRendererSettings(tile_size=tile_size))
    alpha = splat_surfels(gaussians, camera)[0]["alpha"]
    torch.testing.assert_close(output.alpha, alpha, rtol=1e-9, atol=1e-12)
    assert output.splats.radii.item() > 0 or not alpha.any()


@pytest.mark.parametrize("seed", range(3))
def test_nor_in_float32_where_discs_are_seen_edge_on(seed, monkeypatch):
    gaussians = random_gaussians(200, seed, depth=(0.21, 9.0), scale=(1e-3, 2.0), opacity=(0.004, 0.05))
    sight = torch.nn.functional.normalize(gaussians.means, dim=-1)
    across = torch.linalg.cross(sight, gaussians.quats_wxyz[:, :3])
    tilt = torch.logspace(-7, 0, len(sight), dtype=torch.float64)[:, None]
    quats = facing_along(torch.nn.functional.normalize(across, dim=-1) + tilt * sight)
    gaussians = as_surfels(cast(dataclasses.replace(gaussians, quats_wxyz=quats), torch.float32))
    camera = pinhole(61, 52, 60.0, 55.0, dtype=torch.float32)
    plain = render_gaussians(gaussians, camera).alpha
    extents_of = torch_renderer.surfel_extents

    def reaching_everywhere(projected, opacities, *rest):
        extents = extents_of(projected, opacities, *rest)
        everywhere, edge = torch.ones_like(extents.everywhere), torch.tensor([61.0, 52.0]).expand_as(extents.high)
        return dataclasses.replace(
            extents, everywhere=everywhere, low=0 * edge, high=edge, drawn=projected.visible & (opacities >= 1 / 255)
        )

    monkeypatch.setattr(torch_renderer, "surfel_extents", reaching_everywhere)
    missed = (render_gaussians(gaussians, camera).alpha - plain).abs().max()
    assert missed < 1e-6  # of 1/255 at least, if any


@of_each
@pytest.mark.parametrize("elements", [1, 2000, 2**22])
def test_the_size_of_the_working_set_changes_nothing(primitive, elements, monkeypatch):
    gaussians, camera = (
        scene("in front of one another") if primitive is as_surfels else scene_of_gaussians("one pixel wide")
    )
    cotangents = cotangents_of(gaussians, camera)
    plain, _, gradients = with_gradients(ours(), gaussians, camera, cotangents)
    monkeypatch.setitem(compositing.CHUNK_ELEMENTS, "cpu", elements)
    monkeypatch.setattr(compositing, "_MIN_RANKS", 3)
    monkeypatch.setattr(compositing, "_MAX_RANKS", 7)
    other, _, other_gradients = with_gradients(ours(), gaussians, camera, cotangents)
    for key in cotangents:
        torch.testing.assert_close(other[key], plain[key], rtol=1e-10, atol=1e-10)
    for key, gradient in gradients.items():
        torch.testing.assert_close(other_gradients[key], gradient, rtol=1e-8, atol=1e-8)


@of_each
def test_two_calls_agree_to_the_bit(primitive):
    gaussians = cast(primitive(random_gaussians(3000, 12, scale=(0.01, 0.08))), torch.float32)
    camera = pinhole(64, 48, 55.0, 55.0, dtype=torch.float32)
    cotangents = cotangents_of(gaussians, camera)
    first, second = (with_gradients(ours(), gaussians, camera, cotangents) for _ in range(2))
    assert all(torch.equal(first[0][k], second[0][k]) for k in cotangents)
    assert all(torch.equal(first[2][k], second[2][k]) for k in first[2])


@pytest.mark.parametrize(
    ("primitive", "name"),
    [*((as_surfels, name) for name in ("random", "in front of one another", "tiny")), (solid, "one pixel wide")],
)
def test_gradient_of_means2d_is_that_of_moving_gaussians_in_the_image_but_of_surfels_the_intersections_alone(
    primitive, name
):
    gaussians, camera = (scene if primitive is as_surfels else scene_of_gaussians)(name)
    cotangents = cotangents_of(gaussians, camera)
    _, splats, _ = with_gradients(ours(), gaussians, camera, cotangents)
    shifts = torch.zeros(len(gaussians), 2, dtype=torch.float64, requires_grad=True)
    outputs, centers = naive(gaussians, camera, shifts=shifts)
    sum((outputs[key] * cotangent).sum() for key, cotangent in cotangents.items()).backward()
    seen = list(centers)
    assert relative(splats.means2d.grad[seen], shifts.grad[seen]) < 1e-9


# --- closed forms -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("deviation", [math.sqrt(0.5), 2.0])
def test_a_disc_smaller_than_a_pixel_is_drawn_by_the_filter(deviation):
    options = TorchRendererSettings(surfel_filter=deviation)
    output = render_gaussians(make_surfels([0, 0, 5.0], 1e-5, 0.7), pinhole(), settings=options)
    rows, columns = torch.meshgrid(torch.arange(7.0) - 3, torch.arange(9.0) - 4, indexing="ij")
    expected = 0.7 * torch.exp(-0.5 * (rows**2 + columns**2).double() / deviation**2)
    torch.testing.assert_close(output.alpha, torch.where(expected < 1 / 255, 0.0, expected), rtol=1e-7, atol=1e-12)


def test_the_radius_of_a_disc_is_that_of_its_longer_axis():
    radii = render_gaussians(make_surfels([0, 0, 5.0], (0.5, 0.75), 0.3), pinhole()).splats.radii
    tau = 2 * math.log(255 * 0.3) + 0.01  # the slack of binning
    assert radii.tolist() == [math.ceil(math.sqrt(tau * (20.0 * 0.75 / 5.0) ** 2 + 1e-4))]


# --- distortion -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("far", [100.0, 6.0])
def test_distortion_of_two_discs(far):
    near, settings = 0.2, TorchRendererSettings(distortion_far=far)
    discs = make_surfels([[0, 0, 3.0], [0, 0, 4.0]], 1e4, torch.tensor([0.4, 0.5], dtype=torch.float64))
    found = render_gaussians(discs, pinhole(), ("distortion",), settings)["distortion"][3, 4]
    first, second = (far / (far - near) * (1 - near / z) for z in (3.0, 4.0))
    assert found.item() == pytest.approx(0.4 * 0.6 * 0.5 * (first - second) ** 2, rel=1e-9)


def test_distortion_of_close_discs_survives_float32():
    depths = torch.linspace(50.0, 50.2, 20, dtype=torch.float64)  # m differs by 1.6e-5, m^2 would need nine digits
    discs = cast(make_surfels(torch.nn.functional.pad(depths[:, None], (2, 0)), 50.0, 0.1), torch.float32)
    camera = pinhole()
    true = splat_surfels(discs, camera)[0]["distortion"]
    ours32 = render_gaussians(discs, camera.to(dtype=torch.float32), ("distortion",))["distortion"]
    assert relative(ours32, true) < 1e-4


# --- culling and emptiness --------------------------------------------------------------------------------------------


@of_each
def test_the_near_plane_is_the_cameras(primitive):
    gaussians, camera = scene_of_gaussians("around the camera")
    gaussians = primitive(gaussians)
    output = render_gaussians(gaussians, dataclasses.replace(camera, near_plane=0.6))
    true, other = (naive(gaussians, camera, near_plane=near)[0]["alpha"] for near in (0.6, 0.2))
    torch.testing.assert_close(output.alpha, true, rtol=1e-9, atol=1e-12)
    assert (true - other).abs().max() > 0.1


@of_each
def test_equal_depths_keep_the_order_they_came_in(primitive):
    gaussians = primitive(make([[0, 0, 4.0], [0, 0, 4.0]], 0.3, 0.8, [[1.0, 0, 0], [0, 1.0, 0]]))
    rgb = render_gaussians(gaussians, pinhole()).rgb[3, 4]
    torch.testing.assert_close(rgb, torch.tensor([0.8, 0.16, 0.0], dtype=torch.float64))


# --- the component ----------------------------------------------------------------------------------------------------


def test_the_registered_component_renders_both_primitives_with_their_own_outputs():
    renderer_class = registry.renderers.get("torch")
    assert renderer_class is TorchRenderer and renderer_class.availability().ok
    assert renderer_class.primitives == {"gaussians3d", "surfels"}
    assert renderer_class.outputs_of("surfels") == set(OUTPUTS)
    assert renderer_class.outputs_of("gaussians3d") == renderer_class.outputs == set(SOLID_OUTPUTS)
    for field, wants in (
        (FieldOf(scene_of_gaussians("random")[0]), ("depth_expected",)),
        (FieldOf(scene("random")[0]), ("distortion",)),
    ):
        gaussians, camera = field.gaussians(None), scene("random")[1]
        output = renderer_class(renderer_class.Settings()).render(field, camera, wants)
        assert output.splats.gaussians is gaussians
        torch.testing.assert_close(
            output[wants[0]], render_gaussians(gaussians, camera, outputs_of(gaussians))[wants[0]]
        )
        with pytest.raises(KeyError):
            output["depth_median"]
    model = Model(field, TorchRenderer(TorchRendererSettings()), {})
    model.check_outputs(["distortion"], "a loss")
    torch.testing.assert_close(model.render(camera, wants)["distortion"], output["distortion"])
    field.primitive = "radiance"
    with pytest.raises(InputError, match="no renderer output 'distortion'"):
        VolumeRenderer(VolumeRendererSettings()).render(field, camera, wants)


@pytest.mark.parametrize(("far", "near"), [(0.2, 0.2), (100.0, 200.0)])
def test_a_near_plane_beyond_the_end_of_distortion_is_refused(far, near):
    with pytest.raises(InputError, match="distortion_far beyond the near plane"):
        TorchRenderer(TorchRendererSettings(distortion_far=far)).check_field(None, near)


def test_depths_cost_nothing_where_they_are_not_wanted(monkeypatch):
    gaussians, camera = scene("random")

    def never(*_):
        raise AssertionError("depths were composited")

    monkeypatch.setattr(compositing, "crossing_of_half", never)
    render_gaussians(cast(gaussians, grad=True), camera, ("normals",)).rgb.sum().backward()
    with pytest.raises(AssertionError):
        render_gaussians(gaussians, camera, ("depth_expected",))


@pytest.mark.gpu
@pytest.mark.parametrize(("primitive", "name"), ALL_SCENES)
def test_cuda_gives_the_numbers_of_the_cpu(primitive, name):
    gaussians, camera = (scene_of_gaussians if primitive is solid else scene)(name)
    clear = torch.ones(camera.height, camera.width, dtype=torch.bool)
    of_float32 = (1e-4, 1e-4)
    if primitive is as_surfels:
        clear, of_float32 = naive(gaussians, camera)[0]["farthest"] <= GRAZING, [10 * bound for bound in SCENES[name]]
    cotangents = without(~clear, cotangents_of(gaussians, camera))
    for dtype, bounds in ((torch.float64, (1e-9, 1e-8)), (torch.float32, of_float32)):
        results = [
            with_gradients(ours(), cast(gaussians, dtype, device), camera.to(device, dtype),
                           {k: v.to(device) for k, v in cotangents.items()})
            for device in ("cpu", "cuda")
        ]  # fmt: skip
        (on_cpu, _, cpu_gradients), (on_cuda, _, cuda_gradients) = results
        for key in on_cpu:
            assert on_cuda[key].device.type == "cuda"
            assert relative(on_cuda[key].cpu()[clear], on_cpu[key].double()[clear]) <= bounds[0], (dtype, key)
        for key, gradient in cpu_gradients.items():
            if gradient.any():
                assert relative(cuda_gradients[key].cpu(), gradient.double()) <= bounds[1], (dtype, key)
