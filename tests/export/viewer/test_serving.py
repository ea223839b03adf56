"""Serving a run: its address, the pictures that browsers get, what they change, and runs that are being trained."""

from __future__ import annotations

import json
import math
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

import coliags_plugin as cp
from coliags_plugin.config.yaml_tree import parse_assignments
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import read_rgb
from coliags_plugin.engine.held_light import flatten
from coliags_plugin.engine.rendering import CameraPath, depth_picture, render_view, sampled_depth_limits
from coliags_plugin.export.viewer import live
from coliags_plugin.geometry.meshes.mesh import TriangleMesh, read_mesh, write_mesh
from coliags_plugin.reporting.image_files import as_array, eight_bit
from tests.commands import refused
from tests.comparison.small import until
from tests.engine.test_trainer import EARLY_GROWTH, assert_same, final_state, make_trainer
from tests.scenes import SMALL

pytest.importorskip("viser")

import msgspec
import viser
import zstandard
from viser import transforms
from viser._messages import GuiUpdateMessage, ViewerCameraMessage
from websockets.sync.client import connect

#: viser's, of browsers that leave during an update; the viewer filters it, pytest shows it again.
pytestmark = pytest.mark.filterwarnings("ignore:Queued a .* on a closed connection")


#: Of the window, px.
WIDTH, HEIGHT = 64, 48


class ViserClient:
    """A browser of viser's, as far as its connection goes: it sends a camera and receives messages."""

    def __init__(self, port: int) -> None:
        # Without limits: behind a full queue, the server would wait ten seconds for an answer to its goodbye.
        self._socket = connect(
            f"ws://127.0.0.1:{port}",
            subprotocols=[f"viser-v{viser.__version__}"],
            max_size=None,
            max_queue=None,
            compression=None,
        )
        self.messages: list[dict[str, Any]] = []

    def __enter__(self) -> ViserClient:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def look(self, camera: Camera, distance: float = 10.0) -> None:
        """Say that the browser's camera is here."""
        matrix = camera.camera_to_world.double().numpy()
        position, axis = matrix[:3, 3], matrix[:3, 2]
        self._send(
            ViewerCameraMessage(
                wxyz=tuple(transforms.SO3.from_matrix(matrix[:3, :3]).wxyz),
                position=tuple(position),
                fov=2.0 * math.atan(0.5 * camera.height / camera.fy),
                near=0.01,
                far=1000.0,
                image_height=HEIGHT,
                image_width=WIDTH,
                look_at=tuple(position + distance * axis),
                up_direction=tuple(-matrix[:3, 1]),
            )
        )

    def set(self, label: str, value: Any) -> None:
        """Set the control of a label."""
        uuid = next(message["uuid"] for message in self.messages if (message.get("props") or {}).get("label") == label)
        self._send(GuiUpdateMessage(uuid, {"value": value}))

    def _send(self, message: Any) -> None:
        self._socket.send(msgspec.msgpack.encode(message.as_serializable_dict()))

    def wait_for(self, kind: str, seconds: float = 30.0) -> dict[str, Any]:
        """The next message of a type that has not been waited for."""
        ends = time.monotonic() + seconds
        while True:
            for message in self.messages:
                if message["type"] == kind and not message.get("waited for"):
                    message["waited for"] = True
                    return message
            self.messages += self._received(ends - time.monotonic())

    def picture(self, seconds: float = 30.0) -> np.ndarray:
        """The next picture behind the scene, RGB. [H, W, 3]"""
        while (data := self.wait_for("BackgroundImageMessage", seconds)["rgb_data"]) is None:
            pass  # viser clears the scene of a new browser
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]

    def _received(self, seconds: float) -> list[dict[str, Any]]:
        """Messages of one packet, arrays in their places."""
        data = self._socket.recv(timeout=max(0.0, seconds))
        size, packed = (int.from_bytes(data[at : at + 8], "little") for at in (0, 8))
        packet = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(data[16 : 16 + packed], size))
        buffers, at = [], 16 + packed
        for length in packet["binaryBufferLengths"]:
            at += -at % 8
            buffers.append(data[at : at + length])
            at += length
        return [_filled(message, buffers) for message in packet["messages"]]


