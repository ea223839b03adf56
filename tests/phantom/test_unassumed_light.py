"""Lamps, wall, camera and errors that no method assumes: closed forms, other implementations, and what lies on disk."""

from __future__ import annotations

import io
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import PIL.Image
import pytest
import skimage.filters
from scipy.spatial.transform import Rotation

from coliags_plugin.comparison.named_files import load_benchmark
from coliags_plugin.geometry.lenses.models import PinholeLens
from coliags_plugin.phantom.generate import displaced, estimated_depth, generate, pose_errors, prepare
from coliags_plugin.phantom.imaging import Sensor, World, expose
from coliags_plugin.phantom.light import UNIT_DISTANCE, CameraLight, indirect_lights
from coliags_plugin.phantom.response import develop, encoded, exposure_for, exposures, meter_weights
from coliags_plugin.phantom.settings import PhantomSettings
from coliags_plugin.phantom.streams import Purpose, stream
from coliags_plugin.phantom.tracing import Tracer
from tests.phantom.phantom_layouts import TINY
from tests.phantom.test_phantom import digest
from tests.phantom.test_phantom_parts import grid_surface, lamp, photograph_plane, plain_mucosa, plane_at

#: The light guides of an Olympus CF-H190L (docs/phantom.md 2.1).
GUIDES = ((3.24, 0.55, 0.0), (-2.77, 2.66, 0.0), (-1.27, -3.14, 0.0))
MATRIX = ((0.9, 0.08, 0.02), (0.04, 0.88, 0.08), (0.02, 0.12, 0.86))


def idle(stage: str, done: int, total: int) -> None:
    """No report of progress."""


def irradiance(offsets, point, shares=()) -> float:
    """Irradiance at a point square to the light, of lamps without a beam."""
    lights = CameraLight.all_of(PhantomSettings(lamps=offsets, lamp_shares=shares))
    points = np.array([point], float)
    return float(sum(replace(light, spread=0.0).irradiance(points, np.eye(4))[0][0] for light in lights))


# --- lamps -----------------------------------------------------------------------------------------------------------


def test_a_ring_of_lamps_gains_less_on_close_walls_and_far_away_is_one_lamp():
    ring = tuple((3.5 * np.cos(clock), 3.5 * np.sin(clock), 0.0) for clock in (0.0, 2.0943951, 4.1887902))
    for distance, told in ((5.0, 0.67), (10.0, 0.89), (20.0, 0.97), (40.0, 0.99)):
        gained = irradiance(ring, (0.0, 0.0, distance)) * (distance / UNIT_DISTANCE) ** 2
        assert gained == pytest.approx(1.0 / (1.0 + (3.5 / distance) ** 2), rel=1e-5) and round(gained, 2) == told
    middle = tuple(np.mean(GUIDES, axis=0))
    for distance in (30.0, 90.0):
        # Beyond the first order, the squares of the lamps' distances from their middle are left over.
        bound = 4.0 * (3.9 / distance) ** 2
        point = (0.3 * distance, -0.2 * distance, distance)
        assert irradiance(GUIDES, point) == pytest.approx(irradiance((middle,), point), rel=bound)


def test_the_light_of_all_lamps_is_that_of_one():
    for shares in ((), (2.0, 1.0, 1.0)):
        lamps = CameraLight.all_of(PhantomSettings(lamps=GUIDES, lamp_shares=shares))
        assert sum(light.share for light in lamps) == pytest.approx(1.0)
        assert lamps[0].share == pytest.approx(0.5 if shares else 1.0 / 3.0)
    assert irradiance((GUIDES[0],) * 3, (1.0, 2.0, 12.0), (5.0, 1.0, 3.0)) == pytest.approx(
        irradiance(GUIDES[:1], (1.0, 2.0, 12.0))
    )


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
        """Nothing is visible from the left of the lens."""

        def visible(self, points, viewpoints):
            return np.full(len(points), viewpoints[0] > 0.0)

    surface = plane_at(12.0)
    sensor = Sensor.behind(PinholeLens(20.0, 20.0, 12.5, 9.5, 25, 19), np.ones((19, 25), bool), 1)
    shadowed = expose(World(surface, plain_mucosa(), Curtained(surface), lights, 0.0), sensor, np.eye(4), None)
    np.testing.assert_allclose(shadowed.radiance, alone[0], rtol=1e-5)


