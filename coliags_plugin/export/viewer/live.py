"""Live view of a run in browsers: its own renderer draws, viser carries cameras here and pictures there."""

from __future__ import annotations

import contextlib
import errno
import io
import logging
import math
import os
import shlex
import socket
import sys
import threading
import time
import warnings
import webbrowser
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8
from typing_extensions import Self

from coliags_plugin.contracts import Follower, GaussianField
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.gaussians import rotation_matrices
from coliags_plugin.core.scenes import Frame
from coliags_plugin.engine.devices import make_current
from coliags_plugin.engine.held_light import flatten
from coliags_plugin.engine.rendering import CameraPath, Keyframe, depth_picture, render_view, sampled_depth_limits
from coliags_plugin.engine.trained import TrainedRun, load_newer
from coliags_plugin.engine.trainer import Trainer
from coliags_plugin.export.viewer.page import look_distance, mesh_files
from coliags_plugin.geometry.meshes.mesh import encode_mesh, read_mesh
from coliags_plugin.reporting.image_files import as_array, eight_bit

logger = logging.getLogger(__name__)

#: File of the camera path, in the run folder.
PATH_FILE = "camera-path.json"
#: Outputs that can be shown, by the names of the pictures.
OUTPUTS = {"colour": "rgb", "depth": "depth_expected", "normals": "normals"}
#: Seconds without a movement after which the camera rests.
REST = 0.2
#: Seconds that a picture may take while the camera moves, and the smallest share of its size that it gets then.
_FLUID, _SMALLEST = 0.1, 0.125
#: Seconds between two looks for a newer checkpoint.
CHECKED = 5.0
#: Widest picture, px, and quality of its JPEG while the camera moves, and at rest.
_WIDEST, _MOVING, _RESTING = 1920, 60, 95
#: Share of the time that drawing may take from training.
_SHARE = 0.2
#: Frusta of cameras: so many at most, and their size as a share of the distance of the wall.
_FRUSTA, _FRUSTUM_SIZE = 40, 0.03


def check_server(host: str, port: int) -> None:
    """Raise InputError where viser is not installed, or cannot listen at an address."""
    try:
        import viser  # noqa: F401
    except ImportError as error:
        raise InputError(
            f"viser cannot be imported ({error})",
            "viser, which draws runs in the browser",
            "Install it with `pip install 'coliags_plugin[viewer]'`",
        ) from error
    if not 0 <= port <= 65535:
        raise InputError(f"`port={port}`", "a number from 0 (any free port) to 65535")
    try:
        socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET).close()
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            message = f"`port={port}` is in use on {host}"
            raise InputError(message, "a free port", f"Pass another, for instance `port={port + 1}`") from error
        expected = "a name or address of this machine, for instance 127.0.0.1, and a port above 1023"
        raise InputError(f"`host={host}` and `port={port}`: {error.strerror or error}", expected) from error


