"""Light, reflection and the camera of phantoms against closed forms; errors of the poses and depth that are given."""

from __future__ import annotations

import io
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import PIL.Image
import pytest
import skimage.filters
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from coliags_plugin.geometry.lenses.models import PinholeLens
from coliags_plugin.phantom.colon import ColonSurface, Tracer, surface_of
from coliags_plugin.phantom.generate import displaced, estimated_depth, generate, pose_errors, prepare
from coliags_plugin.phantom.imaging import (
    Sensor,
    World,
    develop,
    encoded,
    expose,
    exposure_for,
    exposures,
    meter_weights,
    white_balances,
)
from coliags_plugin.phantom.light import UNIT_DISTANCE, CameraLight, form_factors, indirect_lights, make_patches, solve
from coliags_plugin.phantom.mucosa import Mucosa
from coliags_plugin.phantom.settings import PhantomSettings
from coliags_plugin.phantom.streams import Purpose, stream
from tests.phantom.phantom_layouts import TINY
from tests.phantom.test_phantom import digest

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


def test_the_beam_of_a_real_endoscope_falls_off_about_its_tilted_axis():
    guides = CameraLight.all_of(PhantomSettings(endoscope="endomapper-09", lamps=GUIDES, light="strong"))
    assert tuple(guide.offset for guide in guides) == GUIDES
    axis = np.array([0.079933, 0.116518, 0.989967])  # 8.1 degrees from the optical axis
    for guide, away in zip(guides, 20.0 * directions(np.radians([0.0, 25.0, 50.0]), np.array(0.4)), strict=True):
        strength, _ = guide.irradiance((guide.offset + away)[None], np.eye(4))
        assert strength[0] == pytest.approx((away @ axis / 20.0) ** 2.818881 / 3.0, rel=1e-5)


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


# The camera: exposure, response and processor


MATRIX = ((0.9, 0.08, 0.02), (0.04, 0.88, 0.08), (0.02, 0.12, 0.86))


@pytest.fixture(scope="module")
def sensor() -> Sensor:
    return Sensor.behind(PinholeLens(60.0, 60.0, 48.0, 40.0, 96, 80), np.ones((80, 96), bool), 1)


@pytest.fixture(scope="module")
def pattern() -> np.ndarray:
    smooth = cv2.GaussianBlur(np.random.default_rng(3).uniform(0.0, 1.0, (80, 96, 3)), (0, 0), 2.0)
    return np.clip((smooth - 0.3) * 2.0, 0.05, 0.6).reshape(-1, 3).astype(np.float32)


def test_encoding_is_a_power_law_with_a_smooth_shoulder():
    linear = np.linspace(0.0, 6.0, 6001)
    value = encoded(linear, PhantomSettings(gamma=2.2))
    np.testing.assert_allclose(value[linear <= 0.7], linear[linear <= 0.7] ** (1 / 2.2))
    assert np.all(np.diff(value) > 0.0) and value[-1] < 1.0
    slope = np.diff(value)
    knee = np.searchsorted(linear, 0.7)
    assert abs(slope[knee] / slope[knee - 1] - 1.0) < 0.01


@given(st.floats(0.1, 0.8), st.floats(1e-3, 1e3))
@settings(max_examples=20, deadline=None)
def test_exposure_reaches_its_target(target, scale):
    radiance = stream(0, Purpose.SENSOR).uniform(0.0, scale, (200, 3))
    gain = exposure_for(radiance, PhantomSettings(target_grey=target))
    assert encoded(gain * radiance, PhantomSettings()).mean() == pytest.approx(target, abs=1e-6)


