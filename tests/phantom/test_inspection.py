"""The path that inspects: how near it comes to the wall, what it looks at, how smooth it is, and the gain it causes."""

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
from coliags_plugin.phantom import trajectory
from coliags_plugin.phantom.colon import build_surface, grow_anatomy
from coliags_plugin.phantom.generate import generate
from coliags_plugin.phantom.settings import PRESETS, PhantomSettings
from coliags_plugin.phantom.tracing import Tracer
from coliags_plugin.phantom.trajectory import APPROACHES, NEAREST, camera_path

#: The far stops fall on frames 0, 40, 80, 120, and the near ones on 20, 60, 100.
FRAMES = 121
COARSE = {"trajectory": "inspection", "mesh_spacing": 1.6, "frames": FRAMES}
FAR, NEAR = [0, 40, 80, 120], [20, 60, 100]


def path_of(colon: SimpleNamespace, **changes) -> np.ndarray:
    return camera_path(colon.centre_line, colon.settings.model_copy(update=changes), colon.tracer)


@pytest.fixture(scope="module", params=[1, 4])
def colon(request):
    """A colon, and the paths through it by preset."""
    chosen = PhantomSettings(**COARSE, seed=request.param)
    anatomy = grow_anatomy(chosen)
    tracer = build_surface(anatomy, chosen).tracer
    colon = SimpleNamespace(settings=chosen, centre_line=anatomy.centre_line, tracer=tracer)
    colon.paths = {light: path_of(colon, light=light) for light in PRESETS}
    return colon


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
def test_it_comes_close_to_the_wall_again_and_again_and_looks_at_what_is_close(colon, light):
    poses, tracer = colon.paths[light], colon.tracer
    clearance = tracer.clearance(poses[:, :3, 3])
    _, frames = colon.centre_line.at(np.linspace(76.0, 26.0, 2 * APPROACHES + 1)[1::2])
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


def test_it_is_smooth(colon):
    for light, poses in colon.paths.items():
        centers, rotations = poses[:, :3, 3], poses[:, :3, :3]
        np.testing.assert_allclose(
            rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (FRAMES, 1, 1)), atol=1e-9
        )
        assert np.linalg.norm(np.diff(centers, axis=0), axis=1).max() < 3.0
        assert np.linalg.norm(np.diff(centers, n=2, axis=0), axis=1).max() < 0.5
        assert turns(poses).max() < 11.0
        assert np.degrees(np.linalg.norm(np.diff(rotations[:, :, 2], n=2, axis=0), axis=1)).max() < 1.8
        # Frames are samples of one curve without jumps: with twice as many, steps are half as long.
        finer = path_of(colon, light=light, frames=2 * FRAMES - 1)
        np.testing.assert_allclose(finer[::2], poses, atol=1e-9)
        for of in (lambda path: np.linalg.norm(np.diff(path[:, :3, 3], axis=0), axis=1), turns):
            assert of(finer).max() == pytest.approx(0.5 * of(poses).max(), rel=0.03)


def test_a_colon_without_such_a_path_is_an_error(colon, monkeypatch):
    monkeypatch.setattr(trajectory, "_SPOT_WITHIN", 1.0)
    monkeypatch.setattr(trajectory, "_DRAWS", 3)
    with pytest.raises(InputError, match=f"seed {colon.settings.seed} .*no path") as refused:
        path_of(colon)
    assert "another seed" in str(refused.value)


@pytest.mark.thorough
def test_automatic_gain_swings_up_to_its_span_and_most_of_the_rotated_views_is_seen(tmp_path):
    small = {"width": 48, "height": 38, "rotation_views": 6, "texture_spacing": 0.4, "supersampling": 1}
    options = {**COARSE, **small, "seed": 3, "frames": 60, "interreflection": 0.0}
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