class Viewer(Follower):
    """A run that is served to browsers, until it is closed. Use it as a context manager, or close it.

    A thread draws for all browsers in turn, and takes up newer checkpoints of the run. As a follower of a trainer it
    shows the run as it is after the newest step: pictures are drawn between steps, by the thread that trains, so that
    nothing changes meanwhile, and the run is the same to the bit.

    Args:
        trained: The run.
        host: Name or address to listen on.
        port: 0: any free one.
        threaded: False: there is no thread, and the caller calls :meth:`draw`.
    """

    def __init__(
        self, trained: TrainedRun, host: str = "127.0.0.1", port: int = 8080, *, threaded: bool = True
    ) -> None:
        self.trained, self._host = trained, host
        self._sessions: dict[int, Session] = {}
        self._wake, self._closed, self._due = threading.Event(), False, 0.0
        check_server(host, port)
        import viser

        # A browser may leave while something is computed for it.
        warnings.filterwarnings("ignore", message="Queued a .* on a closed connection", category=UserWarning)
        logging.getLogger("websockets").setLevel(logging.WARNING)  # else it reports each start and end of a server
        with contextlib.redirect_stdout(io.StringIO()):
            self._server = viser.ViserServer(host=host, port=port, verbose=False)
        self._thread = threading.Thread(target=self._run, name="view", daemon=True)
        self._set_start()
        self._server.on_client_connect(self._connected)
        self._server.on_client_disconnect(lambda client: self._sessions.pop(client.client_id, None))
        if threaded:
            self._thread.start()

    @classmethod
    def of_training(cls, trainer: Trainer, port: int) -> Self:
        """A view of a run that is trained, a follower of its trainer."""
        method, provenance, scale = trainer.method, trainer.provenance(), trainer.scene.provenance.training_scale
        scene, model = trainer.scene.scaled(1.0 / scale), trainer.model.with_field(trainer.model.field, scale)
        trained = TrainedRun(
            trainer.run, method.config, method.name, scene, model, trainer.step, trainer.device,
            trainer.seed, provenance,
        )  # fmt: skip
        return cls(trained, port=port, threaded=False)

    @property
    def port(self) -> int:
        """Port of the server."""
        return int(self._server.get_port())

    @property
    def url(self) -> str:
        """Address for a browser on this machine."""
        return f"http://{'localhost' if self._host in ('0.0.0.0', '::', '') else self._host}:{self.port}"

    @property
    def sessions(self) -> list[Session]:
        """Sessions of the browsers that are connected."""
        return list(self._sessions.values())

    @cached_property
    def distance(self) -> float:
        """Distance of the wall in the first view, scene units: what the browser's camera turns about."""
        scene = self.trained.scene
        return look_distance(scene, scene.train[0].camera, scene.points.positions)

    @cached_property
    def flattened(self) -> TrainedRun:
        """The run in the same light everywhere."""
        return flatten(self.trained)

    @cached_property
    def depth_limits(self) -> tuple[float, float]:
        """Depths of the first and the last colour, the same for the whole video."""
        return sampled_depth_limits(self.trained, self.trained.scene.video, OUTPUTS["depth"])

    def picture(self, camera: Camera, kind: str, light: str = "") -> UInt8[np.ndarray, "H W 3"]:
        """A kind of :data:`OUTPUTS` of a view by the run's renderer; ``light``: ``flattened``, or the run's own."""
        trained = self.flattened if light == "flattened" else self.trained
        output = render_view(trained, camera, tuple(dict.fromkeys(("rgb", "alpha", OUTPUTS[kind]))))
        if kind == "depth":
            return depth_picture(output, OUTPUTS[kind], self.depth_limits)
        if kind == "normals":  # y up, z towards the camera, as is usual for pictures of normals
            towards = output[OUTPUTS[kind]] * torch.tensor([1.0, -1.0, -1.0]).to(output.rgb)
            return as_array(eight_bit(0.5 + 0.5 * towards))
        return as_array(eight_bit(output.rgb))

    def wake(self) -> None:
        """Let the thread draw what is due."""
        self._wake.set()

    def draw(self) -> float:
        """Draw what is due, one picture for each browser. Returns seconds until more is."""
        return min([session.draw() for session in self.sessions], default=CHECKED)

    def show(self, trained: TrainedRun) -> None:
        """Show another state of the run from now on."""
        if trained.model is not self.trained.model:
            self.__dict__.pop("flattened", None)
        self.trained = trained
        for session in self.sessions:
            session.model_changed()

    def stepped(self, step: int) -> None:
        """Bring browsers up to date after a training step, where it is time to."""
        began = time.monotonic()
        if began < self._due:
            return
        self.show(replace(self.trained, step=step))
        self.draw()
        now = time.monotonic()
        self._due = now + (now - began) * (1.0 / _SHARE - 1.0)

    def wait(self) -> None:
        """Wait until the process is interrupted."""
        threading.Event().wait()

    def open(self) -> bool:
        """Open a browser on this machine; False where there is no display, or none could be opened."""
        if sys.platform in ("darwin", "win32"):
            has_display = "SSH_CONNECTION" not in os.environ
        else:
            has_display = bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
        return has_display and webbrowser.open(self.url)

    def close(self) -> None:
        """Stop serving, once what is being drawn is done: threads that end later crash the process."""
        self._closed = True
        self.wake()
        if self._thread.is_alive():
            self._thread.join()
        with contextlib.redirect_stdout(io.StringIO()):  # it prints that it stops
            self._server.stop()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _set_start(self) -> None:
        """Let browsers start at the first training camera, upright, before black, with a plain panel and one light."""
        server, camera = self._server, self.trained.scene.train[0].camera
        axes, position = as_array(camera.camera_to_world.double())[:3, :3], as_array(camera.center.double())
        server.scene.set_up_direction(tuple(-axes[:, 1]))
        start = server.initial_camera
        start.position, start.up, start.look_at = position, -axes[:, 1], position + self.distance * axes[:, 2]
        start.fov, start.far = _fov(camera), 1e3 * self.distance
        start.near = min(camera.near_plane, 0.02 * self.distance)
        server.scene.configure_default_lights(enabled=False)
        server.scene.configure_environment_map(hdri=None)
        server.scene.add_light_ambient("/light", intensity=3.0)
        server.gui.set_panel_label(f"{self.trained.scene.name} ({self.trained.method})")
        server.gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)

    def _connected(self, client: Any) -> None:
        self._sessions[client.client_id] = Session(client, self)
        if client.client_id not in self._server.get_clients():  # it has left in the meantime
            self._sessions.pop(client.client_id, None)
        self.wake()

    def _run(self) -> None:
        make_current(self.trained.device)
        due = time.monotonic() + CHECKED
        while not self._closed:
            wait = self.draw()
            if time.monotonic() >= due:
                try:
                    newer = load_newer(self.trained)
                except InputError:  # replaced while it was read, or of another run: there is a next time
                    newer = None
                if newer is not None:
                    self.show(newer)
                due = time.monotonic() + CHECKED
            elif wait > 0.0 and not self._closed:
                self._wake.wait(min(wait, CHECKED))
                self._wake.clear()


