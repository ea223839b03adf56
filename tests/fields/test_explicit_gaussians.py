"""Explicit Gaussians and surfels: their start, what a camera sees of them, and degrees that come one by one."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.special import sph_harm_y

from coliags_plugin.contracts import Schedule
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scenes import PointCloud
from coliags_plugin.core.tensors import point_normals, wall_normals
from coliags_plugin.fields.explicit_gaussians import AttenuatedGaussians
from coliags_plugin.fields.numba_kernels import spherical_harmonics as kernel
from coliags_plugin.fields.spherical_harmonics import Y0, basis, colors
from tests.fields.made import colored_wall, make_field
from tests.renderers.test_torch_renderer import render_gaussians
from tests.scenes import camera_at, wall_scene


def make(scene=None, **options):
    return make_field("gaussians", scene or colored_wall(), **options)


@pytest.mark.parametrize("name", ["gaussians", "surfels"])
def test_one_faint_round_gaussian_at_every_point(name):
    scene = colored_wall()
    field = make_field(name, scene)
    gaussians = field.gaussians(camera_at(0, 0, -50))
    points = scene.points.positions[gaussians.source_index]
    torch.testing.assert_close(gaussians.means, points)
    torch.testing.assert_close(gaussians.opacities, torch.full((len(points),), 0.1))
    torch.testing.assert_close(gaussians.colors, scene.points.colors[gaussians.source_index] / 255.0)
    # Points on a grid of 0.5 mm: inner ones have three neighbours at that distance.
    assert gaussians.scales.median().item() == pytest.approx(0.5, rel=1e-5)
    assert gaussians.scales.shape[1] == (2 if name == "surfels" else 3) and torch.equal(
        gaussians.scales[:, 0], gaussians.scales[:, 1]
    )
    if name == "gaussians":
        assert torch.equal(gaussians.quats_wxyz, torch.tensor([1.0, 0, 0, 0]).expand(len(points), 4))


def test_points_without_colours_are_grey_and_no_points_are_refused():
    gaussians = make(wall_scene()).gaussians(camera_at(0, 0, 0))
    torch.testing.assert_close(gaussians.colors, torch.full_like(gaussians.colors, 0.5))
    with pytest.raises(InputError, match="no initial points"):
        make(replace(wall_scene(), points=PointCloud(torch.zeros(0, 3))))


def test_culling_changes_no_image():
    field, camera = make(), camera_at(0.3, 0.2, 3.0, yaw=0.3)
    with torch.no_grad():
        field.scales += torch.randn(field.scales.shape, generator=torch.Generator().manual_seed(1))
    gaussians = field.gaussians(camera)
    assert 0 < len(gaussians) < len(field.means)
    field._in_view = lambda camera: torch.ones(len(field.means), dtype=torch.bool)
    everything = field.gaussians(camera)
    assert len(everything) == len(field.means)
    images = [render_gaussians(each, camera).rgb for each in (gaussians, everything)]
    torch.testing.assert_close(*images, rtol=0, atol=2e-6)


def test_degrees_come_one_by_one_and_are_saved():
    field, schedule = make(), Schedule(3000, 30_000)
    degrees = []
    for step in (1, 99, 100, 199, 200, 300, 2999):
        field.before_step(step, schedule)
        degrees.append(int(field.degree))
    assert degrees == [0, 0, 1, 1, 2, 3, 3]
    other = type(field).from_state(field.state_dict(), field.settings)
    camera = camera_at(0, 0, 0)
    with torch.no_grad():
        for each in (field, other):
            each.shN.fill_(0.1)
    assert torch.equal(field.gaussians(camera).colors, other.gaussians(camera).colors)
    other.before_step(1, schedule)
    assert not torch.equal(field.gaussians(camera).colors, other.gaussians(camera).colors)


def test_gradients_of_colours_are_the_basis_and_zero_where_colours_are_cut():
    field, camera = make().double(), camera_at(0.3, -0.2, 1.0)
    with torch.no_grad():
        field.shN.copy_(0.05 * torch.randn(field.shN.shape, generator=torch.Generator().manual_seed(3)))
        field.sh0[::2, :, 1] = -5.0  # green far below 0
    field.degree.fill_(2)
    gaussians = field.gaussians(camera)
    upstream = torch.randn(gaussians.colors.shape, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    (gaussians.colors * upstream).sum().backward()
    rows = gaussians.source_index
    directions = torch.nn.functional.normalize(field.means.detach()[rows] - camera.center, dim=1)
    expected = basis(directions, 2)[:, :, None] * (upstream * (gaussians.colors > 0))[:, None]
    torch.testing.assert_close(field.sh0.grad[rows], expected[:, :1])
    torch.testing.assert_close(field.shN.grad[rows][:, :8], expected[:, 1:])
    assert not field.shN.grad[:, 8:].any()  # of degree 3, not yet active
    assert not field.sh0.grad[rows[rows % 2 == 0], 0, 1].any()


def test_colours_fall_with_the_distance_to_the_lamp():
    """Attenuation to the power of each Gaussian's exponent, and no further than at half and twice its own distance."""
    plain = make()
    field = AttenuatedGaussians(plain.settings, plain.element_count)
    zero = torch.zeros_like(field.exponents)
    field.load_state_dict({**plain.state_dict(), "distances": field.distances, "exponents": zero})
    camera = camera_at(0.3, -0.2, 1.0)
    before, distances = plain.gaussians(camera), (plain.means - camera.center.float()).norm(dim=1, keepdim=True)
    torch.testing.assert_close(field.gaussians(camera).colors, before.colors)
    rows = before.source_index
    for ratio, bound in ((1.5, 1.5), (0.8, 0.8), (0.2, 0.5), (9.0, 2.0)):
        with torch.no_grad():
            field.exponents.copy_(torch.linspace(-1.0, 3.0, len(distances))[:, None])
            field.distances.copy_(distances / ratio)
        gaussians = field.gaussians(camera)
        torch.testing.assert_close(gaussians.colors, before.colors * bound ** -field.exponents[rows])
        upstream = torch.linspace(0.5, 2.0, gaussians.colors.numel()).reshape(gaussians.colors.shape)
        field.zero_grad()
        (gaussians.colors * upstream).sum().backward()
        expected = -math.log(bound) * (gaussians.colors * upstream).sum(dim=1, keepdim=True)
        torch.testing.assert_close(field.exponents.grad[rows], expected)