def test_indirect_light_is_that_of_all_lamps():
    theta, phi = np.linspace(0.02, np.pi - 0.02, 20)[:, None], (np.arange(24) * 2 * np.pi / 24)[None, :]
    unit = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi], axis=-1)
    sphere = grid_surface(12.0 * unit, -unit, np.cross(unit, [0.0, 0.0, 1.0]))
    albedo = np.full((len(sphere.vertices), 3), 0.5, np.float32)

    def solved(*lights):
        generator = stream(0, Purpose.INTERREFLECTION)
        return indirect_lights(sphere, albedo, Tracer(sphere), lights, [np.eye(4)], 1.0, generator)[0].irradiance

    lights = [lamp(offset=offset, share=share) for offset, share in zip(GUIDES, (0.5, 0.3, 0.2), strict=True)]
    np.testing.assert_allclose(solved(*lights), sum(solved(light) for light in lights), rtol=1e-5)


# --- wall ------------------------------------------------------------------------------------------------------------


def directions(theta, phi):
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=1)


@pytest.mark.parametrize("degrees", [10.0, 30.0])
def test_a_rough_wall_is_oren_and_nayars(degrees):
    generator = np.random.default_rng(0)
    light, eye = generator.uniform(0.0, 1.4, (2, 500))
    phi, psi = generator.uniform(0.0, 2.0 * np.pi, (2, 500))
    normals = np.tile([0.0, 0.0, 1.0], (500, 1))
    rough = lamp(diffuse_roughness=degrees)
    found = rough.diffuse(normals, directions(light, phi), directions(eye, psi))
    sigma2 = (degrees * np.pi / 180.0) ** 2
    a, b = 1.0 - 0.5 * sigma2 / (sigma2 + 0.33), 0.45 * sigma2 / (sigma2 + 0.09)
    alpha, beta = np.maximum(light, eye), np.minimum(light, eye)
    expected = np.cos(light) * (a + b * np.maximum(np.cos(phi - psi), 0.0) * np.sin(alpha) * np.tan(beta))
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    # Reciprocal, and brighter where the light comes from than anywhere else.
    reverse = rough.diffuse(normals, directions(eye, psi), directions(light, phi))
    np.testing.assert_allclose(found / np.cos(light), reverse / np.cos(eye), rtol=1e-6)
    back = rough.diffuse(normals, directions(light, phi), directions(light, phi + np.pi))
    assert np.all(rough.diffuse(normals, directions(light, phi), directions(light, phi)) > back)
    smooth = lamp().diffuse(normals, directions(light, phi), directions(eye, psi))
    np.testing.assert_allclose(smooth, np.cos(light), rtol=1e-6)


# --- camera ----------------------------------------------------------------------------------------------------------


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


@pytest.fixture(scope="module")
def sensor() -> Sensor:
    return Sensor.behind(PinholeLens(60.0, 60.0, 48.0, 40.0, 96, 80), np.ones((80, 96), bool), 1)


@pytest.fixture(scope="module")
def pattern() -> np.ndarray:
    smooth = cv2.GaussianBlur(np.random.default_rng(3).uniform(0.0, 1.0, (80, 96, 3)), (0, 0), 2.0)
    return np.clip((smooth - 0.3) * 2.0, 0.05, 0.6).reshape(-1, 3).astype(np.float32)


def processed(sensor: Sensor, pattern: np.ndarray, **options) -> np.ndarray:
    settings = PhantomSettings(noise=0.0, **options)
    return sensor.image(develop(pattern, np.ones(3), settings, stream(0, Purpose.SENSOR), sensor))