def _filled(value: Any, buffers: list[bytes]) -> Any:
    """A message with its arrays."""
    if isinstance(value, dict):
        if "__binary_index" in value:
            return np.frombuffer(buffers[value["__binary_index"]], value["dtype"])
        return {key: _filled(inner, buffers) for key, inner in value.items()}
    return [_filled(inner, buffers) for inner in value] if isinstance(value, (list, tuple)) else value


@pytest.fixture(scope="module")
def viewer(anchors):
    write_mesh(anchors.path / "mesh" / "mesh.ply", TriangleMesh(np.eye(3), np.array([[0, 1, 2]])))
    with anchors.view(port=0) as served:
        yield served


@contextmanager
def connected(viewer, index=0):
    """A browser at a training frame, which has its first picture, and the frame's camera."""
    camera = viewer.trained.scene.train[index].camera
    with ViserClient(viewer.port) as client:
        client.look(camera)
        client.picture()
        yield client, camera


def newest(client, width=WIDTH):
    """The next picture of full size."""
    while (picture := client.picture()).shape[1] != width:
        pass
    return picture


def browsers(camera, width=WIDTH, height=HEIGHT):
    """The browser's camera: square pixels, the principal point in the middle."""
    focal = camera.fy * height / camera.height
    pose = camera.camera_to_world.float()
    return Camera(focal, focal, width / 2, height / 2, width, height, pose, camera.near_plane)


def assert_like(picture, expected):
    """Pictures are equal, as far as JPEG keeps them."""
    assert picture.shape == expected.shape
    assert np.abs(picture.astype(float) - as_array(expected)).mean() < 4.0


def session_of(viewer):
    return until("session", lambda: viewer.sessions)[-1]


def test_a_browser_starts_at_the_first_training_frame(viewer):
    camera = viewer.trained.scene.train[0].camera
    with ViserClient(viewer.port) as client:
        client.look(camera)
        messages = {name: client.wait_for(f"SetCamera{name}Message") for name in ("Position", "LookAt", "Fov")}
    center, axis = as_array(camera.center), as_array(camera.optical_axis)
    np.testing.assert_allclose(messages["Position"]["position"], center, atol=1e-6)
    towards = np.subtract(messages["LookAt"]["look_at"], center)
    np.testing.assert_allclose(towards / np.linalg.norm(towards), axis, atol=1e-6)
    assert np.linalg.norm(towards) == pytest.approx(20.0 - center[2], rel=0.1)  # the wall is at z = 20 mm
    assert messages["Fov"]["fov"] == pytest.approx(2 * np.arctan(0.5 * camera.height / camera.fy))


def test_pictures_are_what_the_runs_renderer_draws(viewer):
    trained, depth = viewer.trained, "depth_expected"
    with connected(viewer) as (client, first):
        client.set("Show", "depth")
        output = render_view(trained, browsers(first), ("rgb", "alpha", depth))
        limits = sampled_depth_limits(trained, trained.scene.video, depth)
        assert_like(newest(client), depth_picture(output, depth, limits))
        client.set("Show", "normals")
        normals = as_array(render_view(trained, browsers(first), ("rgb", "alpha", "normals"))["normals"])
        assert_like(newest(client), np.clip(127.5 + 127.5 * normals * (1, -1, -1), 0, 255))
        client.set("Show", "colour")
        newest(client)
        camera = trained.scene.train[-1].camera
        client.look(camera)
        client.picture()  # of the moving camera
        expected = render_view(trained, browsers(camera)).rgb
        assert_like(newest(client), eight_bit(expected))
        client.set("Light", "flattened")
        flat = render_view(flatten(trained), browsers(camera)).rgb
        assert_like(newest(client), eight_bit(flat))
        assert (flat - expected).abs().max() > 0.02


