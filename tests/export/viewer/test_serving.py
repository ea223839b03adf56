"""Serving a run: its address, what browsers are told, and what they change."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
import time
import urllib.request
from contextlib import contextmanager

import numpy as np
import pytest

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError
from coliags_plugin.export.viewer import serving
from coliags_plugin.export.viewer.splats import in_view, shown, widened
from coliags_plugin.geometry.meshes.files import read_mesh, write_mesh
from coliags_plugin.geometry.meshes.mesh import TriangleMesh
from coliags_plugin.outputs.image_files import as_array
from tests.commands import refused

pytest.importorskip("viser")

from tests.export.viewer.viser_client import HEIGHT, WIDTH, ViserClient, splats_of

#: viser's, of browsers that leave during an update; the viewer filters it, pytest shows it again.
pytestmark = pytest.mark.filterwarnings("ignore:Queued a .* on a closed connection")


@pytest.fixture(scope="module")
def viewer(anchors):
    write_mesh(anchors.path / "mesh" / "mesh.ply", TriangleMesh(np.eye(3), np.array([[0, 1, 2]])))
    with anchors.view(port=0) as one:
        yield one


@contextmanager
def connected(viewer, index=0):
    """A browser at a training frame, and its session."""
    camera = viewer.content.trained.scene.train[index].camera
    with ViserClient(viewer.port) as client:
        client.look(camera)
        yield client, camera


def newest(client, seconds=30.0):
    """Splats of the next update."""
    while True:
        updates = client.wait_for("SceneNodeUpdateMessage", seconds)["updates"]
        if "buffer" in updates:
            return splats_of(updates["buffer"])


def test_the_page_is_served_on_the_port(viewer):
    assert viewer.url == f"http://127.0.0.1:{viewer.port}"
    with urllib.request.urlopen(viewer.url, timeout=10) as answer:
        assert answer.status == 200 and b"<title>" in answer.read()


def test_a_browser_starts_at_the_first_training_frame(viewer):
    with connected(viewer) as (client, camera):
        said = {
            name: client.wait_for(f"SetCamera{name}Message") for name in ("Position", "LookAt", "UpDirection", "Fov")
        }
    center, axis = as_array(camera.center), as_array(camera.optical_axis)
    np.testing.assert_allclose(said["Position"]["position"], center, atol=1e-6)
    towards = np.subtract(said["LookAt"]["look_at"], center)
    np.testing.assert_allclose(towards / np.linalg.norm(towards), axis, atol=1e-6)
    assert np.linalg.norm(towards) == pytest.approx(20.0 - center[2], rel=0.1)  # the wall is at z = 20 mm
    assert said["Fov"]["fov"] == pytest.approx(2 * np.arctan(0.5 * camera.height / camera.fy))


def test_splats_come_at_once_and_then_as_seen_from_the_camera(viewer):
    content = viewer.content
    with connected(viewer) as (client, camera):
        first = splats_of(client.wait_for("GaussianSplatsMessage")["props"]["buffer"])
        np.testing.assert_allclose(first["centers"] * content.unit, content.decoder.beside.means, rtol=1e-5)
        second = newest(client)
    seen = shown(content.trained.model.field.gaussians(widened(session_camera(camera))))
    np.testing.assert_allclose(second["centers"][: len(seen)] * content.unit, seen.means, atol=1e-4)
    np.testing.assert_allclose(second["rgba"][: len(seen), :3], 255 * seen.colors, atol=1)
    rest = second["centers"][len(seen) :] * content.unit
    assert not in_view(rest, widened(session_camera(camera))).any()


def session_camera(camera):
    """The browser's camera: square pixels, the principal point in the middle."""
    focal = camera.fy * HEIGHT / camera.height
    return Camera(focal, focal, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT, camera.camera_to_world)


def test_a_moved_camera_is_decoded_for(viewer):
    frames = viewer.content.trained.scene.train
    with connected(viewer) as (client, _):
        before = newest(client)
        client.look(frames[-1].camera)
        after = newest(client)
    assert len(after["centers"]) != len(before["centers"]) or (after["rgba"] != before["rgba"]).any()