def test_sharpening_is_the_unsharp_mask_of_scikit_image(sensor, pattern):
    plain = sensor.image(encoded(pattern, PhantomSettings()))
    masked = partial(skimage.filters.unsharp_mask, radius=1.5, amount=0.8, preserve_range=True)
    channels = [masked(plain[..., channel]) for channel in range(3)]
    expected = np.stack(channels, axis=-1)
    found = processed(sensor, pattern, sharpening=0.8, sharpening_radius=1.5)
    gap = found / 255.0 - np.clip(expected, 0.0, 1.0)
    assert np.abs(gap[8:-8, 8:-8]).max() < 1.0 / 255.0
    assert np.abs(expected - plain).max() > 10.0 / 255.0


def test_compression_is_a_jpeg_of_its_quality(sensor, pattern):
    plain = processed(sensor, pattern).astype(int)
    changes = []
    for quality in (30, 60, 95):
        file = io.BytesIO()
        PIL.Image.fromarray(plain.astype(np.uint8)).save(file, "jpeg", quality=quality, subsampling="4:2:0")
        other = np.asarray(PIL.Image.open(file)).astype(int)
        found = processed(sensor, pattern, compression=quality).astype(int)
        assert np.abs(found - other).mean() < 0.3
        changes.append(np.abs(found - plain).mean())
    assert changes[0] > changes[1] > changes[2] > 0.0


# --- errors of what is given -----------------------------------------------------------------------------------------


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
    given = displaced(poses, errors)
    np.testing.assert_allclose(given[:, :3, 3], errors[:, :3])
    turned = Rotation.from_matrix(poses[:, :3, :3]).inv() * Rotation.from_matrix(given[:, :3, :3])
    np.testing.assert_allclose(turned.magnitude(), np.linalg.norm(errors[:, 3:], axis=1), atol=1e-9)
    np.testing.assert_allclose(displaced(poses, 0.0 * errors), poses)


def test_depth_has_smooth_relative_noise_and_bleeds_over_edges():
    flat = np.full((160, 200), 30.0, np.float32)
    logs = np.stack([np.log(estimated_depth(flat, PhantomSettings(depth_noise=0.05), n) / 30.0) for n in range(30)])
    assert logs.std() == pytest.approx(0.05, rel=0.1)
    assert np.abs(np.diff(logs, axis=2)).max() < 0.2 * 0.05
    step = np.where(np.arange(200) < 100, np.float32(10.0), np.float32(40.0))[None].repeat(160, axis=0)
    step[:20] = 0.0
    given = estimated_depth(step, PhantomSettings(depth_noise=1e-9), 0)
    assert not given[:20].any()
    np.testing.assert_allclose(np.delete(given, np.s_[94:106], axis=1)[20:, ::5].min(), 10.0, rtol=1e-5)
    np.testing.assert_allclose(given[20:, :94], 10.0, rtol=1e-5)
    np.testing.assert_allclose(given[20:, 106:], 40.0, rtol=1e-5)
    assert 10.5 < given[80, 99] < 39.5 and 10.5 < given[80, 100] < 39.5


@pytest.mark.thorough
def test_only_what_is_given_for_training_has_errors(tmp_path):
    options = TINY | {"width": 48, "height": 38, "mesh_spacing": 2.0, "lamps": GUIDES}
    generate(PhantomSettings(**options), tmp_path / "exact")
    generate(PhantomSettings(**options, pose_noise=(0.5, 0.3), depth_noise=0.05), tmp_path / "given")
    exact, given = digest(tmp_path / "exact"), digest(tmp_path / "given")
    assert exact.keys() == given.keys()
    changed = {name for name in exact if exact[name] != given[name]}
    training = {f"depths/{index:04d}_depth.png" for index in range(1, 8)}
    assert changed == training | {"camera_pose.txt", "rotation/camera_pose.txt", "phantom.json"}
    stored = np.loadtxt(tmp_path / "given/camera_pose.txt", delimiter=",").reshape(-1, 4, 4).transpose(0, 2, 1)
    truth = np.load(tmp_path / "given/truth/camera_to_world.npy")
    apart = np.linalg.norm((stored - truth)[:, :3, 3], axis=1)
    assert 0.01 < apart.min() and apart.max() < 3.0