def test_automatic_gain_follows_with_a_lag_and_keeps_its_span():
    chosen = PhantomSettings(gain="auto", gain_lag=4.0, gain_span=3.0)
    step = exposures([1.0] * 51 + [1.5] * 49, chosen)
    assert np.all(step[:51] == 1.0)
    # A step of the wanted gain is followed as 1 - exp(-n / lag), in the logarithm.
    np.testing.assert_allclose(np.log(step[51:55]) / np.log(1.5), 1.0 - np.exp(-np.arange(1, 5) / 4.0), rtol=1e-9)
    assert step[-1] == pytest.approx(1.5, rel=1e-4)
    wild = exposures(list(np.exp(np.linspace(-5.0, 5.0, 101))), chosen)
    assert wild.max() / wild.min() <= 3.0 + 1e-9
    assert np.ptp(exposures([1.0, 2.0, 7.0], PhantomSettings(gain="fixed"))) == 0.0


def test_white_balance_drifts_slowly_by_what_is_asked():
    gains = white_balances(PhantomSettings(frames=2000, white_balance_drift=0.05))
    assert np.all(gains[:, 1] == 1.0)
    assert np.log(gains[:, [0, 2]]).std() == pytest.approx(0.05, rel=0.3)
    assert np.abs(np.diff(np.log(gains), axis=0)).max() < 0.015
    assert np.all(white_balances(PhantomSettings(light="strong")) == 1.0)


def test_noise_at_mid_grey_is_what_is_asked(sensor):
    radiance = np.full((60_000, 3), 0.5**2.2, np.float32)

    def image(noise):
        return develop(radiance, np.ones(3), PhantomSettings(noise=noise), stream(1, Purpose.SENSOR), sensor)

    for noise in (1.5, 3.0):
        # Rounding adds a variance of 1/12.
        assert image(noise).std() == pytest.approx(np.hypot(noise, np.sqrt(1 / 12)), rel=0.02)
    assert np.ptp(image(0.0)) == 0


def test_a_colour_matrix_keeps_grey_and_mixes_colours():
    grey = np.repeat(np.linspace(0.0, 3.0, 50)[:, None], 3, axis=1).astype(np.float32)
    mixed = PhantomSettings(color_matrix=MATRIX)
    np.testing.assert_allclose(encoded(grey, mixed), encoded(grey, PhantomSettings()), atol=1e-6)
    pure = encoded(0.5 * np.eye(3, dtype=np.float32), mixed)  # of light in one channel each
    np.testing.assert_allclose(pure, (0.5 * np.array(MATRIX).T) ** (1.0 / 2.2), rtol=1e-5)


def test_an_s_curve_has_a_toe_and_is_no_power_law():
    linear = np.linspace(1e-4, 5.0, 4001)[:, None].repeat(3, axis=1)
    plain, curved = (encoded(linear, PhantomSettings(gamma=1.9, s_curve=share))[:, 0] for share in (0.0, 0.5))
    np.testing.assert_allclose(curved, 0.5 * plain + 0.5 * (3.0 * plain**2 - 2.0 * plain**3), rtol=1e-6)
    assert np.all(np.diff(curved) > 0.0) and curved[-1] < 1.0
    below = linear[:, 0] < 0.5
    slopes = np.diff(np.log(curved[below])) / np.diff(np.log(linear[below, 0]))
    assert slopes.max() > 1.2 * slopes.min()  # the logarithm of a power law has one slope


def test_metering_of_peaks_leaves_two_in_a_hundred_brighter():
    settings = PhantomSettings(metering="peak", gamma=1.9, s_curve=0.3, color_matrix=MATRIX)
    radiance = np.random.default_rng(1).lognormal(0.0, 1.0, (5000, 3)).astype(np.float32)
    brightest = encoded(radiance * exposure_for(radiance, settings), settings).max(axis=1)
    assert np.mean(brightest > 0.9) == pytest.approx(0.02, abs=2.0 / 5000)