class Session:
    """One browser: its panel, and the picture behind its scene, small while the camera moves, and in full at rest.

    Callbacks only note what is to be drawn; :meth:`draw` draws it.
    """

    def __init__(self, client: Any, viewer: Viewer) -> None:
        self._client, self._viewer = client, viewer
        self._moved, self._small_due, self._full_due = 0.0, False, True
        self._share = 0.5
        self._frusta: list[Any] = []
        self._mesh: Any = None
        self.keyframes: list[Keyframe] = []
        self._add_controls(client.gui, viewer.trained)
        self.model_changed()
        client.camera.on_update(lambda _: self.camera_moved())

    def _add_controls(self, gui: Any, trained: TrainedRun) -> None:
        has_gaussians = isinstance(trained.model.field, GaussianField)
        self._meshes = mesh_files(trained.run.path)
        self._about = gui.add_markdown("")
        kinds = [kind for kind, output in OUTPUTS.items() if output == "rgb" or output in trained.model.outputs]
        self.kind = gui.add_dropdown("Show", [*kinds, *self._meshes])
        self.kind.on_update(lambda _: self.redraw())
        lights = ("follows the camera", "flattened") if trained.model.field.knows_lamp else ("recorded",)
        self.light = gui.add_dropdown("Light", lights, visible=len(lights) > 1)
        self.light.on_update(lambda _: self.redraw())
        # A radiance field takes long for each pixel.
        width = _WIDEST if has_gaussians else min(_WIDEST, trained.scene.train[0].camera.width)
        self.width = gui.add_slider("Most pixels across", 16, _WIDEST, 1, max(16, width))
        self.width.on_update(lambda _: self.redraw())
        frames = trained.scene.video
        with gui.add_folder("Frames of the video"):
            self.frame = gui.add_slider("Frame", 0, max(1, len(frames) - 1), 1, 0)
            self.frame.on_update(lambda _: self.go_to(frames[min(int(self.frame.value), len(frames) - 1)]))
            self._recorded = gui.add_image(as_array(frames[0].image), label=self._label_of(frames[0]))
            cameras = gui.add_checkbox("Cameras", False)
            cameras.on_update(lambda _: self._show_cameras(cameras.value))
        with gui.add_folder("Camera path"):
            add, remove = gui.add_button("Add keyframe"), gui.add_button("Remove the last")
            add.on_click(lambda _: self.change_path([*self.keyframes, Keyframe.of(self.camera())]))
            remove.on_click(lambda _: self.change_path(self.keyframes[:-1]))
            self._seconds = gui.add_slider("Seconds between", 0.5, 10.0, 0.5, 2.0)
            gui.add_button("Save").on_click(lambda _: self.save_path())
            self.path_line = gui.add_markdown("No keyframes yet.")
        self.status = gui.add_markdown("")

    def camera_moved(self) -> None:
        """Note that the camera of the browser has moved."""
        self._moved, self._small_due, self._full_due = time.monotonic(), True, True
        self._viewer.wake()

    def redraw(self) -> None:
        """Note that the picture is to be drawn again from the same camera."""
        self._full_due = True
        self._viewer.wake()

    def model_changed(self) -> None:
        """Tell the step of the run, and draw the picture again."""
        scene, step = self._viewer.trained.scene, self._viewer.trained.step
        self._about.content = (
            f"Step {step}; {len(scene.video)} frames, {len(scene.video) - len(scene.train)} held out; lengths in "
            f"{scene.length_unit}"
        )
        self.redraw()

    def draw(self) -> float:
        """Draw the picture that is due, if one is. Returns seconds until another is."""
        rest = self._moved + REST - time.monotonic()
        moves = rest > 0.0
        if not (self._small_due if moves else self._full_due):
            return rest if moves else CHECKED
        self._small_due, self._full_due = False, moves
        try:
            self._draw(self._share if moves else 1.0)
        except Exception:
            logger.exception("the view could not be drawn")
            self.status.content = "The last picture failed; see the terminal."
        return 0.0

    def _draw(self, share: float) -> None:
        kind, scene = str(self.kind.value), self._client.scene
        if kind in self._meshes:
            if self._mesh is None or self._mesh.name != f"/{kind}":
                self._mesh = scene.add_glb(f"/{kind}", encode_mesh(read_mesh(self._meshes[kind])))
                scene.set_background_image(np.zeros((1, 1, 3), np.uint8), format="png")
            return
        if self._mesh is not None:
            self._mesh.remove()
            self._mesh = None
        began = time.perf_counter()
        camera = self.camera(share)
        image = self._viewer.picture(camera, kind, str(self.light.value))
        took = time.perf_counter() - began
        scene.set_background_image(image, format="jpeg", jpeg_quality=_RESTING if share == 1.0 else _MOVING)
        self._client.flush()
        if share < 1.0 or took < _FLUID:
            self._share = min(1.0, max(_SMALLEST, share * min(2.0, 0.8 * math.sqrt(_FLUID / took))))
        self.status.content = f"{camera.width} x {camera.height} pixels in {took:.2f} s"

    def camera(self, share: float = 1.0) -> Camera:
        """The browser's camera, with a share of the pixels of its picture along each side."""
        theirs = self._client.camera
        full = min(theirs.image_width, int(self.width.value)) or 64
        width = max(16, round(share * full))
        height = max(8, round(width * theirs.image_height / max(theirs.image_width, 1)))
        focal, pose = 0.5 * height / math.tan(0.5 * theirs.fov), torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = rotation_matrices(torch.as_tensor(theirs.wxyz, dtype=torch.float64)[None])[0]
        pose[:3, 3] = torch.as_tensor(theirs.position, dtype=torch.float64)
        near = self._viewer.trained.scene.train[0].camera.near_plane
        return Camera(focal, focal, 0.5 * width, 0.5 * height, width, height, pose.float(), near)

    def go_to(self, frame: Frame) -> None:
        """Show a frame of the video, and move the browser's camera there."""
        self._recorded.image, self._recorded.label = as_array(frame.image), self._label_of(frame)
        pose = as_array(frame.camera.camera_to_world.double())
        theirs, axes, position = self._client.camera, pose[:3, :3], pose[:3, 3]
        with self._client.atomic():
            theirs.up_direction, theirs.position = -axes[:, 1], position
            theirs.look_at, theirs.fov = position + self._viewer.distance * axes[:, 2], _fov(frame.camera)
        self.camera_moved()

    def _label_of(self, frame: Frame) -> str:
        held_out = frame.name not in self._viewer.trained.training_frames
        return f"recorded {frame.name}{', held out' if held_out else ''}"

    def _show_cameras(self, visible: bool) -> None:
        from viser.transforms import SO3

        frames = self._viewer.trained.scene.video
        for index in range(0, 0 if self._frusta else len(frames), -(-len(frames) // _FRUSTA)):
            camera, pose = frames[index].camera, as_array(frames[index].camera.camera_to_world.double())
            frustum = self._client.scene.add_camera_frustum(
                f"/cameras/{frames[index].name}",
                fov=_fov(camera),
                aspect=camera.width / camera.fx * camera.fy / camera.height,
                scale=_FRUSTUM_SIZE * self._viewer.distance,
                color=(30, 120, 200),
                wxyz=SO3.from_matrix(pose[:3, :3]).wxyz,
                position=pose[:3, 3],
            )
            frustum.on_click(lambda _, index=index: setattr(self.frame, "value", index))
            self._frusta.append(frustum)
        for frustum in self._frusta:
            frustum.visible = visible

    def change_path(self, keyframes: list[Keyframe]) -> None:
        """Take other keyframes for the camera path."""
        self.keyframes = keyframes
        self.path_line.content = f"Keyframes: {len(keyframes)}, not saved."

    def save_path(self) -> None:
        """Write the path beside what else the run has; an earlier one is replaced."""
        run = self._viewer.trained.run.path
        if len(self.keyframes) < 2:
            self.path_line.content = "A path needs two keyframes or more."
            return
        try:
            CameraPath(keyframes=tuple(self.keyframes), seconds=float(self._seconds.value)).write(run / PATH_FILE)
        except InputError as error:
            self.path_line.content = str(error)
            return
        command = shlex.join(["coliags", "render", str(run), "--path", str(run / PATH_FILE)])
        self.path_line.content = f"Saved. Its video: `{command}`"


def _fov(camera: Camera) -> float:
    """Vertical field of view, radians; the browser's camera has its principal point in the middle."""
    return 2.0 * math.atan(0.5 * camera.height / camera.fy)