def test_gradients_of_logarithms_and_logits():
    field, camera = make().double(), camera_at(0, 0, 0)
    gaussians = field.gaussians(camera)
    (gaussians.scales.sum() + 3.0 * gaussians.opacities.sum()).backward()
    rows = gaussians.source_index
    torch.testing.assert_close(field.scales.grad[rows], gaussians.scales)
    torch.testing.assert_close(field.opacities.grad[rows], 3.0 * gaussians.opacities * (1.0 - gaussians.opacities))


# Surfels


def test_surfels_are_turned_at_random_and_restored_in_any_number():
    field = make_field("surfels", normal_neighbours=8)
    assert field.primitive == "surfels" and field.elements == "gaussians"
    assert field.references.of_rows.shape == (field.element_count, 3)
    quats = field.quats.detach()
    assert 0 <= quats.min() < 0.01 and 0.99 < quats.max() < 1
    torch.testing.assert_close(quats.mean(0), torch.full((4,), 0.5), rtol=0, atol=0.03)
    same, other = (make_field("surfels", seed=seed) for seed in (0, 1))
    assert torch.equal(same.quats, field.quats) and not torch.equal(other.quats, field.quats)
    state = {name: value[:7] if value.ndim else value for name, value in same.state_dict().items()}
    restored = type(same).from_state(state, same.settings)
    assert restored.element_count == 7 and restored.scales.shape == (7, 2)


