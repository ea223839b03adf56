"""Phantoms whose wall moves: closed forms of the motion, and what lies on disk against the moved wall."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from coliags_plugin.core.errors import InputError
from coliags_plugin.geometry.lenses.models import PinholeLens
from coliags_plugin.geometry.meshes.mesh import TriangleMesh, read_mesh
from coliags_plugin.phantom.colon import WAVE_LENGTH, WAVE_SPEED, breathing, peristalsis, wall_motion
from coliags_plugin.phantom.generate import PreparedPhantom, generate, prepare
from coliags_plugin.phantom.imaging import Sensor
from coliags_plugin.phantom.props import Cover
from coliags_plugin.phantom.settings import PhantomSettings
from coliags_plugin.phantom.trajectory import poses_between, poses_during, rotation
from tests.phantom.phantom_layouts import TINY

SMALL = TINY | {"width": 48, "height": 38, "mesh_spacing": 2.5, "texture_spacing": 0.8, "rotation_views": 0}
LIVING = SMALL | {"wave": 2.0, "breathing": 1.0, "fluid": 4.0, "bubbles": 80, "tool": True, "noise": 0.0}


def prepared(settings: PhantomSettings) -> PreparedPhantom:
    return prepare(settings, lambda stage, done, total: None)


@pytest.fixture(scope="module")
def living() -> PreparedPhantom:
    return prepared(PhantomSettings(**LIVING))


@pytest.fixture(scope="module")
def written(living, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("phantoms") / "living"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("coliags_plugin.phantom.generate.prepare", lambda *_: living)  # which takes most of the time
        generate(living.settings, folder)
    return folder


def test_the_wave_travels_at_its_speed_and_repeats_after_its_period():
    settings = PhantomSettings(wave=3.0)
    arc, times = np.arange(20.0, 150.0, 0.5), np.array([0.0, 1.0, WAVE_LENGTH / WAVE_SPEED])
    wave = peristalsis(arc, times, settings, 0.4)
    np.testing.assert_allclose(wave[1, :-20], wave[0, 20:], atol=1e-9)
    np.testing.assert_allclose(wave[2], wave[0], atol=1e-9)
    assert np.abs(wave).max() == pytest.approx(3.0, abs=0.01)
    assert not peristalsis(np.array([215.0, 232.0]), times, settings, 0.4).any()


def test_breathing_swings_across_the_colon_with_its_period():
    settings = PhantomSettings(breathing=1.5)
    shift = breathing(np.arange(0.0, 160.0), np.arange(0.0, 4.0, 0.25), settings, np.eye(3), np.array([0.7, 0.0, 0.0]))
    direction = np.array([np.cos(0.7), np.sin(0.7), 0.0])
    np.testing.assert_allclose(shift[4, 40], 1.5 * direction, atol=1e-9)
    np.testing.assert_allclose(shift[12], -shift[4], atol=1e-9)
    np.testing.assert_allclose(shift[2], shift[6], atol=1e-9)


def test_a_motion_of_zero_leaves_the_wall_to_the_bit(living):
    still = replace(living.motion, wave=0.0 * living.motion.wave, shift=0.0 * living.motion.shift).at(3)
    np.testing.assert_array_equal(still.vertices, living.world.surface.vertices)
    np.testing.assert_allclose(still.normals, living.world.surface.normals, atol=2e-4)


def test_depth_is_that_of_the_moved_wall_that_the_files_tell(written):
    mesh = read_mesh(written / "truth" / "mesh.ply")
    motion = np.load(written / "truth" / "wall_motion.npz")
    rest = mesh.vertices.astype(float).reshape(motion["radial"].shape)
    poses = np.load(written / "truth" / "camera_to_world.npy")
    k = json.loads((written / "camera.json").read_text())
    lens = PinholeLens(k["fx"], k["fy"], k["cx"] + 0.5, k["cy"] + 0.5, k["w"], k["h"])
    column, row = np.meshgrid(np.arange(k["w"]), np.arange(k["h"]))
    rays = lens.unproject(np.stack([column, row], axis=-1).reshape(-1, 2) + 0.5)
    gaps = []
    for frame in (0, 5):
        moved = rest + motion["wave_mm"][frame, :, None, None] * motion["radial"] + motion["shift_mm"][frame, :, None]
        wall = TriangleMesh(moved.reshape(-1, 3), mesh.triangles)
        _, expected = wall.rays.cast(poses[frame, :3, 3], rays @ poses[frame, :3, :3].T)
        stored = cv2.imread(str(written / "depths" / f"{frame:04d}_depth.png"), cv2.IMREAD_UNCHANGED)
        depth = stored.ravel() * (100.0 / 65535.0)
        near = expected < 99.0
        np.testing.assert_allclose(depth[near], expected[near], atol=0.002)
        gaps.append(np.abs(moved - rest).max())
    assert min(gaps) > 0.5


def test_masks_are_exactly_where_the_wall_alone_would_look_different(living, written):
    bare = replace(living, settings=living.settings.model_copy(update={"fluid": 0.0, "bubbles": 0, "tool": False}))
    found = set()
    for frame in (0, 4, 8):
        exposure, _ = living.render_frame(frame)
        wall, _ = bare.render_frame(frame)
        np.testing.assert_array_equal(exposure.cover > 0, np.any(exposure.radiance != wall.radiance, axis=1))
        np.testing.assert_array_equal(exposure.z_depth, wall.z_depth)
        stored = cv2.imread(str(written / "truth" / "not_wall" / f"{frame:04d}.png"), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(stored, living.sensor.image(exposure.cover))
        found |= set(np.unique(stored))
    assert found == {Cover.WALL, Cover.FLUID, Cover.BUBBLE, Cover.TOOL}


def test_drops_are_masked_and_the_rest_of_the_image_is_as_before():
    washed = prepared(PhantomSettings(**SMALL, washes=1, frame_rate=4.0))
    dry = replace(washed, settings=washed.settings.model_copy(update={"washes": 0}))
    wet = []
    for frame in range(9):
        exposure, before = washed.render_frame(frame)[0], dry.render_frame(frame)[0]
        same = np.all(exposure.radiance == before.radiance, axis=1)
        assert same[exposure.cover == Cover.WALL].all()
        wet.append((exposure.cover == Cover.DROP).mean())
    assert max(wet) > 0.05 and min(wet) == 0.0


def test_the_pose_relative_to_the_wall_undoes_a_rigid_shift(tmp_path, monkeypatch):
    def shifted(anatomy, surface, settings):
        motion = wall_motion(anatomy, surface, settings)
        shift = np.broadcast_to(np.float32([0.5, -1.0, 2.0]), motion.shift.shape)
        return replace(motion, wave=0.0 * motion.wave, shift=shift)

    monkeypatch.setattr("coliags_plugin.phantom.generate.wall_motion", shifted)
    generate(PhantomSettings(**SMALL, breathing=1.0), tmp_path / "shifted")
    truth = tmp_path / "shifted" / "truth"
    world, wall = np.load(truth / "camera_to_world.npy"), np.load(truth / "camera_to_wall.npy")
    np.testing.assert_allclose(world[:, :3, 3] - wall[:, :3, 3], np.tile([0.5, -1.0, 2.0], (9, 1)), atol=1e-4)
    np.testing.assert_allclose(world[:, :3, :3], wall[:, :3, :3], atol=1e-5)
    assert np.load(truth / "wall_motion.npz")["residual_mm"].max() < 1e-4


def test_poses_of_an_exposure_are_even_about_the_frames_own():
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :3, 3] = np.arange(5.0)[:, None] * [1.0, 0.0, 0.0]
    for number, pose in enumerate(poses):
        pose[:3, :3] = rotation(np.radians(8.0) * number, 0.0, 0.0)
    during = np.stack(poses_during(poses, 2, 0.5, 200.0, 4))
    # 4 degrees and half a millimetre at 15 mm: 20.6 px, so a rendering every 1.25 px.
    assert len(during) == 17
    np.testing.assert_allclose(during[8], poses[2], atol=1e-9)
    np.testing.assert_allclose(np.diff(during[:, 0, 3]), 0.5 / 17, atol=1e-9)
    assert len(poses_during(np.tile(np.eye(4), (5, 1, 1)), 0, 1.0, 200.0, 4)) == 4
    np.testing.assert_allclose(poses_between(poses, np.array([1.25]))[0, 0, 3], 1.25)


def test_a_still_camera_is_not_blurred():
    sharp = prepared(PhantomSettings(**SMALL | {"supersampling": 2}))
    still = replace(sharp, poses=np.repeat(sharp.poses[:1], 9, axis=0))
    blurred = replace(still, settings=still.settings.model_copy(update={"shutter": 0.5}))
    one, other = (each.render_frame(3)[0].radiance for each in (still, blurred))
    np.testing.assert_allclose(one, other, rtol=2e-3, atol=1e-4)


def test_softness_spreads_light_and_keeps_it():
    sensor = Sensor.behind(PinholeLens(28.0, 28.0, 24.0, 19.0, 48, 38), np.ones((38, 48), bool), 1)
    point = np.zeros((38, 48, 3), np.float32)
    point[19, 24] = 1.0
    soft = sensor.image(sensor.softened(point[sensor.mask], 1.5))[..., 0]
    row = np.arange(38)[:, None]
    assert soft.sum() == pytest.approx(1.0, rel=1e-3)
    assert np.sqrt((soft * (row - 19.0) ** 2).sum()) == pytest.approx(1.5, rel=0.05)
    np.testing.assert_allclose(sensor.softened(np.ones((38 * 48, 3), np.float32), 3.0), 1.0, rtol=1e-5)


@pytest.mark.thorough
def test_an_examination_turns_fast_and_touches_the_moving_wall():
    settings = PhantomSettings(
        **SMALL | {"trajectory": "examination", "frames": 120, "turns": 2, "contacts": 1, "wave": 2.0, "seed": 1}
    )
    phantom = prepared(settings)
    clear = [
        phantom.motion.at(frame).tracer.clearance(pose[None, :3, 3])[0]
        for frame, pose in enumerate(phantom.poses)
        if frame % 2 == 0
    ]
    assert 0.5 < min(clear) < 2.0 and np.median(clear) > 3.0
    relative = np.einsum("tji,tjk->tik", phantom.poses[:-1, :3, :3], phantom.poses[1:, :3, :3])
    angle = np.degrees(np.arccos(np.clip(0.5 * (np.trace(relative, axis1=1, axis2=2) - 1.0), -1.0, 1.0)))
    assert 8.0 < angle.max() < 30.0


def test_a_wall_that_moves_over_the_camera_is_refused(monkeypatch):
    monkeypatch.setattr("coliags_plugin.phantom.generate._CLEAR", 30.0)
    with pytest.raises(InputError, match=r"from the camera at frame 0"):
        prepared(PhantomSettings(**SMALL, wave=1.0))