def test_metering_at_the_centre_hardly_sees_the_rim():
    settings = PhantomSettings(metering="centre", target_grey=0.4)
    weights = meter_weights(np.ones((48, 60), bool), settings)
    row, column = np.mgrid[:48, :60]
    middle = np.hypot(row - 23.5, column - 29.5) < 24.0
    assert weights.reshape(48, 60)[middle].sum() > 0.85 * weights.sum()
    radiance = np.where(middle, 0.1, 4.0).reshape(-1, 1).repeat(3, axis=1)
    value = encoded(radiance * exposure_for(radiance, settings, weights), settings)[:, 0]
    assert (value * weights).sum() / weights.sum() == pytest.approx(0.4, abs=1e-6)
    assert value.mean() > 0.5
    assert meter_weights(np.ones((48, 60), bool), PhantomSettings()) is None


def test_a_gain_in_steps_is_the_smooth_one_rounded():
    ideal = np.exp(np.cumsum(np.random.default_rng(0).normal(0.0, 0.1, 101)))
    smooth = exposures(ideal, PhantomSettings(gain_span=10.0))
    stepped = exposures(ideal, PhantomSettings(gain_span=10.0, gain_steps=0.5))
    stops = np.log2(stepped / np.median(ideal)) / 0.5
    np.testing.assert_allclose(stops, np.rint(stops), atol=1e-9)
    assert np.abs(np.log2(stepped / smooth)).max() <= 0.25 + 1e-9 and len(np.unique(np.rint(stops))) > 2


def test_views_that_are_metered_settle_without_a_lag_within_the_same_span():
    ideal, views = [1.0, 1.0, 1.0], [1.2, 9.0, 0.01]
    settled = exposures(ideal, PhantomSettings(gain_span=4.0, gain_lag=50.0), views)
    np.testing.assert_allclose(settled, [1.2, 2.0, 0.5])
    np.testing.assert_array_equal(exposures(ideal, PhantomSettings(gain="fixed"), views), 1.0)


def processed(sensor: Sensor, pattern: np.ndarray, **options) -> np.ndarray:
    settings = PhantomSettings(noise=0.0, **options)
    return sensor.image(develop(pattern, np.ones(3), settings, stream(0, Purpose.SENSOR), sensor))


def test_sharpening_is_the_unsharp_mask_of_scikit_image(sensor, pattern):
    plain = sensor.image(encoded(pattern, PhantomSettings()))
    masked = partial(skimage.filters.unsharp_mask, radius=1.5, amount=0.8, preserve_range=True)
    channels = [masked(plain[..., channel]) for channel in range(3)]
    expected = np.stack(channels, axis=-1)
    sharp = processed(sensor, pattern, sharpening=0.8, sharpening_radius=1.5)
    gap = sharp / 255.0 - np.clip(expected, 0.0, 1.0)
    assert np.abs(gap[8:-8, 8:-8]).max() < 1.0 / 255.0
    assert np.abs(expected - plain).max() > 10.0 / 255.0


def test_compression_is_a_jpeg_of_its_quality(sensor, pattern):
    plain = processed(sensor, pattern).astype(int)
    changes = []
    for quality in (30, 60, 95):
        file = io.BytesIO()
        PIL.Image.fromarray(plain.astype(np.uint8)).save(file, "jpeg", quality=quality, subsampling="4:2:0")
        other = np.asarray(PIL.Image.open(file)).astype(int)
        stored = processed(sensor, pattern, compression=quality).astype(int)
        assert np.abs(stored - other).mean() < 0.3
        changes.append(np.abs(stored - plain).mean())
    assert changes[0] > changes[1] > changes[2] > 0.0