def test_their_normals_are_those_that_are_drawn():
    field = make_field("surfels")
    with torch.no_grad():
        field.opacities.fill_(5.0)
    camera = camera_at(0.0, 0.0, 0.0)
    gaussians = field.gaussians(camera.to(dtype=torch.float32))
    index = int(gaussians.means[:, :2].norm(dim=1).argmin())
    normal = field.normals()[gaussians.source_index[index]].detach()
    kept = {
        k: getattr(gaussians, k)[index : index + 1] for k in ("means", "quats_wxyz", "scales", "opacities", "colors")
    }
    output = render_gaussians(replace(gaussians, **kept), camera, ("normals",))
    row, column = divmod(int(output.alpha.argmax()), output.alpha.shape[1])
    drawn = output["normals"][row, column] / output.alpha[row, column]
    torch.testing.assert_close(drawn, normal if normal[2] < 0 else -normal, rtol=1e-4, atol=1e-5)


# Reference normals: of surfaces with known normals, and of Gaussians that come and go


def cylinder(turns=120, rings=60, radius=20.0):
    """Points on a cylinder about the z axis, less than 1 mm apart."""
    angles = torch.arange(turns, dtype=torch.float64) * (2 * math.pi / turns)
    heights = torch.arange(rings, dtype=torch.float64) * (2 * math.pi * radius / turns)
    angle, height = torch.meshgrid(angles, heights, indexing="ij")
    outward = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], dim=-1).reshape(-1, 3)
    return radius * outward + torch.tensor([0.0, 0.0, 1.0]) * height.reshape(-1, 1), outward


@pytest.mark.parametrize("neighbours", [10, 30, 100])
def test_normals_of_a_cylinder(neighbours):
    points, outward = cylinder()
    inner = (points[:, 2] > 8) & (points[:, 2] < points[:, 2].max() - 8)
    cosines = (point_normals(points, neighbours) * outward).sum(1).abs()
    assert math.degrees(math.acos(min(1.0, float(cosines[inner].min())))) < 1.0
    # Where the surface ends the neighbours lie on one side only; the normal stays the surface's within degrees.
    assert math.degrees(math.acos(float(cosines.min()))) < 5


def test_normals_of_a_plane_do_not_depend_on_the_frame():
    generator = torch.Generator().manual_seed(0)
    points = torch.cat([torch.rand(300, 2, generator=generator, dtype=torch.float64), torch.zeros(300, 1)], 1) * 40
    turn, _ = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))
    normals = point_normals(points @ turn.T + 1000.0, 10)
    torch.testing.assert_close((normals @ turn[:, 2]).abs(), torch.ones(300, dtype=torch.float64))
    with pytest.raises(InputError, match=r"10 initial points for normals from 10 neighbours\. Expected at least 11"):
        point_normals(points[:10], 10)


@pytest.mark.parametrize("count", [1, 2, 15, 3000, 40_000])
def test_normals_of_a_noisy_wall(count):
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(count, 3, generator=generator, dtype=torch.float64) * torch.tensor([60.0, 40.0, 0.1])
    at = torch.tensor([[30.0, 20.0, 0.0], [10.0, 10.0, 0.0]], dtype=torch.float64)
    normals = wall_normals(points, at)
    torch.testing.assert_close(normals.norm(dim=1), torch.ones(2, dtype=torch.float64))
    if count > 10:
        assert normals[:, 2].abs().min() > math.cos(math.radians(1.5))


# The basis against scipy's complex spherical harmonics, and the kernel against torch