def test_a_moving_camera_gets_small_pictures_and_one_that_rests_the_whole(viewer, monkeypatch):
    monkeypatch.setattr(live, "_FLUID", 1e-9)  # no picture is drawn so fast
    monkeypatch.setattr(live, "_SMALLEST", 0.25)
    with connected(viewer) as (client, _):
        for index in (1, 2):
            client.look(viewer.trained.scene.train[index].camera)
            newest(client)
        client.look(viewer.trained.scene.train[3].camera)
        newest(client, WIDTH // 4)
        assert client.picture().shape == (HEIGHT, WIDTH, 3)
        client.set("Most pixels across", 32)
        assert client.picture().shape == (HEIGHT // 2, WIDTH // 2, 3)


def test_the_slider_moves_the_camera_and_shows_the_frame(viewer):
    frame = viewer.trained.scene.video[5]
    with connected(viewer) as (client, _):
        client.set("Frame", 5)
        while (position := client.wait_for("SetCameraPositionMessage")).get("initial"):
            pass
        np.testing.assert_allclose(position["position"], as_array(frame.camera.center), atol=1e-6)


def test_a_mesh_of_the_run_and_its_cameras_are_sent_when_they_are_wanted(viewer, tmp_path):
    with connected(viewer) as (client, _):
        client.set("Show", "mesh")
        mesh = client.wait_for("GlbMessage")
        assert mesh["name"] == "/mesh"
        (tmp_path / "sent.glb").write_bytes(mesh["props"]["glb_data"])
        np.testing.assert_array_equal(read_mesh(tmp_path / "sent.glb").vertices, np.eye(3))
        assert client.picture().shape == (1, 1, 3)  # black
        client.set("Show", "colour")
        newest(client)
        client.set("Cameras", True)
        frames = viewer.trained.scene.video
        names = {client.wait_for("CameraFrustumMessage")["name"] for _ in frames}
    assert names == {f"/cameras/{frame.name}" for frame in frames}


def test_a_browser_that_leaves_is_forgotten(viewer):
    with connected(viewer):
        assert viewer.sessions
    until("end of the session", lambda: not viewer.sessions)


def test_a_path_that_is_set_in_the_view(viewer):
    run, file = viewer.trained.run.path, viewer.trained.run.path / "camera-path.json"
    with connected(viewer) as (client, camera):
        line = session_of(viewer).path_line
        for button, text in (
            ("Add keyframe", "Keyframes: 1, not saved."),
            ("Save", "A path needs two keyframes or more."),
            ("Add keyframe", "Keyframes: 2, not saved."),
            ("Add keyframe", "Keyframes: 3, not saved."),
            ("Remove the last", "Keyframes: 2, not saved."),
            ("Save", f"Saved. Its video: `coliags render {run} --path {file}`"),
        ):
            assert not file.exists()
            client.set(button, True)
            until(text, lambda text=text: line.content == text)
    path = CameraPath.read(file)
    assert len(path.keyframes) == 2 and json.loads(file.read_text())["seconds"] == 2.0
    np.testing.assert_allclose(path.keyframes[0].camera_to_world, camera.camera_to_world, atol=1e-6)
    file.unlink()


def test_newer_checkpoints_are_taken_up(anchors, wall, tmp_path, monkeypatch):
    monkeypatch.setattr(live, "CHECKED", 0.05)
    shutil.copytree(anchors.path, tmp_path / "run")
    longer = cp.train("coliags", wall, tmp_path / "longer", steps=3, settings=parse_assignments(SMALL))
    with cp.load_run(tmp_path / "run").view(port=0) as viewer, connected(viewer) as (client, camera):
        assert session_of(viewer)._about.content.startswith("Step 2; 9 frames, 2 held out")
        (newer,) = (longer.path / "checkpoints").glob("step-*3")
        shutil.copytree(newer, tmp_path / "copy")
        (tmp_path / "copy").rename(tmp_path / "run" / "checkpoints" / newer.name)
        while not session_of(viewer)._about.content.startswith("Step 3;"):
            client.wait_for("GuiUpdateMessage")
        assert_like(newest(client), eight_bit(render_view(longer.load(), browsers(camera)).rgb))


# While a run is trained


def test_a_browser_sees_what_the_newest_step_has_of_a_run_that_stays_the_same(tmp_path, monkeypatch):
    monkeypatch.setattr(live, "_SHARE", 1.0)
    options = {"steps": 10, "overrides": EARLY_GROWTH}
    alone, watched = make_trainer(tmp_path / "a", **options), make_trainer(tmp_path / "b", **options)
    alone.start()
    alone.train()
    watched.start()
    view = live.Viewer.of_training(watched, port=0)
    camera = watched.scene.train[1].camera
    with ViserClient(view.port) as client:
        client.look(camera)
        session_of(view)
        watched.train(followers=[view])
        assert client.picture().shape[2] == 3
    assert_same(final_state(alone), final_state(watched))
    again = live.Viewer.of_training(watched, port=0)
    with ViserClient(again.port) as client:
        client.look(camera)
        session = session_of(again)
        time.sleep(live.REST)
        again.stepped(7)
        assert_like(newest(client), eight_bit(render_view(again.trained, browsers(camera)).rgb))
        assert session._about.content.startswith("Step 7;")
    again.close()


def test_drawing_takes_a_share_of_the_time(tmp_path, monkeypatch):
    trainer = make_trainer(tmp_path / "run")
    trainer.start()
    view, now, drawn = live.Viewer.of_training(trainer, port=0), [0.0], []

    def draw():
        drawn.append(view.trained.step)
        now[0] += 2.0

    monkeypatch.setattr(live.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(view, "draw", draw)
    for step in range(1, 31):
        now[0] += 1.0
        view.stepped(step)
    monkeypatch.undo()
    view.close()
    assert drawn == [1, 9, 17, 25]  # 2 s of drawing, then 8 s of training


# Addresses


def test_an_address_that_is_in_use_or_not_possible_is_one_clear_error(anchors, wall, tmp_path, capsys):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        message = f"`port={port}` is in use.*`port={port + 1}`"
        with pytest.raises(InputError, match=message):
            anchors.view(port=port)
        assert f"--port {port} is in use" in refused(capsys, "view", anchors.path, "--port", port, "--no-open")
        with pytest.raises(InputError, match=message):
            cp.train("coliags", wall, tmp_path / "run", steps=1, view_port=port)
    assert not (tmp_path / "run").exists()
    for address, message in (
        ({"port": 70000}, "`port=70000`"),
        ({"host": "no.such.host.invalid", "port": 0}, "`host="),
    ):
        with pytest.raises(InputError, match=message):
            anchors.view(**address)


def test_without_viser_it_is_said_how_to_install_it(anchors, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(InputError, match=r"pip install 'coliags_plugin\[viewer\]'"):
        anchors.view(port=0)


def test_no_browser_is_opened_without_a_display(viewer, monkeypatch):
    monkeypatch.setattr(live.sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    opened = []
    monkeypatch.setattr(live.webbrowser, "open", lambda url: opened.append(url) or True)
    assert viewer.open() is False and opened == []
    monkeypatch.setenv("DISPLAY", ":0")
    assert viewer.open() is True and opened == [viewer.url]


@pytest.mark.thorough
def test_ctrl_c_ends_the_command_cleanly(anchors, request):
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job ignores it
    request.addfinalizer(lambda: signal.signal(signal.SIGINT, before))
    command = [sys.executable, "-c", "from coliags_plugin.cli import main; main()", "view", str(anchors.path)]
    process = subprocess.Popen(
        [*command, "--port", "0", "--no-open"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    line = process.stdout.readline()
    with urllib.request.urlopen(line.split()[0], timeout=20) as answer:
        assert answer.status == 200
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0
    assert out == "ended\n" and "Traceback" not in err and "server" not in err


@pytest.mark.thorough
@pytest.mark.parametrize("method", [("2dgs",), ("reim-nerf-small", "field.width=8")])
def test_surfels_and_radiance_fields_are_drawn_too(run_of, method):
    run = run_of(*method)
    with run.view(port=0) as viewer, connected(viewer) as (client, camera):
        client.set("Most pixels across", 64)
        client.look(replace(camera))
        assert_like(newest(client), eight_bit(render_view(viewer.trained, browsers(camera)).rgb))


@pytest.mark.thorough
def test_chromium_shows_the_run_from_the_first_frame_on_and_the_slider_moves_the_view(browser, anchors, tmp_path):
    free = (slice(220, 400), slice(20, 460))  # neither the panel nor a notice is there

    def apart(expected):
        browser.screenshot(tmp_path / "seen.png")
        return np.abs(read_rgb(tmp_path / "seen.png")[free].astype(float) - expected[free]).mean()

    with anchors.view(port=0) as viewer:
        browser.open(viewer.url, 900, 420)
        session = session_of(viewer)
        until("picture", lambda: apart(viewer.picture(session.camera(), "colour")) < 4.0)
        before = np.array(session._client.camera.position)
        browser.run("document.querySelector('[role=slider][aria-valuemax=\"8\"]').focus()")
        browser.key("End", 35)
        last = viewer.trained.scene.video[-1].camera.center.numpy()
        until("move", lambda: np.abs(session._client.camera.position - last).max() < 1e-3)
        assert session.frame.value == len(viewer.trained.scene.video) - 1
        assert not np.allclose(before, last)
        assert all(url.startswith((viewer.url, "blob:")) for url in browser.requests())