def test_poses_drift_slowly_and_jitter_only_in_training():
    settings = PhantomSettings(frames=2000, pose_noise=(0.4, 0.2))
    training = np.arange(2000) % 8 > 0
    errors, drift = pose_errors(settings, training), pose_errors(settings, np.zeros(2000, bool))
    assert drift[:, :3].std() == pytest.approx(0.4, rel=0.25)
    assert np.degrees(drift[:, 3:]).std() == pytest.approx(0.2, rel=0.25)
    assert np.abs(np.diff(drift[:, :3], axis=0)).max() < 0.15 * 0.4
    np.testing.assert_array_equal(errors[~training], drift[~training])
    assert (errors - drift)[training, :3].std() == pytest.approx(0.08, rel=0.05)
    poses = np.tile(np.eye(4), (2000, 1, 1))
    poses[:, :3, :3] = Rotation.random(2000, rng=np.random.default_rng(0)).as_matrix()
    moved = displaced(poses, errors)
    np.testing.assert_allclose(moved[:, :3, 3], errors[:, :3])
    turned = Rotation.from_matrix(poses[:, :3, :3]).inv() * Rotation.from_matrix(moved[:, :3, :3])
    np.testing.assert_allclose(turned.magnitude(), np.linalg.norm(errors[:, 3:], axis=1), atol=1e-9)
    np.testing.assert_allclose(displaced(poses, 0.0 * errors), poses)


def test_depth_has_smooth_relative_noise_and_bleeds_over_edges():
    flat = np.full((160, 200), 30.0, np.float32)
    logs = np.stack([np.log(estimated_depth(flat, PhantomSettings(depth_noise=0.05), n) / 30.0) for n in range(30)])
    assert logs.std() == pytest.approx(0.05, rel=0.1)
    assert np.abs(np.diff(logs, axis=2)).max() < 0.2 * 0.05
    step = np.where(np.arange(200) < 100, np.float32(10.0), np.float32(40.0))[None].repeat(160, axis=0)
    step[:20] = 0.0
    bled = estimated_depth(step, PhantomSettings(depth_noise=1e-9), 0)
    assert not bled[:20].any()
    np.testing.assert_allclose(bled[20:, :94], 10.0, rtol=1e-5)
    np.testing.assert_allclose(bled[20:, 106:], 40.0, rtol=1e-5)
    assert 10.5 < bled[80, 99] < 39.5 and 10.5 < bled[80, 100] < 39.5


@pytest.mark.thorough
def test_only_what_is_given_for_training_has_errors(tmp_path):
    options = TINY | {"width": 48, "height": 38, "mesh_spacing": 2.0, "lamps": GUIDES}
    generate(PhantomSettings(**options), tmp_path / "exact")
    generate(PhantomSettings(**options, pose_noise=(0.5, 0.3), depth_noise=0.05), tmp_path / "given")
    exact, erroneous = digest(tmp_path / "exact"), digest(tmp_path / "given")
    assert exact.keys() == erroneous.keys()
    changed = {name for name in exact if exact[name] != erroneous[name]}
    training = {f"depths/{index:04d}_depth.png" for index in range(1, 8)}
    assert changed == training | {"camera_pose.txt", "rotation/camera_pose.txt", "phantom.json"}
    stored = np.loadtxt(tmp_path / "given/camera_pose.txt", delimiter=",").reshape(-1, 4, 4).transpose(0, 2, 1)
    truth = np.load(tmp_path / "given/truth/camera_to_world.npy")
    apart = np.linalg.norm((stored - truth)[:, :3, 3], axis=1)
    assert 0.01 < apart.min() and apart.max() < 3.0


@pytest.mark.thorough
def test_a_turned_view_is_exposed_for_what_it_sees():
    options = TINY | {"width": 48, "height": 38, "mesh_spacing": 2.0, "gain_span": 50.0, "noise": 0.0}
    metered = prepare(PhantomSettings(**options), lambda *_: None)
    framed = prepare(PhantomSettings(**options, rotation_exposure="frame"), lambda *_: None)
    np.testing.assert_array_equal(framed.gains, framed.gains[framed.frames])
    np.testing.assert_array_equal(framed.gains[:9], metered.gains[:9])
    for number in (9, 10):
        color = metered.render_frame(number)[1]
        assert color.mean() / 255.0 == pytest.approx(0.45, abs=0.01)
    assert np.abs(np.log(metered.gains[9:] / framed.gains[9:])).max() > 0.02