def test_flattened_light_is_the_exchange_packages(viewer):
    content = viewer.content
    with connected(viewer) as (client, camera):
        newest(client)
        client.set("Light", "flattened")
        drawn = newest(client)
    field, placed = content.trained.model.field, widened(session_camera(camera))
    seen = shown(field.gaussians_in_light(placed, content.flattened))
    np.testing.assert_allclose(drawn["rgba"][: len(seen), :3], 255 * seen.colors, atol=1)
    assert (np.abs(seen.colors - shown(field.gaussians(placed)).colors) > 2 / 255).any()


def test_the_threshold_leaves_out_the_fainter_ones(viewer):
    with connected(viewer) as (client, _):
        every = newest(client)
        client.set("Least opacity", 0.3)
        kept = newest(client)
    opaque = every["rgba"][:, 3] >= round(0.3 * 255)
    assert 0 < len(kept["centers"]) < len(opaque)
    assert abs(len(kept["centers"]) - opaque.sum()) <= 0.02 * len(opaque)


def test_the_slider_moves_the_camera_and_shows_the_frame(viewer):
    frame = viewer.content.frames[5]
    with connected(viewer) as (client, _):
        newest(client)
        client.set("Frame", 5)
        while True:
            position = client.wait_for("SetCameraPositionMessage")
            if not position.get("initial"):
                break
        np.testing.assert_allclose(position["position"], as_array(frame.camera.center), atol=1e-6)


def test_a_mesh_of_the_run_is_sent_when_it_is_wanted(viewer, tmp_path):
    with connected(viewer) as (client, _):
        newest(client)
        client.set("Mesh", True)
        mesh = client.wait_for("GlbMessage")
        assert mesh["name"] == "/mesh"
        sent = tmp_path / "sent.glb"
        sent.write_bytes(mesh["props"]["glb_data"])
        np.testing.assert_array_equal(read_mesh(sent).vertices, np.eye(3))


def test_cameras_come_with_their_pictures(viewer):
    with connected(viewer) as (client, _):
        newest(client)
        client.set("Cameras", True)
        names = {client.wait_for("CameraFrustumMessage")["name"] for _ in viewer.content.frames}
    assert names == {f"/cameras/{frame.name}" for frame in viewer.content.frames}


def test_a_browser_that_leaves_is_forgotten(viewer):
    with connected(viewer) as (client, _):
        newest(client)
        assert viewer.sessions
    for _ in range(100):
        if not viewer.sessions:
            return
        time.sleep(0.1)
    raise AssertionError("the session is still there")


def test_a_port_in_use_is_one_clear_error(anchors, capsys):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(InputError, match=f"--port {port} is in use.*--port {port + 1}"):
            anchors.view(port=port)
        assert f"--port {port} is in use" in refused(capsys, "view", anchors.path, "--port", port, "--no-open")


@pytest.mark.parametrize(
    ("host", "port", "message"), [("127.0.0.1", 70000, "--port 70000"), ("no.such.host.invalid", 0, "--host")]
)
def test_addresses_that_are_not_possible(anchors, host, port, message):
    with pytest.raises(InputError, match=message):
        anchors.view(host=host, port=port)


def test_without_viser_it_is_said_how_to_install_it(anchors, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(InputError, match=r"pip install 'coliags_plugin\[viewer\]'"):
        anchors.view(port=0)


def test_no_browser_is_opened_without_a_display(viewer, monkeypatch):
    monkeypatch.setattr(serving.sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(serving.webbrowser, "open", lambda url: pytest.fail("opened"))
    assert viewer.open() is False
    monkeypatch.setenv("DISPLAY", ":0")
    opened = []
    monkeypatch.setattr(serving.webbrowser, "open", lambda url: opened.append(url) or True)
    assert viewer.open() is True and opened == [viewer.url]


def test_nothing_is_printed(viewer, capsys):
    assert capsys.readouterr().out == ""


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
