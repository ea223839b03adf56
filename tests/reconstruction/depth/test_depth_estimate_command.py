"""``coliags depth estimate`` as a user meets it: a textured tube with closed-form depth."""

from __future__ import annotations

import json

import numpy as np
import pytest

from coliags_plugin.core.images import write_image
from coliags_plugin.engine.data_formats import open_scene
from tests import commands
from tests.commands import run
from tests.textured_tube import depth_along, tube_frames, write_tube

COUNT = 9
SMALL = ("--set", "width=80", "--set", "height=64", "--jobs", 2)


@pytest.fixture(scope="module")
def tube(tmp_path_factory):
    return write_tube(tmp_path_factory.mktemp("tubes") / "tube", COUNT)


def all_frames(scene):
    return sorted([*scene.train, *scene.test_sets.get("test", ())], key=lambda frame: frame.index)


def errors(scene):
    """Relative errors of depth at all pixels of all frames."""
    found = []
    for frame in all_frames(scene):
        camera = frame.camera
        truth = depth_along(camera.center.double().numpy(), camera.rays().double().numpy())
        found.append(np.abs(frame.depth.numpy() / truth - 1.0).ravel())
    return np.concatenate(found)


def test_a_tube(tube, tmp_path, capsys):
    out = tmp_path / "out"
    assert run("depth", "estimate", tube, "--out", out, *SMALL) == 0
    summary, place, command = capsys.readouterr().out.splitlines()
    assert summary.startswith(f"{COUNT} frames, depth ")
    assert place == str(out)
    assert command == f"coliags train coliags --data {out}"
    assert not [path for path in tmp_path.iterdir() if path != out]
    scene, source = open_scene(out), open_scene(tube, options=["width=80", "height=64"])
    assert [frame.name for frame in all_frames(scene)] == [frame.name for frame in all_frames(source)]
    for one, other in zip(all_frames(scene), all_frames(source), strict=True):
        np.testing.assert_array_equal(one.image, other.image)
        np.testing.assert_allclose(one.camera.camera_to_world, other.camera.camera_to_world, atol=1e-6)
        np.testing.assert_allclose(one.camera.intrinsics_matrix, other.camera.intrinsics_matrix, atol=1e-4)
    off = errors(scene)
    assert np.isfinite(off).all()
    assert np.median(off) < 0.015
    assert np.percentile(off, 90) < 0.06
    content = json.loads((out / "transforms.json").read_text())
    assert all((out / frame["confidence_file_path"]).is_file() for frame in content["frames"])
    assert (out / "unit.txt").read_text() == "mm\n"
