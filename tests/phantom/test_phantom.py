"""Whole phantoms, tiny ones: what lies on disk against the geometry it claims to show; settings; walls that move."""

from __future__ import annotations

import csv
import hashlib
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from coliags_plugin.api.scenes import load_scene
from coliags_plugin.comparison.named_files import load_benchmark
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.registry import datamanagers, phantom_layouts
from coliags_plugin.engine.data_formats import find_format
from coliags_plugin.geometry.lenses.endoscopes import endoscope
from coliags_plugin.geometry.lenses.models import PinholeLens
from coliags_plugin.geometry.meshes.mesh import TriangleMesh, read_mesh
from coliags_plugin.phantom import light as lighting
from coliags_plugin.phantom.colon import WAVE_LENGTH, WAVE_SPEED, breathing, peristalsis, wall_motion
from coliags_plugin.phantom.generate import PreparedPhantom, generate, prepare, resolve
from coliags_plugin.phantom.imaging import Sensor
from coliags_plugin.phantom.layouts import Layout
from coliags_plugin.phantom.props import Cover
from coliags_plugin.phantom.settings import IN_VIVO, PhantomSettings, phantom_settings
from coliags_plugin.phantom.trajectory import poses_between, poses_during, rotation
from tests.phantom.phantom_layouts import TINY as TINIEST
from tests.phantom.phantom_layouts import write_phantom
from tests.test_docs import table_rows

TINY = TINIEST | {"width": 48, "height": 38, "frames": 17, "rotation_views": 3, "supersampling": 2}


