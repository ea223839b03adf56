"""Camera paths: through their keyframes, smoothly, from a file and into a video."""

from __future__ import annotations

import itertools
import json
import math

import av
import numpy as np
import pytest
import torch

import coliags_plugin as cp
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.gaussians import rotation_matrices
from coliags_plugin.engine.rendering import CameraPath, Keyframe
from tests.commands import refused, run
from tests.scenes import SETS, write_wall

LIKE = Camera(20.0, 20.0, 15.0, 12.0, 32, 24, torch.eye(4), 0.1)


def keyframe(center, turn_y=0.0, fov=60.0):
    half = 0.5 * math.radians(turn_y)
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = rotation_matrices(torch.tensor([[math.cos(half), 0.0, math.sin(half), 0.0]], dtype=torch.float64))
    matrix[:3, 3] = torch.tensor(center, dtype=torch.float64)
    return Keyframe(camera_to_world=tuple(map(tuple, matrix.tolist())), vertical_fov_degrees=fov)


PATH = CameraPath(
    keyframes=(keyframe([0, 0, 0]), keyframe([2, 0, 1], 30.0, 80.0), keyframe([2, 0, 5], 90.0, 50.0)), seconds=1.5
)


def test_it_passes_its_keyframes_at_equal_times():
    cameras = list(PATH.cameras(LIKE, fps=10.0))
    assert len(cameras) == 31  # 3 s, both ends included
    for place, frame in zip((0, 15, 30), PATH.keyframes, strict=True):
        camera = cameras[place]
        np.testing.assert_allclose(camera.camera_to_world, np.array(frame.camera_to_world), atol=1e-6)
        assert 2 * math.degrees(math.atan(0.5 * camera.height / camera.fy)) == pytest.approx(frame.vertical_fov_degrees)
    first = cameras[0]
    assert (first.width, first.height, first.cx, first.cy, first.near_plane) == (32, 24, 16.0, 12.0, 0.1)
    assert Keyframe.of(first).vertical_fov_degrees == pytest.approx(60.0)


def test_places_stay_between_their_keyframes_and_turns_are_smooth():
    cameras = list(PATH.cameras(LIKE, fps=100.0))
    centers = np.array([camera.center.numpy() for camera in cameras])
    assert centers[:151, 0].min() >= 0.0 and centers.max(axis=0) == pytest.approx([2.0, 0.0, 5.0])
    turns = np.array([camera.camera_to_world[:3, :3].double().numpy() for camera in cameras])
    np.testing.assert_allclose(turns @ turns.transpose(0, 2, 1), np.broadcast_to(np.eye(3), turns.shape), atol=1e-5)
    steps = np.array([np.degrees(np.arccos((np.trace(a.T @ b) - 1) / 2)) for a, b in itertools.pairwise(turns)])
    assert np.abs(np.diff(steps)).max() < 0.05  # degrees; a turn at constant speed in each part would jump by 0.2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda path: path.pop("keyframes"), "keyframes: is missing"),
        (lambda path: path["keyframes"].pop(), "at least 2 items"),
        (lambda path: path.update(seconds=0), "seconds: Input should be greater than 0"),
        (lambda path: path.update(fps=30), "unknown key 'fps'"),
        (lambda path: path["keyframes"][0].update(vertical_fov_degrees=180), "less than 180"),
        (lambda path: path["keyframes"][0]["camera_to_world"][0].__setitem__(0, 2.0), "not a rotation"),
        (lambda path: path["keyframes"][0]["camera_to_world"].pop(), "not a rotation"),
    ],
)
def test_a_file_is_read_as_it_was_written_and_what_is_no_path_is_refused(tmp_path, change, message):
    file = tmp_path / "path.json"
    PATH.write(file)
    assert CameraPath.read(file) == PATH
    values = json.loads(file.read_text())
    values["keyframes"].pop()
    change(values)
    file.write_text(json.dumps(values))
    with pytest.raises(InputError, match=message):
        CameraPath.read(file)


def test_the_video_of_a_path(tmp_path, capsys):
    wall = write_wall(tmp_path / "wall")
    assert run("train", "coliags", "--data", wall, "--output", tmp_path / "run", "--steps", 2, *SETS) == 0
    start, end = (frame.camera for frame in cp.load_run(tmp_path / "run").load().scene.train[:2])
    CameraPath(keyframes=(Keyframe.of(start), Keyframe.of(end)), seconds=0.5).write(tmp_path / "path.json")
    assert run("render", tmp_path / "run", "--path", tmp_path / "path.json", "--fps", 10) == 0
    names = {file.name for file in (tmp_path / "run/path").iterdir()}
    assert names == {"path.mp4", "depth_scale.png"}
    with av.open(str(tmp_path / "run/path/path.mp4")) as video:
        assert (video.streams.video[0].frames, video.streams.video[0].width) == (6, 2 * start.width)
    capsys.readouterr()
    (tmp_path / "path.json").write_text("{")
    assert "camera path" in refused(capsys, "render", tmp_path / "run", "--path", tmp_path / "path.json", "-o", "x")
