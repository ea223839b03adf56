"""Shadows of lamps beside the lens: the map against closed forms, the kernel against the definition, lamps found."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from coliags_plugin.core import shadows
from coliags_plugin.core.photometry import fit_light
from coliags_plugin.core.shadows import OPAQUE, find_lamps, lit_shares
from tests.scenes import camera_at, hidden_by_plate, plate_scene

CAMERA = camera_at(0.0, 0.0, 0.0, 64, 48)
LENS = torch.zeros(3)


def grid(x, y, z, spacing=0.1):
    """Points on a plane across the optical axis, between pairs of bounds."""
    columns, rows = torch.meshgrid(torch.arange(*x, spacing), torch.arange(*y, spacing), indexing="ij")
    return torch.stack([columns, rows, torch.full_like(rows, z)], dim=-1).reshape(-1, 3)


def shares_of(positions, lamp, camera=CAMERA, opacity=1.0, size=0.1):
    """Lit shares of points of one opacity and size."""
    ones = torch.ones(len(positions), dtype=positions.dtype)
    return lit_shares(positions, opacity * ones, size * ones, camera, torch.as_tensor(lamp))


# The kernel against the definition


def scattered(count, seed, camera=CAMERA):
    """Places in and around the view, some of them behind the lens, with opacities about the one that casts shadows."""
    generator = torch.Generator().manual_seed(seed)
    uniform = torch.rand(count, 3, generator=generator) - 0.5
    depth = 12.0 * (uniform[:, 2] + 0.4)  # a tenth is behind
    # The map is a quarter wider than the image on either side; half as much again is beyond.
    across = torch.stack([camera.width / camera.fx * uniform[:, 0], camera.height / camera.fy * uniform[:, 1]], dim=1)
    positions = torch.cat([2.5 * depth[:, None] * across, depth[:, None]], dim=1)
    values = torch.tensor([0.0, OPAQUE - 1e-6, OPAQUE, OPAQUE + 1e-6, 0.6, 1.0])
    opacities = values[torch.randint(0, len(values), (count,), generator=generator)]
    return positions, opacities, 0.5 * torch.rand(count, generator=generator).square()


@settings(max_examples=25, deadline=None)
@given(
    count=st.sampled_from([0, 1, 2, 30, 4000]),
    seed=st.integers(0, 10_000),
    size=st.sampled_from([(1, 1), (7, 3), (64, 48)]),
)
def test_the_kernel_computes_what_is_defined(count, seed, size):
    camera = camera_at(0.0, 0.0, 0.0, *size)
    positions, opacities, sizes = scattered(count, seed, camera)
    lamp = torch.tensor([0.3, -0.2, 0.1])
    actual = lit_shares(positions, opacities, sizes, camera, lamp)
    expected = shadows._lit_shares(positions - lamp, opacities, sizes, camera)
    assert actual.shape == (count,) and actual.dtype == torch.float32
    # Where the end of a footprint is on a cell's centre, rounding decides.
    assert ((actual - expected).abs() > 1e-4).sum() <= 0.01 * count
    assert count < 4000 or size == (1, 1) or 0.1 < expected.mean() < 0.9


def test_places_at_the_border_of_the_map():
    """Pairs of places, one behind the other, before and behind the centres of the map's outermost cells."""
    cells, border, size = torch.tensor([-1.2, -0.7, -0.3, 0.1, 0.4, 1.2]), shadows.BORDER, torch.tensor([64, 48])
    columns, rows = (torch.cat([cells, count + 2 * border - 1 - cells]) + 0.5 - border for count in size)
    pixels = torch.cartesian_prod(columns, rows)
    rays = (pixels - torch.tensor([CAMERA.cx, CAMERA.cy])) / torch.tensor([CAMERA.fx, CAMERA.fy])
    rays = torch.cat([rays, torch.ones(len(rays), 1)], dim=1)
    positions, ones = torch.cat([10.0 * rays, 20.0 * rays]), torch.ones(2 * len(rays))
    actual = lit_shares(positions, ones, 0.01 * ones, CAMERA, LENS)
    expected = lit_shares(positions.double(), ones.double(), 0.01 * ones.double(), CAMERA, LENS)
    torch.testing.assert_close(actual.double(), expected, rtol=0.0, atol=1e-4)
    near, far = actual.split(len(rays))
    outside = ((pixels < 0.5 - border) | (pixels > size + border - 0.5)).any(1)
    assert (near == 1.0).all() and (far[outside] == 1.0).all() and (far[~outside] < 0.9).all()


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e30])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_what_is_not_a_number_or_far_outside_casts_no_shadow(value, dtype):
    positions, opacities, sizes = (values.to(dtype) for values in scattered(1000, 1))
    odd = torch.tensor([[value, 0.0, 5.0], [0.0, value, 5.0], [1.0, 0.0, 1e-30], [0.0, 0.0, value]], dtype=dtype)
    ones = torch.ones(len(odd), dtype=dtype)
    expected = lit_shares(positions, opacities, sizes, CAMERA, LENS)
    actual = lit_shares(
        torch.cat([positions, odd]), torch.cat([opacities, ones]), torch.cat([sizes, 0.1 * ones]), CAMERA, LENS
    )
    assert torch.equal(actual[: len(positions)], expected)
    assert (actual[len(positions) :] == 1.0).all()