@pytest.mark.thorough
def test_a_turned_view_is_exposed_for_what_it_sees():
    options = TINY | {"width": 48, "height": 38, "mesh_spacing": 2.0, "gain_span": 50.0, "noise": 0.0}
    metered = prepare(PhantomSettings(**options), idle)
    framed = prepare(PhantomSettings(**options, rotation_exposure="frame"), idle)
    np.testing.assert_array_equal(framed.rotation_gains, framed.gains[[view.frame for view in framed.rotation_views]])
    np.testing.assert_array_equal(framed.gains, metered.gains)
    for number in (9, 10):
        color = metered.render_frame(number)[1]
        assert color.mean() / 255.0 == pytest.approx(0.45, abs=0.01)
    assert np.abs(np.log(metered.rotation_gains / framed.rotation_gains)).max() > 0.02


# --- benchmarks ------------------------------------------------------------------------------------------------------

#: Drawn at random, and not to be looked at.
TEST_SEEDS = [10947, 14241, 23370, 37830, 38935, 54793, 55179, 58216, 61511, 61817, 80088, 97640]
#: Settings that are the light, the camera or the errors of no method's model.
UNASSUMED = {"lamps", "diffuse_roughness", "s_curve", "color_matrix", "metering", "gain_steps", "sharpening"} | {
    *("compression", "pose_noise", "depth_noise", "gamma"),
}


def departures(settings: PhantomSettings) -> set[str]:
    return {name for name in UNASSUMED if getattr(settings, name) != PhantomSettings.model_fields[name].default}


@pytest.mark.parametrize(
    ("name", "seeds", "unassumed"), [("phantoms-12", TEST_SEEDS, 7), ("phantoms-tuning", [2047, 4229, 5063, 9850], 2)]
)
def test_the_benchmarks_have_both_kinds_of_scenes(name, seeds, unassumed):
    scenes = {key: scene.phantom for key, scene in load_benchmark(name).settings.scenes.items()}
    assert [chosen.seed for chosen in scenes.values()] == seeds
    for key, chosen in scenes.items():
        assert key.endswith(f"-{chosen.seed}")
        assert (chosen.width, chosen.height, chosen.frames, chosen.rotation_views) == (160, 128, 96, 12)
        assert chosen.rotation_exposure == "metered" and 1.8 <= chosen.gamma <= 2.6
    kinds = [departures(chosen) for chosen in scenes.values()]
    assert sum(bool(kind) for kind in kinds) == unassumed
    assert all(len(kind) >= 4 and "lamps" in kind for kind in kinds if kind)
    assert len({frozenset(kind) for kind in kinds if kind}) == unassumed
    if name == "phantoms-12":
        assert set.union(*kinds) == UNASSUMED and sum(chosen.moves for chosen in scenes.values()) == 2
        assert {chosen.trajectory for chosen in scenes.values()} == {"pullback", "rotation", "inspection"}


def test_an_exact_twin_lacks_nothing_but_the_errors_of_its_scene():
    scenes = {key: scene.phantom for key, scene in load_benchmark("phantoms-tracked").settings.scenes.items()}
    errors = {"pose_noise": (0.17, 0.09), "depth_noise": 0.03}
    for key, chosen in scenes.items():
        assert key.endswith(f"-{chosen.seed}")
        if key.startswith("exact"):
            assert chosen.model_copy(update=errors) == scenes[key.replace("exact", "tracked")]
        else:
            assert {name: getattr(chosen, name) for name in errors} == errors
