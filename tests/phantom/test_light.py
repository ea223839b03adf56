"""Light and reflection in phantoms against closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from coliags_plugin.geometry.lenses.models import PinholeLens
from coliags_plugin.phantom.colon import ColonSurface, surface_of
from coliags_plugin.phantom.imaging import Sensor, World, expose
from coliags_plugin.phantom.light import UNIT_DISTANCE, CameraLight, form_factors, indirect_lights, make_patches, solve
from coliags_plugin.phantom.mucosa import Mucosa
from coliags_plugin.phantom.settings import PhantomSettings
from coliags_plugin.phantom.streams import Purpose, stream
from coliags_plugin.phantom.tracing import Tracer

#: The light guides of an Olympus CF-H190L (docs/phantom.md 2.1).
GUIDES = ((3.24, 0.55, 0.0), (-2.77, 2.66, 0.0), (-1.27, -3.14, 0.0))
ALBEDO = (0.7, 0.3, 0.2)


def lamp(**changes) -> CameraLight:
    plain = CameraLight((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), "cosine", 0.0, specular=0.0, roughness=0.3, f0=0.028)
    return replace(plain, **changes)


def grid_surface(grid: np.ndarray, normals: np.ndarray, tangents: np.ndarray) -> ColonSurface:
    """A mesh over a grid of points whose columns close upon themselves."""
    surface = surface_of(grid, np.tile(np.eye(3), (len(grid), 1, 1)), np.arange(len(grid), dtype=float), 1.0)
    normals, tangents = (vectors.reshape(-1, 3).astype(np.float32) for vectors in (normals, tangents))
    return replace(surface, normals=normals, tangents=tangents)


def plane_at(z: float) -> ColonSurface:
    """A plane square to the z axis that faces the origin. Its last column runs back over the plane; no harm in that."""
    x, y = np.meshgrid(np.linspace(-60.0, 60.0, 12), np.linspace(-60.0, 60.0, 12), indexing="ij")
    grid = np.stack([x, y, np.full_like(x, z)], axis=-1)
    facing, along = np.broadcast_to([0.0, 0.0, -1.0], grid.shape), np.broadcast_to([1.0, 0.0, 0.0], grid.shape)
    return grid_surface(grid, facing, along)


def plain_mucosa() -> Mucosa:
    color = np.empty((64, 66, 4), np.float32)
    color[:] = (*ALBEDO, 1.0)
    relief = np.zeros((64, 66, 3), np.float32)
    return Mucosa((color,) * 6, (relief,) * 6, 1.0, 1.0, 1.0)


def photograph_plane(distance: float, lights: tuple[CameraLight, ...], vignetting: float = 0.0):
    surface = plane_at(distance)
    lens = PinholeLens(20.0, 20.0, 12.5, 9.5, 25, 19)
    sensor = Sensor.behind(lens, np.ones((19, 25), bool), 1)
    return sensor, expose(World(surface, plain_mucosa(), lights, vignetting), sensor, np.eye(4))


def directions(theta: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """Unit vectors at polar angles from the z axis."""
    theta, phi = np.broadcast_arrays(theta, phi)
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)


def sphere_around(radius: float, rows: int, columns: int) -> ColonSurface:
    """A sphere about the origin, seen from within."""
    unit = directions(np.linspace(0.02, np.pi - 0.02, rows)[:, None], np.arange(columns) * 2 * np.pi / columns)
    return grid_surface(radius * unit, -unit, np.cross(unit, [0.0, 0.0, 1.0]))


@pytest.mark.parametrize("distance", [6.0, 15.0, 40.0])
def test_every_pixel_of_a_flat_patch_obeys_the_whole_law(distance):
    offset, spread, vignetting = np.array([1.0, -0.5, -2.0]), 1.5, 2.5
    light = lamp(offset=tuple(offset), spread=spread)
    sensor, exposure = photograph_plane(distance, (light,), vignetting)
    assert not lamp(offset=(0.0, 0.0, -3.6)).casts_shadows
    np.testing.assert_allclose(exposure.z_depth, distance, rtol=1e-5)
    points = sensor.centers * distance
    away = points - offset
    square = (away**2).sum(axis=1)
    cos_lamp = away[:, 2] / np.sqrt(square)  # at once the angle of emission and that of incidence on this wall
    cos_theta = 1.0 / np.linalg.norm(sensor.centers, axis=1)
    inside = cos_lamp > np.cos(np.radians(70.0))
    expected = cos_lamp**spread * UNIT_DISTANCE**2 / square * cos_lamp * cos_theta**vignetting
    np.testing.assert_allclose(exposure.radiance[inside], np.outer(expected, ALBEDO)[inside], rtol=2e-4)


def test_exponential_beam_is_modrzejewskis():
    cosine = np.cos(np.radians([0.0, 20.0, 45.0, 70.0]))
    beam = lamp(spread_law="exponential", spread=2.767).beam(cosine)
    np.testing.assert_allclose(beam, np.exp(-2.767 * (1.0 - cosine)), rtol=1e-3)
    assert lamp().beam(np.array([-0.5]))[0] == 0.0


def test_gloss_at_normal_incidence_is_the_closed_form():
    # D = 1 / (pi alpha^2), no masking, Fresnel F0: pi D F / 4 = F0 / (4 alpha^2), with alpha = roughness^2.
    up = np.array([[0.0, 0.0, 1.0]])
    gloss = lamp(specular=1.0).gloss(up, up, up, np.zeros(1))
    np.testing.assert_allclose(gloss, 0.028 / (4.0 * 0.3**4), rtol=1e-9)


def test_gloss_reflects_no_more_than_its_fresnel_share():
    light = lamp(specular=1.0, f0=0.04)
    theta, phi = np.meshgrid((np.arange(400) + 0.5) / 400 * np.pi / 2, (np.arange(64) + 0.5) / 64 * 2 * np.pi)
    lit = directions(theta, phi).reshape(-1, 3)
    solid = (np.sin(theta) * (np.pi / 800) * (2 * np.pi / 64)).ravel()
    eye = np.broadcast_to([0.0, 0.0, 1.0], lit.shape)
    for variance in (0.0, 0.05):
        gloss = light.gloss(eye, lit.copy(), eye, np.full(len(lit), variance))
        reflected = (gloss * solid).sum() / np.pi
        assert 0.8 * 0.04 < reflected < 1.05 * 0.04


def test_interreflection_in_a_sphere_is_the_integrating_spheres():
    sphere = sphere_around(20.0, 60, 96)
    albedo = np.broadcast_to(np.array(ALBEDO, np.float32), (len(sphere.vertices), 3))
    patches = make_patches(sphere, albedo, stream(0, Purpose.INTERREFLECTION))
    factors = form_factors(patches, sphere.tracer)
    assert factors.sum(axis=1).max() <= 1.0 + 1e-9
    np.testing.assert_allclose(factors.sum(axis=1).mean(), 1.0, atol=0.05)
    indirect = solve(patches, factors, np.ones((len(patches.areas), 1)))[0]
    expected = np.array(ALBEDO) / (1.0 - np.array(ALBEDO))
    np.testing.assert_allclose(indirect.mean(axis=0), expected, rtol=0.15)


def test_the_light_of_all_lamps_is_that_of_one():
    for shares in ((), (2.0, 1.0, 1.0)):
        lamps = CameraLight.all_of(PhantomSettings(lamps=GUIDES, lamp_shares=shares))
        assert sum(light.share for light in lamps) == pytest.approx(1.0)
        assert lamps[0].share == pytest.approx(0.5 if shares else 1.0 / 3.0)


def test_an_image_is_the_sum_of_its_lamps_with_their_own_glints_and_shadows():
    lights = tuple(lamp(offset=offset, share=1.0 / 3.0, specular=1.0) for offset in GUIDES)
    both = photograph_plane(12.0, lights)[1].radiance
    alone = [photograph_plane(12.0, (light,))[1].radiance for light in lights]
    np.testing.assert_allclose(both, np.sum(alone, axis=0), rtol=1e-5)
    dull = photograph_plane(12.0, tuple(replace(light, specular=0.0) for light in lights))[1].radiance
    glint = (both - dull)[:, 1].reshape(19, 25)
    # The plane mirrors each lamp half way to its foot: offset / 2, at 20 px per unit of x / z.
    for x, y, _ in GUIDES:
        column, row = 12.5 + 20.0 * 0.5 * x / 12.0, 9.5 + 20.0 * 0.5 * y / 12.0
        assert glint[int(row), int(column)] > 10.0 * np.median(glint)

    class Curtained(Tracer):
        """A wall of which nothing is visible from the left of the lens."""

        def visible(self, points, viewpoints):
            return np.full(len(points), viewpoints[0] > 0.0)

    surface = plane_at(12.0)
    sensor = Sensor.behind(PinholeLens(20.0, 20.0, 12.5, 9.5, 25, 19), np.ones((19, 25), bool), 1)
    vars(surface)["tracer"] = Curtained(surface.vertices, surface.triangles)
    shadowed = expose(World(surface, plain_mucosa(), lights, 0.0), sensor, np.eye(4))
    np.testing.assert_allclose(shadowed.radiance, alone[0], rtol=1e-5)


def test_indirect_light_is_that_of_all_lamps():
    sphere = sphere_around(12.0, 20, 24)
    albedo = np.full((len(sphere.vertices), 3), 0.5, np.float32)

    def solved(*lights):
        generator = stream(0, Purpose.INTERREFLECTION)
        return indirect_lights(sphere, albedo, lights, np.eye(4)[None], 1.0, generator)[0].irradiance

    lights = [lamp(offset=offset, share=share) for offset, share in zip(GUIDES, (0.5, 0.3, 0.2), strict=True)]
    np.testing.assert_allclose(solved(*lights), sum(solved(light) for light in lights), rtol=1e-5)


@pytest.mark.parametrize("degrees", [10.0, 30.0])
def test_a_rough_wall_is_oren_and_nayars(degrees):
    generator = np.random.default_rng(0)
    light, eye = generator.uniform(0.0, 1.4, (2, 500))
    phi, psi = generator.uniform(0.0, 2.0 * np.pi, (2, 500))
    normals = np.tile([0.0, 0.0, 1.0], (500, 1))
    rough = lamp(diffuse_roughness=degrees)
    reflected = rough.diffuse(normals, directions(light, phi), directions(eye, psi))
    sigma2 = (degrees * np.pi / 180.0) ** 2
    a, b = 1.0 - 0.5 * sigma2 / (sigma2 + 0.33), 0.45 * sigma2 / (sigma2 + 0.09)
    alpha, beta = np.maximum(light, eye), np.minimum(light, eye)
    expected = np.cos(light) * (a + b * np.maximum(np.cos(phi - psi), 0.0) * np.sin(alpha) * np.tan(beta))
    np.testing.assert_allclose(reflected, expected, rtol=1e-6)
    # Reciprocal, and brighter where the light comes from than anywhere else.
    reverse = rough.diffuse(normals, directions(eye, psi), directions(light, phi))
    np.testing.assert_allclose(reflected / np.cos(light), reverse / np.cos(eye), rtol=1e-6)
    back = rough.diffuse(normals, directions(light, phi), directions(light, phi + np.pi))
    assert np.all(rough.diffuse(normals, directions(light, phi), directions(light, phi)) > back)
    smooth = lamp().diffuse(normals, directions(light, phi), directions(eye, psi))
    np.testing.assert_allclose(smooth, np.cos(light), rtol=1e-6)