# Closed forms


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("lamp", [(-2.0, 0.0, 0.0), (1.5, 0.0, 0.0), (-1.0, 0.5, 1.0), (0.0, 1.5, -2.0)])
def test_the_shadow_of_an_edge_ends_where_similar_triangles_say(lamp, dtype):
    """A half plane at 12 mm that ends at x = 0.5, before a plane at 20 mm."""
    edge, near, far = 0.5, grid((-9.0, 0.5), (-6.0, 6.0), 12.0), grid((-8.0, 8.0), (-7.0, 7.0), 20.0)
    shares = shares_of(torch.cat([near, far]).to(dtype), lamp)
    assert shares[: len(near)].min() > 1.0 - 1e-6
    x, _, z = lamp
    behind = x + (far[:, 0] - x) * (12.0 - z) / (20.0 - z)  # where the light to a point passes the half plane
    pixels = CAMERA.fx * (behind - edge) / (12.0 - z)
    lit, dark = shares[len(near) :][pixels > 1.5], shares[len(near) :][pixels < -1.5]
    assert len(lit) > 1000 and lit.min() > 1.0 - 1e-6
    assert len(dark) > 1000 and (dark == 0.0).all()


@pytest.mark.parametrize(("opacity", "expected"), [(OPAQUE, 1.0), (OPAQUE + 1e-3, 0.0)])
def test_what_is_hardly_opaque_casts_no_shadow(opacity, expected):
    near, far = grid((-3.0, 3.0), (-3.0, 3.0), 12.0), grid((-1.0, 1.0), (-1.0, 1.0), 20.0)
    shares = shares_of(torch.cat([near, far]), LENS, opacity=opacity)
    assert (shares[len(near) :] == expected).all()


@pytest.mark.parametrize(("behind", "expected"), [(1.04, 1.0), (1.06, 0.75), (1.07, 0.5), (1.08, 0.25), (1.1, 0.0)])
def test_shadows_begin_a_twentieth_behind_a_surface(behind, expected):
    """What casts none itself is between wholly lit and wholly dark from 5 to 9 % behind."""
    near, far = grid((-3.0, 3.0), (-3.0, 3.0), 12.0), grid((-1.0, 1.0), (-1.0, 1.0), 12.0 * behind)
    opacities = torch.cat([torch.ones(len(near)), torch.zeros(len(far))])
    shares = lit_shares(torch.cat([near, far]), opacities, torch.full_like(opacities, 0.1), CAMERA, LENS)
    torch.testing.assert_close(shares[len(near) :], torch.full((len(far),), expected), rtol=0.0, atol=1e-4)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 1000))
def test_a_lamp_at_the_lens_lights_all_that_is_seen(seed):
    """However rugged: one place at every pixel's centre."""
    depth = 1.0 + 30.0 * torch.rand(CAMERA.height, CAMERA.width, generator=torch.Generator().manual_seed(seed))
    positions = CAMERA.unproject(depth.double()).reshape(-1, 3).float()
    sizes = 0.4 * positions[:, 2] / CAMERA.fx
    assert lit_shares(positions, torch.ones_like(sizes), sizes, CAMERA, LENS).min() > 0.999


@settings(max_examples=25, deadline=None)
@given(tilt=st.floats(0.0, 1.3), turn=st.floats(0.0, 6.3), angle=st.floats(0.0, 6.3), aside=st.floats(0.0, 3.0))
def test_a_plane_casts_no_shadow_on_itself(tilt, turn, angle, aside):
    """Tilted so that its depth, of 20 mm ahead, changes by less than 2 % from pixel to pixel."""
    normal = torch.tensor([math.sin(tilt) * math.cos(turn), math.sin(tilt) * math.sin(turn), math.cos(tilt)]).double()
    cosines = CAMERA.rays() @ normal
    fine = cosines * CAMERA.fy * 0.02 > max(math.sin(tilt), 1e-3)
    positions = CAMERA.unproject(20.0 * math.cos(tilt) / cosines)[fine].float()
    sizes = 0.7 * positions[:, 2] / CAMERA.fx
    lamp = aside * torch.tensor([math.cos(angle), math.sin(angle), 0.0])
    assert (lit_shares(positions, torch.ones_like(sizes), sizes, CAMERA, lamp) == 1.0).all()