def directions(count=200):
    vectors = torch.randn(count, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return torch.nn.functional.normalize(vectors, dim=1)


def test_real_harmonics_from_scipys_complex_ones():
    """Y_l,m = sqrt(2) Re or Im of scipy's, which carries the Condon-Shortley sign; order m from -l to l."""
    points = directions()
    theta = np.arccos(points[:, 2].numpy())
    phi = np.arctan2(points[:, 1].numpy(), points[:, 0].numpy())
    expected = []
    for degree in range(4):
        for order in range(-degree, degree + 1):
            value = sph_harm_y(degree, abs(order), theta, phi)
            part = value.imag if order < 0 else value.real
            expected.append(part * (math.sqrt(2.0) if order else 1.0))
    for degree in range(4):
        functions = np.stack(expected[: (degree + 1) ** 2], axis=1)
        torch.testing.assert_close(basis(points, degree), torch.from_numpy(functions))
    with pytest.raises(ValueError, match="degree 4: expected 0 to 3"):
        basis(points, 4)


# --- the kernel -------------------------------------------------------------------------------------------------------


def made(count, degree, share=0.7):
    """Coefficients of degrees 0 and above of so many rows, those selected, vectors to these and their derivatives."""
    generator = torch.Generator().manual_seed(0)
    sh0, shN = (torch.randn(count, terms, 3, generator=generator) for terms in (1, (degree + 1) ** 2 - 1))
    rows = (torch.rand(count, generator=generator) < share).nonzero().squeeze(1)
    sight, of_colors = (3.0 * torch.randn(len(rows), 3, generator=generator) for _ in range(2))
    return sh0, shN, rows, sight, of_colors


def by_torch(sh0, shN, rows, sight, degree):
    coefficients = torch.cat([sh0, shN], dim=1)[rows]
    return colors(coefficients, torch.nn.functional.normalize(sight, dim=1), degree)


def with_gradients(function, sh0, shN, rows, sight, degree, of_colors):
    leaves = [tensor.clone().requires_grad_() for tensor in (sh0, shN, sight)]
    result = function(leaves[0], leaves[1], rows, leaves[2], degree)
    gradients = torch.autograd.grad(result, leaves, of_colors, allow_unused=True, materialize_grads=True)
    return result.detach(), *gradients


@pytest.mark.parametrize(("most", "degree"), [(0, 0), (1, 1), (2, 2), (3, 0), (3, 1), (3, 2), (3, 3)])
@pytest.mark.parametrize(("count", "share"), [(0, 1.0), (1, 1.0), (16, 1.0), (9, 0.0), (700, 0.7)])
def test_kernel_against_torch_in_float64(count, share, most, degree):
    sh0, shN, rows, sight, of_colors = made(count, most, share)
    gradients = with_gradients(kernel.colors, sh0, shN, rows, sight, degree, of_colors)
    expected = with_gradients(by_torch, sh0.double(), shN.double(), rows, sight.double(), degree, of_colors.double())
    clamped = (expected[0] == 0.0).sum()
    assert count < 700 or 0 < clamped < expected[0].numel()
    for one, other in zip(gradients, expected, strict=True):
        torch.testing.assert_close(one, other.float(), rtol=1e-5, atol=2e-5)
    unseen = torch.ones(count, dtype=torch.bool).index_fill_(0, rows, False)
    assert not gradients[1][unseen].any() and not gradients[2][unseen].any()
    assert not gradients[2][:, (degree + 1) ** 2 - 1 :].any()


def test_colours_of_zero_have_gradients():
    """Colours as at the first step, of points that are black."""
    sh0 = torch.full((1, 1, 3), -0.5) / Y0
    rows, sight = torch.tensor([0]), torch.tensor([[0.3, -0.2, 1.0]])
    gradients = with_gradients(kernel.colors, sh0, torch.zeros(1, 15, 3), rows, sight, 3, torch.ones(1, 3))
    assert torch.equal(gradients[0], torch.zeros(1, 3))
    torch.testing.assert_close(gradients[1], torch.full((1, 1, 3), Y0))


def test_kernel_gives_the_same_bits_on_any_number_of_threads():
    case = made(5000, 3)
    results = []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        results.append(with_gradients(kernel.colors, *case[:4], 3, case[4]))
    assert all(torch.equal(a, b) for other in results[1:] for a, b in zip(results[0], other, strict=True))
