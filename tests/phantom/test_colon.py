"""Geometry of phantoms: the colon's wall, its texture, the camera's paths, and what is seen."""

from __future__ import annotations

import csv
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from coliags_plugin.core.errors import InputError
from coliags_plugin.geometry.lenses.models import PinholeLens
from coliags_plugin.phantom import trajectory
from coliags_plugin.phantom.colon import Tracer, build_surface, grow_anatomy, nearest_poses_first, seen_from
from coliags_plugin.phantom.generate import generate
from coliags_plugin.phantom.mucosa import paint_mucosa
from coliags_plugin.phantom.settings import PRESETS, PhantomSettings
from coliags_plugin.phantom.streams import Purpose, SolidNoise, stream
from coliags_plugin.phantom.trajectory import APPROACHES, NEAREST, camera_path, turn_away
from tests.phantom.test_light import plane_at

COARSE = {"mesh_spacing": 1.2, "texture_spacing": 0.4}
TRAINING = [frame for frame in range(41) if frame % 8]


@pytest.fixture(scope="module")
def colon():
    chosen = PhantomSettings(**COARSE)
    anatomy = grow_anatomy(chosen)
    surface = build_surface(anatomy, chosen)
    return anatomy, surface, surface.tracer


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
    frames = anatomy.centre_line.at(np.linspace(0.0, 230.0, 77))[1]
    np.testing.assert_allclose(frames.transpose(0, 2, 1) @ frames, np.tile(np.eye(3), (77, 1, 1)), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(frames), 1.0)


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


def test_grid_place_agrees_with_barycentric_interpolation(colon):
    _, surface, tracer = colon
    generator = np.random.default_rng(0)
    directions = np.concatenate([generator.uniform(-1, 1, (500, 2)), np.ones((500, 1))], axis=1).astype(np.float32)
    pose = np.eye(4)
    pose[:3, 3] = (0.0, 0.0, 20.0)
    hits = tracer.cast(pose, directions)
    hits = hits.only(hits.found)
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
    views = turn_away(poses, chosen, TRAINING)
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
    for view in turn_away(poses, chosen, TRAINING):
        before, after = poses[view.frame, :3, 2] @ middle, view.camera_to_world[:3, 2] @ middle
        assert np.degrees(np.arccos(after) - np.arccos(before)) == pytest.approx(view.turn, abs=1e-3)


def test_a_point_is_seen_only_inside_the_frame_in_front_and_unhidden():
    tracer = plane_at(20.0).tracer
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


# The path that inspects: how near it comes to the wall, what it looks at, how smooth it is, and the gain it causes


#: The far stops fall on frames 0, 40, 80, 120, and the near ones on 20, 60, 100.
FRAMES = 121
INSPECTION = {"trajectory": "inspection", "mesh_spacing": 1.6, "frames": FRAMES}
FAR, NEAR = [0, 40, 80, 120], [20, 60, 100]


def path_of(inspected: SimpleNamespace, **changes) -> np.ndarray:
    return camera_path(inspected.centre_line, inspected.settings.model_copy(update=changes), inspected.tracer)


@pytest.fixture(scope="module", params=[1, 4])
def inspected(request):
    """A colon, and the paths through it by preset."""
    chosen = PhantomSettings(**INSPECTION, seed=request.param)
    anatomy = grow_anatomy(chosen)
    tracer = build_surface(anatomy, chosen).tracer
    inspected = SimpleNamespace(settings=chosen, centre_line=anatomy.centre_line, tracer=tracer)
    inspected.paths = {light: path_of(inspected, light=light) for light in PRESETS}
    return inspected


def distances_in_the_middle(tracer: Tracer, pose: np.ndarray) -> np.ndarray:
    """Distances of the wall along rays up to 4 degrees from the centre of the image, mm."""
    clock = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
    ring = np.stack([np.cos(clock), np.sin(clock)], axis=1) * np.tan(np.radians(4.0))
    rays = np.concatenate([[[0.0, 0.0]], ring, 0.5 * ring])
    directions = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
    return tracer.cast(pose, directions.astype(np.float32)).z_depth * np.linalg.norm(directions, axis=1)


def turns(path: np.ndarray) -> np.ndarray:
    """Angle of the rotation from each frame to the next, degrees."""
    traces = np.einsum("tij,tij->t", path[1:, :3, :3], path[:-1, :3, :3])
    return np.degrees(np.arccos(np.clip(0.5 * (traces - 1.0), -1.0, 1.0)))


