"""Whole phantoms, tiny ones: what lies on disk against the geometry it claims to show; settings of phantoms."""

from __future__ import annotations

import csv
import hashlib
import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from coliags_plugin.api.scenes import load_scene
from coliags_plugin.comparison.named_files import load_benchmark
from coliags_plugin.config.registry import datamanagers, phantom_layouts
from coliags_plugin.core.errors import InputError
from coliags_plugin.engine.data_formats import find_format
from coliags_plugin.phantom import light as lighting
from coliags_plugin.phantom.generate import generate, resolve
from coliags_plugin.phantom.layouts import Layout
from coliags_plugin.phantom.settings import IN_VIVO, PhantomSettings, phantom_settings
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


def test_benchmarks_name_seeds_and_an_exact_twin_lacks_nothing_but_the_errors_of_its_scene():
    for name in ("phantoms-8", "phantoms-12", "phantoms-tuning", "phantoms-tracked"):
        scenes = {key: scene.phantom for key, scene in load_benchmark(name).scenes.items()}
        assert name == "phantoms-8" or all(key.endswith(f"-{chosen.seed}") for key, chosen in scenes.items())
    errors = {"pose_noise": (0.17, 0.09), "depth_noise": 0.03}
    for key, chosen in scenes.items():
        if key.startswith("exact"):
            assert chosen.model_copy(update=errors) == scenes[key.replace("exact", "tracked")]
        else:
            assert {name: getattr(chosen, name) for name in errors} == errors