@pytest.fixture(scope="module")
def phantom(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("phantoms") / "plain"
    generate(PhantomSettings(**TINY), folder)
    return folder


def image(path: Path) -> np.ndarray:
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert pixels is not None, path
    return pixels


def digest(folder: Path) -> dict[str, str]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def test_layout_is_coliags_own(phantom):
    assert [path.name for path in sorted((phantom / "images").iterdir())] == [f"{i:04d}_color.png" for i in range(17)]
    color, depth = image(phantom / "images/0000_color.png"), image(phantom / "depths/0016_depth.png")
    assert color.shape == (38, 48, 3) and color.dtype == np.uint8
    assert depth.shape == (38, 48) and depth.dtype == np.uint16 and depth.min() > 0
    assert sorted(json.loads((phantom / "camera.json").read_text())) == ["cx", "cy", "fx", "fy", "h", "w"]
    rotated = phantom / "rotation"
    assert len(list((rotated / "images").iterdir())) == len(list((rotated / "seen").iterdir())) == 3
    assert (rotated / "camera.json").read_text() == (phantom / "camera.json").read_text()
    assert sorted(path.name for path in (phantom / "truth/seen").iterdir()) == [f"{i:04d}_seen.png" for i in (0, 8, 16)]
    record = json.loads((phantom / "phantom.json").read_text())
    assert record["settings"]["gain"] == "auto" and record["settings"]["width"] == 48


def test_poses_are_column_major_and_those_of_the_truth(phantom):
    truth = np.load(phantom / "truth/camera_to_world.npy")
    rows = np.loadtxt(phantom / "camera_pose.txt", delimiter=",")
    np.testing.assert_allclose(rows.reshape(17, 4, 4).transpose(0, 2, 1), truth, rtol=1e-7, atol=1e-9)


def test_seen_masks_agree_with_a_depth_test(phantom):
    agreement, scene = [], load_scene(phantom)
    for view in scene.test_sets["rotation"]:
        mask = view.seen.reshape(-1)
        points = view.camera.unproject(view.depth).reshape(-1, 3)
        seen = torch.zeros(len(points), dtype=torch.bool)
        for frame in scene.train:
            pixels, z = frame.camera.project(points)
            column, row = (pixels - 0.5).round().long().unbind(-1)
            framed = (z > 0) & (column >= 0) & (row >= 0) & (column < 48) & (row < 38)
            wall = frame.depth[row.clamp(0, 37), column.clamp(0, 47)]
            seen |= framed & (z < 1.06 * wall + 0.3)
        agreement.append((seen == mask).double().mean())
    assert len(agreement) == 3 and min(agreement) > 0.93
    mask = image(phantom / "truth/seen/0008_seen.png")
    assert mask.mean() > 0.97 * 255 and set(np.unique(mask)) <= {0, 255}


def test_mesh_flags_what_training_frames_saw(phantom):
    flags = np.load(phantom / "truth/mesh_seen.npz")
    albedo = np.load(phantom / "truth/albedo.npz")
    assert len(flags["vertex_seen"]) == len(albedo["vertex_albedo"])
    assert 0.1 < flags["vertex_seen"].mean() < 0.6
    assert np.all(flags["face_seen_by_any_frame"] >= flags["face_seen"])
    # A triangle that was hit has, nearly always, a corner that is seen.
    import open3d

    mesh = open3d.io.read_triangle_mesh(str(phantom / "truth/mesh.ply"))
    corners = flags["vertex_seen"][np.asarray(mesh.triangles)]
    assert corners[flags["face_seen"]].any(axis=1).mean() > 0.97
    assert mesh.has_vertex_colors() and mesh.has_vertex_normals()


def test_gain_and_light_are_told(phantom):
    rows = list(csv.DictReader((phantom / "truth/gain.csv").open()))
    assert [int(row["frame"]) for row in rows] == list(range(17))
    light = json.loads((phantom / "truth/light.json").read_text())
    assert light["lamp"]["offset"] == [0.0, 0.0, -3.6] and light["gain"] == "auto"
    rotated = list(csv.DictReader((phantom / "truth/rotation_gain.csv").open()))
    for view, row in zip(light["rotation_views"], rotated, strict=True):
        # Exposed for what it sees, with the white balance of its frame.
        frame = rows[view["frame"]]
        assert row["gain_g"] != frame["gain_g"]
        for side in ("gain_r", "gain_b"):
            ratios = [float(gains[side]) / float(gains["gain_g"]) for gains in (row, frame)]
            assert ratios[0] == pytest.approx(ratios[1], rel=1e-6)


@pytest.mark.thorough
def test_same_seed_same_bytes_and_another_seed_another_colon(tmp_path, monkeypatch):
    monkeypatch.setattr(lighting, "_PATCH", 15.0)  # mm: few pairs of patches, whose light takes most of the time
    small = {**TINY, "frames": 9, "rotation_views": 1, "interreflection": 1.0, "mesh_spacing": 2.5}
    for name, seed in (("one", 7), ("two", 7), ("other", 8)):
        generate(PhantomSettings(**small, seed=seed), tmp_path / name)
    first, second, other = (digest(tmp_path / name) for name in ("one", "two", "other"))
    assert first == second
    assert first.keys() == other.keys()
    assert all(first[name] != other[name] for name in first if name.endswith((".png", ".ply")) and "seen" not in name)


def test_nothing_is_replaced_or_left_half_written(phantom, tmp_path):
    before = digest(phantom)
    with pytest.raises(InputError, match="already exists"):
        generate(PhantomSettings(**TINY), phantom)
    blocked = tmp_path / "file"
    blocked.write_text("here first")
    with pytest.raises(InputError):
        generate(PhantomSettings(**TINY), blocked / "phantom")

    def stop(stage: str, done: int, total: int) -> None:
        if stage == "frames" and done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        generate(PhantomSettings(**TINY), tmp_path / "stopped", progress=stop)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
    assert digest(phantom) == before


def test_importing_loads_nothing_heavy():
    code = (
        "import sys, coliags_plugin.phantom.generate;print(sorted({'open3d', 'torch', 'pycolmap'} & set(sys.modules)))"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ended.stdout.strip() == "[]"


# The table of layouts: names, what they declare, and what the page about phantoms says of them


def layout_of(name: str) -> Layout:
    return phantom_layouts.get(name)()


ROWS = {row[0]: row[1:] for row in table_rows("../docs/phantom.md", "| layout | what | size, px | rotation views |")}
BUILT_IN = [name for name in phantom_layouts if phantom_layouts.source(name) == "built in"]


def test_every_layout_is_told():
    assert sorted(ROWS) == BUILT_IN


@pytest.mark.parametrize("name", BUILT_IN)
def test_sizes_rotation_views_and_lenses_are_as_told_and_asked_for(name):
    layout, (_, size, rotation) = layout_of(name), ROWS[name]
    assert isinstance(layout, Layout)
    assert size == "x".join(map(str, layout.default_size))
    assert (rotation != "none") == layout.has_rotation
    settings = resolve(PhantomSettings(layout=name), layout)
    assert (settings.width, settings.height) == layout.default_size
    assert settings.rotation_views == (12 if layout.has_rotation else 0)
    lens, lit = layout.lens(64, 51)
    assert (lens.width, lens.height) == (64, 51)
    assert lit.shape == (51, 64)
    assert lit.mean() > 0.5


#: With a frame that REIM-NeRF validates on, number 25.
FRAMES = 27


@pytest.mark.thorough
@pytest.mark.parametrize("name", phantom_layouts)
def test_the_phantoms_split_is_the_one_that_its_manager_reads(name, tmp_path):
    """Points, masks and turned views go by the phantom's own idea of which frames are trained on."""
    options = {"frames": FRAMES, "mesh_spacing": 3.0, "texture_spacing": 1.0, "path_length": 20.0}
    write_phantom(tmp_path / "colon", name, 48, 38, **options)
    folder = tmp_path / "colon" / ("C3VD/phantom" if name == "pr-endo" else ".")
    manager = datamanagers.get(find_format(folder))
    scene = manager(manager.Settings(initial_points="none")).load(folder)
    layout = layout_of(name)
    held_out = {index for index in range(FRAMES) if layout.is_test(index)}
    assert {frame.index for frame in scene.train} == set(range(FRAMES)) - held_out
    # Masks say of every frame that is held out what training frames see of it.
    masks = sorted(layout.seen_mask(tmp_path / "colon", "video", 0).parent.glob("*_seen.png"))
    if name == "rotatecolon":
        # It holds no frame out: the turned views are its test views.
        assert not held_out and len(masks) == len(scene.test_sets["test"]) == 2
    else:
        assert {int(path.name[:4]) for path in masks} == held_out
        tested = {frame.index for frame in scene.test_sets["test"]}
        # REIM-NeRF's validation frames are neither trained nor tested on.
        assert held_out - tested == ({25} if name == "reim-nerf" else set()) and tested <= held_out
    for frame in scene.test_sets["test"]:
        assert frame.seen is not None
    assert np.load(tmp_path / "colon/truth/camera_to_world.npy").shape == (FRAMES, 4, 4)


# Phantoms of a real endoscope


@pytest.mark.parametrize("layout", BUILT_IN)
def test_a_real_endoscopes_lens_is_scaled_by_width_about_the_middle(layout):
    lens = endoscope("endomapper-03").lens
    whole, cropped = (layout_of(layout).lens_of(lens, 160, height) for height in (120, 128))
    assert vars(whole.pinhole) == pytest.approx(vars(lens.resized(160, 120).pinhole))
    k = cropped.pinhole
    assert (k.fx, k.fy) == pytest.approx((726.7941 / 9.0, 727.7907 / 9.0))
    assert (k.cx - 80.0, k.cy - 64.0) == pytest.approx(((742.7416 + 0.5 - 720.0) / 9.0, (542.1428 + 0.5 - 540.0) / 9.0))
    # A point at 45 degrees to the right, by the definition of the lens.
    right = k.fx
    if layout == "nerfstudio":
        r = np.pi / 4.0
        bend = 1.0 - 0.1289632 * r**2 - 0.006051189 * r**4 + 0.001660961 * r**6 - 7.847858e-05 * r**8
        right = k.fx * r * bend
    np.testing.assert_allclose(cropped.project([[5.0, 0.0, 5.0]]), [[k.cx + right, k.cy]], rtol=1e-12)


@pytest.mark.parametrize("layout", ["c3vd", "nerfstudio"])
def test_a_phantom_of_a_real_endoscope_loads_with_its_lens_and_light(layout, tmp_path):
    write_phantom(tmp_path / "colon", layout, 48, 36, endoscope="endomapper-09")
    real = endoscope("endomapper-09")
    truth = json.loads((tmp_path / "colon/truth/light.json").read_text())
    assert (truth["vignetting"], truth["lamp"]["spread_law"]) == (0.0, "cosine")
    assert (truth["lamp"]["spread"], truth["lamp"]["axis"]) == (real.power, list(real.axis))
    for frame in load_scene(tmp_path / "colon").train:
        k = frame.camera.intrinsics
        assert vars(k) == pytest.approx(vars(real.lens.resized(48, 36).pinhole), rel=1e-6)
        assert frame.valid.all()
        for rim in ([0, -1], (slice(None), [0, -1])):
            assert (frame.depth[rim] > 0.0).all() and frame.image[rim].float().mean() > 40.0


# Settings of phantoms, and those of the benchmarks


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
        ({"endoscope": "endomaper-07"}, "phantom setting endoscope: no endoscope.*Did you mean 'endomapper-07'"),
    ],
)
def test_bad_settings_are_named(options, named):
    with pytest.raises(InputError, match=named):
        phantom_settings(options)


