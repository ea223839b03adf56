"""The phantom's physics, geometry and settings against closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coliags_plugin.core.errors import InputError
from coliags_plugin.geometry.lenses.models import PinholeLens
from coliags_plugin.phantom.colon import ColonSurface, build_surface, grow_anatomy, surface_of
from coliags_plugin.phantom.imaging import Sensor, World, expose
from coliags_plugin.phantom.light import UNIT_DISTANCE, CameraLight, form_factors, make_patches, solve
from coliags_plugin.phantom.mucosa import Mucosa, paint_mucosa
from coliags_plugin.phantom.response import develop, encode, exposure_for, exposures, white_balances
from coliags_plugin.phantom.settings import PRESETS, PhantomSettings, phantom_settings
from coliags_plugin.phantom.streams import Purpose, SolidNoise, stream
from coliags_plugin.phantom.tracing import Tracer, nearest_poses_first, seen_from
from coliags_plugin.phantom.trajectory import NEAREST, camera_path, rotation, rotation_about, turn_away

ALBEDO = (0.7, 0.3, 0.2)
COARSE = {"mesh_spacing": 1.2, "texture_spacing": 0.4}


def lamp(**changes) -> CameraLight:
    plain = CameraLight((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), "cosine", 0.0, specular=0.0, roughness=0.3, f0=0.028)
    return replace(plain, **changes)


def grid_surface(grid: np.ndarray, normals: np.ndarray, tangents: np.ndarray) -> ColonSurface:
    """A mesh over a grid of points whose columns close upon themselves."""
    made = surface_of(grid, np.tile(np.eye(3), (len(grid), 1, 1)), np.arange(len(grid), dtype=float), 1.0)
    normals, tangents = (vectors.reshape(-1, 3).astype(np.float32) for vectors in (normals, tangents))
    return replace(made, normals=normals, tangents=tangents)


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
    world = World(surface, plain_mucosa(), Tracer(surface), lights, vignetting)
    exposure = expose(world, sensor, np.eye(4), None)
    return sensor, exposure


# --- light -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("distance", [6.0, 10.0, 20.0, 40.0])
@pytest.mark.parametrize("behind", [0.0, 3.6])
def test_flat_patch_obeys_inverse_square_from_the_lamp(distance, behind):
    sensor, exposure = photograph_plane(distance, (lamp(offset=(0.0, 0.0, -behind)),))
    middle = sensor.image(exposure.radiance)[9, 12]
    np.testing.assert_allclose(middle, np.array(ALBEDO) * (UNIT_DISTANCE / (distance + behind)) ** 2, rtol=1e-4)
    np.testing.assert_allclose(exposure.z_depth, distance, rtol=1e-5)


def test_every_pixel_of_a_flat_patch_obeys_the_whole_law():
    offset, spread, vignetting, distance = np.array([1.0, -0.5, -2.0]), 1.5, 2.5, 15.0
    light = lamp(offset=tuple(offset), spread=spread)
    sensor, exposure = photograph_plane(distance, (light,), vignetting)
    points = sensor.centers * distance
    away = points - offset
    square = (away**2).sum(axis=1)
    cos_lamp = away[:, 2] / np.sqrt(square)  # at once the angle of emission and that of incidence on this wall
    cos_theta = 1.0 / np.linalg.norm(sensor.centers, axis=1)
    inside = cos_lamp > np.cos(np.radians(70.0))
    expected = cos_lamp**spread * UNIT_DISTANCE**2 / square * cos_lamp * cos_theta**vignetting
    np.testing.assert_allclose(exposure.radiance[inside, 1], ALBEDO[1] * expected[inside], rtol=2e-4)


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
    directions = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1).reshape(-1, 3)
    solid = (np.sin(theta) * (np.pi / 800) * (2 * np.pi / 64)).ravel()
    eye = np.broadcast_to([0.0, 0.0, 1.0], directions.shape)
    for variance in (0.0, 0.05):
        gloss = light.gloss(eye, directions.copy(), eye, np.full(len(directions), variance))
        reflected = (gloss * solid).sum() / np.pi
        assert 0.8 * 0.04 < reflected < 1.05 * 0.04


def test_a_lamp_beside_the_lens_casts_shadows_and_one_on_the_axis_does_not():
    assert lamp(offset=(0.1, 0.0, -1.0)).casts_shadows
    assert not lamp(offset=(0.0, 0.0, -3.6)).casts_shadows


def test_interreflection_in_a_sphere_is_the_integrating_spheres():
    theta = np.linspace(0.02, np.pi - 0.02, 60)[:, None]
    phi = (np.arange(96) * 2 * np.pi / 96)[None, :]
    unit = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi], axis=-1)
    sphere = grid_surface(20.0 * unit, -unit, np.cross(unit, [0.0, 0.0, 1.0]))
    albedo = np.broadcast_to(np.array(ALBEDO, np.float32), (len(sphere.vertices), 3))
    patches = make_patches(sphere, albedo, stream(0, Purpose.INTERREFLECTION))
    factors = form_factors(patches, Tracer(sphere))
    assert factors.sum(axis=1).max() <= 1.0 + 1e-9
    np.testing.assert_allclose(factors.sum(axis=1).mean(), 1.0, atol=0.05)
    indirect = solve(patches, factors, np.ones((len(patches.areas), 1)))[0]
    expected = np.array(ALBEDO) / (1.0 - np.array(ALBEDO))
    np.testing.assert_allclose(indirect.mean(axis=0), expected, rtol=0.15)


# --- response --------------------------------------------------------------------------------------------------------


def test_encoding_is_a_power_law_with_a_smooth_shoulder():
    linear = np.linspace(0.0, 6.0, 6001)
    value = encode(linear, 2.2)
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
    assert encode(gain * radiance, 2.2).mean() == pytest.approx(target, abs=1e-6)


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


def test_noise_at_mid_grey_is_what_is_asked():
    radiance = np.full((60_000, 3), 0.5**2.2, np.float32)
    sensor = Sensor.behind(PinholeLens(20.0, 20.0, 2.0, 2.0, 4, 4), np.ones((4, 4), bool), 1)  # not used

    def image(noise):
        return develop(radiance, np.ones(3), PhantomSettings(noise=noise), stream(1, Purpose.SENSOR), sensor)

    for noise in (1.5, 3.0):
        # Rounding adds a variance of 1/12.
        assert image(noise).std() == pytest.approx(np.hypot(noise, np.sqrt(1 / 12)), rel=0.02)
    assert np.ptp(image(0.0)) == 0


# --- geometry --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def colon():
    chosen = PhantomSettings(**COARSE)
    anatomy = grow_anatomy(chosen)
    surface = build_surface(anatomy, chosen)
    return anatomy, surface, Tracer(surface)


def test_colon_has_the_anatomy_it_claims(colon):
    anatomy, surface, _ = colon
    stations = np.array([fold.arc for fold in anatomy.folds])
    assert 18 <= len(stations) <= 27 and len(anatomy.polyps) == 4
    assert all(5.0 <= fold.height <= 8.1 and 2.0 <= fold.thickness <= 4.0 for fold in anatomy.folds)
    # Half widths of a sixth to a third of the circumference: each crescent covers a third to two thirds.
    assert all(np.pi / 3 <= fold.half_width <= 2 * np.pi / 3 for fold in anatomy.folds)
    assert all(0.33 <= polyp.height / polyp.width <= 0.39 for polyp in anatomy.polyps)
    assert np.isfinite(surface.vertices).all()
    np.testing.assert_allclose(np.linalg.norm(surface.normals, axis=1), 1.0, atol=1e-5)


def test_normals_point_into_the_lumen_as_the_triangles_turn(colon):
    anatomy, surface, _ = colon
    middle = slice(10 * surface.columns, 80 * surface.columns)
    centres, _ = anatomy.centre_line.at(np.repeat(surface.arc, surface.columns)[middle])
    inward = ((centres - surface.vertices[middle]) * surface.normals[middle]).sum(axis=1)
    assert (inward > 0.0).mean() > 0.9  # not on the far flanks of folds
    corners = surface.vertices[surface.triangles[: 40 * surface.columns]]
    turning = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    smooth = surface.normals[surface.triangles[: 40 * surface.columns, 0]]
    assert ((turning * smooth).sum(axis=1) > 0.0).all()


def test_rotation_minimising_frames_are_rotations(colon):
    anatomy, _, _ = colon
    frames = anatomy.centre_line.at(np.linspace(0.0, 230.0, 77))[1]
    np.testing.assert_allclose(frames.transpose(0, 2, 1) @ frames, np.broadcast_to(np.eye(3), frames.shape), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(frames), 1.0)


def test_grid_place_agrees_with_barycentric_interpolation(colon):
    _, surface, tracer = colon
    generator = np.random.default_rng(0)
    directions = np.concatenate([generator.uniform(-1, 1, (500, 2)), np.ones((500, 1))], axis=1).astype(np.float32)
    pose = np.eye(4)
    pose[:3, 3] = (0.0, 0.0, 20.0)
    hits = tracer.cast(pose, directions).kept()
    row, column = surface.grid_coordinates(hits.triangle, hits.barycentric)
    number = np.repeat(np.arange(surface.rows), surface.columns)[:, None].astype(np.float32)
    np.testing.assert_allclose(row, tracer.interpolate(number, hits)[:, 0], atol=1e-3)
    angle = np.tile(np.arange(surface.columns) * (2.0 * np.pi / surface.columns), surface.rows)
    around = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rotated = tracer.interpolate(around, hits)
    apart = np.arctan2(rotated[:, 1], rotated[:, 0]) - column * (2 * np.pi / surface.columns)
    np.testing.assert_allclose((apart + np.pi) % (2 * np.pi) - np.pi, 0.0, atol=1e-3)


def test_noise_fills_space_with_unit_variance():
    noise = SolidNoise(stream(0, Purpose.RELIEF))
    points = np.random.default_rng(1).uniform(-100.0, 100.0, (40_000, 3)).astype(np.float32)
    layer = noise.layer(points, 3.0)
    assert abs(layer.mean()) < 0.05 and layer.std() == pytest.approx(1.0, abs=0.06)
    assert abs(np.corrcoef(layer, noise.layer(points, 3.0))[0, 1]) < 0.05


def test_mucosa_has_the_albedo_asked_for_and_no_seam(colon):
    anatomy, surface, _ = colon
    mucosa = paint_mucosa(anatomy, surface, PhantomSettings(**COARSE))
    mean = mucosa.albedo.mean(axis=(0, 1))
    np.testing.assert_allclose(mean, PhantomSettings().albedo, rtol=0.15)
    steps = np.abs(np.diff(mucosa.albedo, axis=1)).mean()
    seam = np.abs(mucosa.albedo[:, 0] - mucosa.albedo[:, -1]).mean()
    assert seam < 2.0 * steps
    row, fine = np.full(7, 30.0, np.float32), np.full(7, 0.1, np.float32)
    column = np.array([0.0, 1.0, 2.5, 3.0, 4.0, 5.0, 6.0], np.float32)
    near, far = mucosa.sample(row, column, fine), mucosa.sample(row, column + surface.columns, fine)
    np.testing.assert_allclose(near.albedo, far.albedo, atol=0.01)
    # What a wide footprint loses in relief it gains in variance.
    wide = mucosa.sample(row, column, np.full(7, 8.0, np.float32))
    assert wide.slope_variance.mean() > near.slope_variance.mean()


# --- motion ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("light", ["c3vd", "strong"])
@pytest.mark.parametrize("trajectory", ["pullback", "rotation"])
def test_the_camera_keeps_off_the_wall_and_poses_are_rigid(colon, light, trajectory):
    anatomy, _, tracer = colon
    chosen = PhantomSettings(light=light, trajectory=trajectory, frames=60, **COARSE)
    poses = camera_path(anatomy.centre_line, chosen, tracer)
    rotations = poses[:, :3, :3]
    np.testing.assert_allclose(
        rotations.transpose(0, 2, 1) @ rotations, np.broadcast_to(np.eye(3), (60, 3, 3)), atol=1e-9
    )
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0)
    clearance = tracer.clearance(poses[:, :3, 3])
    assert clearance.min() >= NEAREST
    travelled = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum()
    if trajectory == "pullback":
        assert 45.0 < travelled < 90.0
        if light == "strong":
            assert clearance.min() == pytest.approx(PRESETS["strong"].closest, abs=0.6)
    else:
        assert travelled < 20.0
        looks = poses[:, :3, 2]
        assert np.degrees(np.arccos(np.clip(looks @ looks[0], -1, 1))).max() > 20.0


def test_rotation_views_share_a_training_frames_place_and_turn_15_to_30_degrees(colon):
    anatomy, _, tracer = colon
    chosen = PhantomSettings(frames=41, rotation_views=12, **COARSE)
    poses = camera_path(anatomy.centre_line, chosen, tracer)
    views = turn_away(poses, chosen)
    assert len(views) == 12
    clocks = []
    for view in views:
        assert view.frame % 8
        np.testing.assert_array_equal(view.camera_to_world[:3, 3], poses[view.frame, :3, 3])
        look = poses[view.frame, :3, :3].T @ view.camera_to_world[:3, 2]
        assert np.degrees(np.arccos(look[2])) == pytest.approx(view.turn)
        assert 15.0 <= view.turn <= 30.0
        clocks.append(np.arctan2(look[1], look[0]))
    assert {int((clock + np.pi) // (np.pi / 2)) for clock in clocks} == {0, 1, 2, 3}


def test_where_the_camera_scans_rotation_views_go_on_outwards(colon):
    anatomy, _, tracer = colon
    chosen = PhantomSettings(frames=41, trajectory="rotation", **COARSE)
    poses = camera_path(anatomy.centre_line, chosen, tracer)
    middle = poses[:, :3, 2].mean(axis=0)
    middle /= np.linalg.norm(middle)
    for view in turn_away(poses, chosen):
        before, after = poses[view.frame, :3, 2] @ middle, view.camera_to_world[:3, 2] @ middle
        assert np.degrees(np.arccos(after) - np.arccos(before)) == pytest.approx(view.turn, abs=1e-3)


def test_rotation_conventions():
    # Yaw turns the look to the right (+x), pitch upwards (-y).
    assert rotation(0.1, 0.0, 0.0)[0, 2] > 0.0
    assert rotation(0.0, 0.1, 0.0)[1, 2] < 0.0
    np.testing.assert_allclose(rotation_about(np.array([0.0, 0.0, 1.0]), np.pi / 2) @ [1, 0, 0], [0, 1, 0], atol=1e-12)


# --- visibility ------------------------------------------------------------------------------------------------------


def test_a_point_is_seen_only_inside_the_frame_in_front_and_unhidden():
    surface = plane_at(20.0)
    tracer = Tracer(surface)
    lens = PinholeLens(20.0, 20.0, 12.5, 9.5, 25, 19)
    mask = np.ones((19, 25), bool)
    mask[:, :3] = False
    points = np.array([[0.0, 0.0, 20.0], [30.0, 0.0, 20.0], [0.0, 0.0, 30.0], [0.0, 0.0, -5.0], [-11.0, 0.0, 20.0]])
    # Before the lens; out of frame; behind the plane; behind the camera; on an unlit pixel.
    assert seen_from(points, [np.eye(4)], lens, mask, tracer).tolist() == [True, False, False, False, False]
    aside = np.eye(4)
    aside[0, 3] = 30.0
    assert seen_from(points, [np.eye(4), aside], lens, mask, tracer).tolist() == [True, True, False, False, False]
    assert not seen_from(points, [], lens, mask, tracer).any()
    assert nearest_poses_first(aside, [np.eye(4), aside])[0] is aside


# --- settings --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"frames": 8}, "frames"),
        ({"width": 15}, "width"),
        ({"light_offset": (4.0, 4.0, 0.0)}, "within 5 mm"),
        ({"light_offset": (float("nan"), 0.0, 0.0)}, "light_offset"),
        ({"lamps": ((1.0, 0.0, 0.0), (0.0, 6.0, 0.0))}, "phantom setting lamps.*6 mm from the lens"),
        ({"lamps": ((1.0, 0.0, 0.0),), "lamp_shares": (0.5, 0.5)}, "2 lamp_shares of 1 lamps"),
        ({"lamps": ((1.0, 0.0, 0.0),), "lamp_shares": (0.0,)}, "lamp_shares: .*one of them more"),
        ({"color_matrix": ((0.9, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))}, "color_matrix: .*sums to 0.9"),
        ({"color_matrix": ((1.0, 0.0, 0.0), (0.0, 1.4, -0.4), (0.0, 0.0, 1.0))}, "off-diagonal beyond 0.3"),
        ({"pose_noise": (0.1, -1.0)}, "pose_noise"),
        ({"compression": 0}, "compression"),
        ({"albedo": (1.2, 0.3, 0.2)}, "albedo"),
        ({"seed": -1}, "seed"),
        ({"layout": "c3vd_raw"}, "phantom setting layout: .*unknown layout; known are c3vd, .*colmap"),
        ({"polypes": 3}, "polyps"),
    ],
)
def test_bad_settings_are_named(options, named):
    with pytest.raises(InputError, match=named):
        phantom_settings(options)


def test_presets_fill_what_is_left_open():
    strong = PhantomSettings(light="strong").resolved()
    assert (strong.gain, strong.light_offset, strong.white_balance_drift) == ("fixed", (0.0, 0.0, 0.0), 0.0)
    assert phantom_settings({"lamps": [[3.0, 0.0, 0.0]]}).lamps == ((3.0, 0.0, 0.0),)
    mild = phantom_settings({"gain": "fixed", "layout": "nerfstudio", "white_balance_drift": 0.0}).resolved()
    assert (mild.gain, mild.white_balance_drift, mild.light_offset) == ("fixed", 0.0, (0.0, 0.0, -3.6))
