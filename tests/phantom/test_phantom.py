"""Whole phantoms, tiny ones: what lies on disk against the geometry it claims to show."""

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

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scenes import Scene
from coliags_plugin.phantom import light as lighting
from coliags_plugin.phantom.generate import generate
from coliags_plugin.phantom.settings import PhantomSettings
from tests.phantom import phantom_layouts

TINY = phantom_layouts.TINY | {"width": 48, "height": 38, "frames": 17, "rotation_views": 3, "supersampling": 2}


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


@pytest.fixture(scope="module")
def scene(phantom) -> Scene:
    return phantom_layouts.read(phantom, "c3vd")


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


def test_the_image_is_exposed_and_red(scene):
    for frame in scene.video:
        red, green, blue = frame.rgb.mean(dim=(0, 1)).tolist()
        assert 0.35 < (red + green + blue) / 3 < 0.55
        assert red > 1.3 * green and green > blue


def test_poses_are_column_major_and_those_of_the_truth(phantom):
    truth = np.load(phantom / "truth/camera_to_world.npy")
    rows = np.loadtxt(phantom / "camera_pose.txt", delimiter=",")
    np.testing.assert_allclose(rows.reshape(17, 4, 4).transpose(0, 2, 1), truth, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(
        truth[:, :3, :3] @ truth[:, :3, :3].transpose(0, 2, 1), np.tile(np.eye(3), (17, 1, 1)), atol=1e-12
    )


def test_seen_masks_agree_with_a_depth_test(phantom, scene):
    agreement = []
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