@pytest.mark.parametrize("light", PRESETS)
def test_it_comes_close_to_the_wall_again_and_again_and_looks_at_what_is_close(inspected, light):
    poses, tracer = inspected.paths[light], inspected.tracer
    clearance = tracer.clearance(poses[:, :3, 3])
    _, frames = inspected.centre_line.at(np.linspace(76.0, 26.0, 2 * APPROACHES + 1)[1::2])
    for stop, frame in zip(NEAR, frames, strict=True):
        # Within the approach only a fold that is passed may be nearer than the spot.
        assert NEAREST <= clearance[stop - 20 : stop + 21].min() <= clearance[stop] <= 7.0
        assert 6.0 < distances_in_the_middle(tracer, poses[stop])[0] < 10.0
        # The view has turned from the lumen to its wall, as the camera itself has moved towards it.
        away = np.degrees(np.arccos(poses[stop, :3, 2] @ frame[:, 2]))
        assert 45.0 - 1e-6 <= away <= 75.0 + 1e-6
    for stop in FAR:
        assert clearance[stop] > 9.0
        assert np.median(distances_in_the_middle(tracer, poses[stop])) == pytest.approx(60.0, abs=15.0)


def test_it_is_smooth(inspected):
    for light, poses in inspected.paths.items():
        centers, rotations = poses[:, :3, 3], poses[:, :3, :3]
        np.testing.assert_allclose(
            rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (FRAMES, 1, 1)), atol=1e-9
        )
        assert np.linalg.norm(np.diff(centers, axis=0), axis=1).max() < 3.0
        assert np.linalg.norm(np.diff(centers, n=2, axis=0), axis=1).max() < 0.5
        assert turns(poses).max() < 11.0
        assert np.degrees(np.linalg.norm(np.diff(rotations[:, :, 2], n=2, axis=0), axis=1)).max() < 1.8
        # Frames are samples of one curve without jumps: with twice as many, steps are half as long.
        finer = path_of(inspected, light=light, frames=2 * FRAMES - 1)
        np.testing.assert_allclose(finer[::2], poses, atol=1e-9)
        for of in (lambda path: np.linalg.norm(np.diff(path[:, :3, 3], axis=0), axis=1), turns):
            assert of(finer).max() == pytest.approx(0.5 * of(poses).max(), rel=0.03)


def test_a_colon_without_such_a_path_is_an_error(inspected, monkeypatch):
    monkeypatch.setattr(trajectory, "_SPOT_WITHIN", 1.0)
    monkeypatch.setattr(trajectory, "_DRAWS", 3)
    with pytest.raises(InputError, match=f"seed {inspected.settings.seed} .*no path") as refused:
        path_of(inspected)
    assert "another seed" in str(refused.value)


@pytest.mark.thorough
def test_automatic_gain_swings_up_to_its_span_and_most_of_the_rotated_views_is_seen(tmp_path):
    small = {"width": 48, "height": 38, "rotation_views": 6, "texture_spacing": 0.4, "supersampling": 1}
    options = {**INSPECTION, **small, "seed": 3, "frames": 60, "interreflection": 0.0}
    generate(PhantomSettings(**options, gain="auto"), tmp_path / "phantom")
    truth = tmp_path / "phantom" / "truth"
    gain = np.array([float(row["gain_g"]) for row in csv.DictReader((truth / "gain.csv").open())])
    assert 2.5 <= gain.max() / gain.min() <= 3.0 + 1e-5
    # Low at near stops, frames 10, 30 and 50, and high at far ones.
    assert gain[[10, 30, 50]].max() < 0.5 * gain[[0, 20, 39, 59]].min()
    seen = [cv2.imread(str(path), 0) > 0 for path in sorted((tmp_path / "phantom/rotation/seen").iterdir())]
    assert len(seen) == 6 and np.mean(seen) > 0.75
    # The script behind the tables of the documentation tells the same.
    script = Path(__file__).parents[2] / "benchmarks" / "phantom_properties.py"
    told = subprocess.run([sys.executable, script, tmp_path / "phantom"], capture_output=True, text=True, check=True)
    row = told.stdout.splitlines()[2].split(" | ")
    assert row[3] == f"{gain.max() / gain.min():.2f}" and 6.0 <= float(row[4]) <= 7.0
    assert float(row[-1].rstrip(" |")) == pytest.approx(100.0 * np.mean(seen), abs=0.51)