def test_presets_fill_what_is_left_open_and_the_record_is_read_back():
    strong = PhantomSettings(light="strong")
    assert (strong.gain, strong.light_offset, strong.white_balance_drift) == ("fixed", (0.0, 0.0, 0.0), 0.0)
    assert phantom_settings({"lamps": [[3.0, 0.0, 0.0]]}).lamps == ((3.0, 0.0, 0.0),)
    mild = phantom_settings({"gain": "fixed", "layout": "nerfstudio", "white_balance_drift": 0.0})
    assert (mild.gain, mild.white_balance_drift, mild.light_offset) == ("fixed", 0.0, (0.0, 0.0, -3.6))
    settings = phantom_settings({"preset": "in-vivo", "wave": 0.0, "frames": 30})
    assert settings.wave == 0.0 and settings.frames == 30 and settings.breathing == IN_VIVO["breathing"]
    assert PhantomSettings(**settings.model_dump()) == settings
    assert phantom_settings({}).model_dump() == PhantomSettings().model_dump()


def test_names_of_phantoms_end_in_their_seeds():
    for name in ("phantoms-test", "phantoms-tuning"):
        assert all(key.endswith(f"-{scene.phantom.seed}") for key, scene in load_benchmark(name).scenes.items())


# Walls that move, and what covers them: closed forms of the motion, and what lies on disk against the moved wall


SMALL = TINIEST | {"width": 48, "height": 38, "mesh_spacing": 2.5, "texture_spacing": 0.8, "rotation_views": 0}
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
