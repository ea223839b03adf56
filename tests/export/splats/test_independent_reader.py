"""Our files read back by PlayCanvas's splat-transform, which shares no code with ours: numbers, axes and degree.

Skips where the program is not on the PATH: ``npm install @playcanvas/splat-transform node@22``. Versions 2 (which run
with node 20) and 3 read SPZ in different axes.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest

from coliags_plugin.core.images import read_rgb
from coliags_plugin.export.splats.cloud import SplatCloud, harmonics_of_colors
from coliags_plugin.export.splats.files import write_splats
from tests.export.splats.clouds import covariances, random_cloud, read_glb

PROGRAM = shutil.which("splat-transform")
pytestmark = pytest.mark.skipif(PROGRAM is None, reason="no splat-transform on the PATH")


def transform(*arguments) -> str:
    """Standard output of the program, run with the node beside it."""
    environment = {**os.environ, "PATH": f"{Path(str(PROGRAM)).parent}{os.pathsep}{os.environ['PATH']}"}
    command = [str(PROGRAM), "--quiet", "--gpu", "cpu", *map(str, arguments)]
    return subprocess.run(command, check=True, capture_output=True, text=True, timeout=120, env=environment).stdout


def read_back(path: Path, degree: int) -> dict[str, np.ndarray]:
    """The columns that it reads, of harmonics of the degree."""
    table = path.with_suffix(".csv")
    transform(path, table)
    names = table.read_text().partition("\n")[0].split(",")
    assert sum(name.startswith("f_rest") for name in names) == 3 * ((degree + 1) ** 2 - 1)
    return dict(zip(names, np.loadtxt(table, delimiter=",", skiprows=1, ndmin=2).T, strict=True))


def stacked(columns: dict[str, np.ndarray], prefix: str, count: int) -> np.ndarray:
    return np.stack([columns[f"{prefix}_{index}"] for index in range(count)], axis=1)


@pytest.mark.parametrize("degree", [0, 3])
def test_ply(tmp_path, degree):
    cloud = random_cloud(60, degree)
    write_splats(tmp_path / "a.ply", cloud, "ply", "a comment")
    columns = read_back(tmp_path / "a.ply", degree)
    np.testing.assert_allclose(np.stack([columns[axis] for axis in "xyz"], axis=1), cloud.means, rtol=1e-6)
    np.testing.assert_allclose(np.exp(stacked(columns, "scale", 3)), cloud.scales, rtol=1e-5)
    np.testing.assert_allclose(1 / (1 + np.exp(-columns["opacity"])), cloud.opacities, rtol=1e-5)
    np.testing.assert_allclose(stacked(columns, "rot", 4), cloud.quats_wxyz, atol=1e-6)
    np.testing.assert_allclose(stacked(columns, "f_dc", 3), cloud.harmonics[:, 0], atol=1e-6)
    if degree:
        rest = stacked(columns, "f_rest", 45).reshape(60, 3, 15).transpose(0, 2, 1)
        np.testing.assert_allclose(rest, cloud.harmonics[:, 1:], atol=1e-6)


def test_spz(tmp_path):
    """Version 2 turns SPZ's axes (y up, z backwards) to those of the scene, version 3 takes the numbers as they are."""
    cloud = random_cloud(60)
    write_splats(tmp_path / "a.spz", cloud, "spz")
    columns = read_back(tmp_path / "a.spz", 3)
    turn = np.eye(3) if np.sign(columns["z"][0]) == np.sign(cloud.means[0, 2]) else np.diag([1.0, -1.0, -1.0])
    np.testing.assert_allclose(np.stack([columns[axis] for axis in "xyz"], axis=1), cloud.means @ turn, atol=2e-4)
    np.testing.assert_allclose(stacked(columns, "scale", 3), cloud.log_scales, atol=0.04)
    np.testing.assert_allclose(1 / (1 + np.exp(-columns["opacity"])), cloud.opacities, atol=0.003)
    quats = stacked(columns, "rot", 4).astype(np.float32)
    found = covariances(type(cloud)(cloud.means, quats, cloud.scales, cloud.opacities, cloud.harmonics))
    np.testing.assert_allclose(found, turn @ covariances(cloud) @ turn, atol=0.01 * cloud.scales.max() ** 2)


def test_glb_has_what_the_program_writes(tmp_path):
    """It writes GLB and does not read it: the same attributes of the same Gaussians, but for its turn about z."""
    cloud = random_cloud(60)
    write_splats(tmp_path / "a.ply", cloud, "ply")
    write_splats(tmp_path / "ours.glb", cloud, "glb")
    transform(tmp_path / "a.ply", tmp_path / "theirs.glb")
    _, ours, extension = read_glb(tmp_path / "ours.glb")
    _, theirs, their_extension = read_glb(tmp_path / "theirs.glb")
    assert ours.keys() == theirs.keys()
    assert extension.items() <= their_extension.items()
    np.testing.assert_allclose(theirs["POSITION"], ours["POSITION"] * [-1, -1, 1], rtol=1e-5)
    for name in ("SCALE", "OPACITY", "SH_DEGREE_0_COEF_0"):
        own = ours[f"KHR_gaussian_splatting:{name}"]
        np.testing.assert_allclose(theirs[f"KHR_gaussian_splatting:{name}"], own, rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_supersplat_draws_the_gaussians_where_and_as_they_are(browser, tmp_path):
    """Red to the right of the optical axis, green below, blue straight ahead; seen along z from the origin."""
    places = np.array([[3.0, 0.0, 10.0], [0.0, 3.0, 10.0], [0.0, 0.0, 10.0]], np.float32)
    cloud = SplatCloud(
        means=places,
        quats_wxyz=np.array([[1.0, 0.0, 0.0, 0.0]] * 3, np.float32),
        scales=np.full((3, 3), 0.5, np.float32),
        opacities=np.full(3, 0.99, np.float32),
        harmonics=harmonics_of_colors(np.eye(3, dtype=np.float32)),
    )
    write_splats(tmp_path / "a.ply", cloud, "ply")
    # The viewer turns PLY files by half a turn about z.
    view = {"fov": 90.0, "position": [0.0, 0.0, 0.0], "target": [0.0, 0.0, 10.0], "startAnim": "none"}
    settings = {"camera": view, "background": {"color": [0, 0, 0]}, "animTracks": []}
    (tmp_path / "view.json").write_text(json.dumps(settings))
    transform(tmp_path / "a.ply", "--viewer-settings", tmp_path / "view.json", tmp_path / "a.html")
    browser.open(f"{(tmp_path / 'a.html').as_uri()}?noui&noanim", 400, 400)
    for _ in range(30):
        time.sleep(2.0)
        browser.screenshot(tmp_path / "seen.png")
        seen = read_rgb(tmp_path / "seen.png")
        if seen[195:205, 195:205, 2].mean() > 100:
            break
    assert seen[200, 200].argmax() == 2 and seen[200, 200, 2] > 150
    assert seen[200, 260].argmax() == 0 and seen[200, 260, 0] > 150
    assert seen[260, 200].argmax() == 1 and seen[260, 200, 1] > 150
    assert seen[200, 140].max() < 60 and seen[140, 200].max() < 60