def test_no_place_or_none_ahead():
    assert shares_of(torch.zeros(0, 3), LENS).shape == (0,)
    assert shares_of(grid((-1.0, 1.0), (-1.0, 1.0), -5.0), LENS).unique().tolist() == [1.0]


# Units and axes


def example():
    """Shares of scattered places, in float64."""
    positions, opacities, sizes = (values.double() for values in scattered(3000, 3))
    return positions, opacities, sizes, torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)


@pytest.mark.parametrize("factor", [1000.0, 0.001])
def test_the_unit_of_length_does_not_matter(factor):
    positions, opacities, sizes, lamp = example()
    expected = lit_shares(positions, opacities, sizes, CAMERA, lamp)
    scaled = lit_shares(factor * positions, opacities, factor * sizes, CAMERA.scaled(factor), factor * lamp)
    torch.testing.assert_close(scaled, expected, rtol=0.0, atol=1e-9)


def test_the_pose_of_the_camera_does_not_matter():
    positions, opacities, sizes, lamp = example()
    expected = lit_shares(positions, opacities, sizes, CAMERA, lamp)
    rotation, _ = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64))
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = rotation * rotation.det(), torch.tensor([40.0, -3.0, 7.0])
    moved = positions @ pose[:3, :3].T + pose[:3, 3]
    shares = lit_shares(moved, opacities, sizes, replace(CAMERA, camera_to_world=pose), lamp)
    torch.testing.assert_close(shares, expected, rtol=0.0, atol=1e-9)


def test_shares_have_no_gradient_and_positions_keep_theirs():
    positions = grid((-1.0, 1.0), (-1.0, 1.0), 12.0).requires_grad_()
    assert not shares_of(positions, (1.0, 0.0, 0.0)).requires_grad and positions.requires_grad


# Lamps from where points are darker


def seen_points(scene):
    """Points of the plate's scene in camera axes, and in which frames nothing hides them. [P, F, 3], [P, F]"""
    points, cameras = scene.points.positions.double(), [frame.camera for frame in scene.train]
    sights = torch.stack([points - camera.center for camera in cameras], dim=1)
    seen = [camera.sees(points)[1] & ~hidden_by_plate(points, camera.center) for camera in cameras]
    return sights, torch.stack(seen, dim=1)


def residuals_under(scene, lamps):
    """Logarithms of colours: noise for each point, and the lamps' shadows."""
    points = scene.points.positions.double()
    missing = [
        sum(share * hidden_by_plate(points, frame.camera.center + torch.tensor(lamp)) for lamp, share in lamps)
        for frame in scene.train
    ]
    albedos = torch.randn(len(points), 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return albedos + (1.0 - torch.stack(missing, dim=1)).log()


@pytest.mark.parametrize(
    "lamps", [[((1.2, 1.3, 0.0), 0.4)], [((-1.7, 0.0, 0.0), 0.2), ((1.4, -1.0, 0.0), 0.3)]], ids=["one", "two"]
)
def test_lamps_and_their_shares_are_found(lamps):
    scene = plate_scene((0.0, 0.0, 0.0), 0.0)
    sights, seen = seen_points(scene)
    arguments = (scene.train, residuals_under(scene, lamps), seen, sights, 18.0)
    places = find_lamps(*arguments)
    assert torch.equal(find_lamps(*arguments), places)
    assert len(places) == len(lamps) and places[:, 3].sum() == pytest.approx(1.0)
    total = sum(share for _, share in lamps)
    for lamp, share in lamps:
        errors = (places[:, :3] - torch.tensor(lamp)).norm(dim=1)
        assert errors.min() < 0.33 * math.hypot(*lamp)
        assert places[errors.argmin(), 3] == pytest.approx(share / total, abs=0.15)


def test_a_lamp_is_found_in_images_and_none_where_there_is_no_shadow():
    """In images so small that colours at silhouettes, which mix the plate's and the wall's, would hide the shadow."""
    lamp = (1.2, 1.2, 0.0)
    lamps = fit_light(plate_scene(lamp, 0.4, frames=8)).lamps
    assert len(lamps) == 1 and lamps[0, 3] == 1.0
    assert (lamps[0, :3] - torch.tensor(lamp)).norm() < 0.33 * math.hypot(*lamp)
    assert fit_light(plate_scene(lamp, 0.0, frames=8)).lamps.shape == (0, 4)
