"""One browser that looks at a run: what it shows follows its camera and controls."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from typing import Any

import torch

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.rotations import rotation_matrices
from coliags_plugin.engine.devices import make_current
from coliags_plugin.export.splats.cloud import SplatCloud
from coliags_plugin.export.viewer.content import ViewerContent, vertical_fov
from coliags_plugin.export.viewer.controls import FLATTENED, Controls
from coliags_plugin.export.viewer.layers import add_headlight, pose
from coliags_plugin.export.viewer.splats import BYTES_PER_SPLAT, on_wire

logger = logging.getLogger(__name__)

#: Seconds without a movement after which the camera rests.
REST = 0.2
#: Seconds between two decodings, at least.
EVERY = 0.5


class Pace:
    """Decides when work wanted by a moving camera is due: once it rests, and not too often. Thread-safe; seconds."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._wanted_from: float | None = None
        self._ended = -float("inf")

    def moved(self) -> None:
        """The camera has moved: the work is wanted, once it rests."""
        with self._lock:
            self._wanted_from = self._clock() + REST

    def want(self) -> None:
        """The work is wanted without a movement, as after a change of options."""
        with self._lock:
            if self._wanted_from is None:
                self._wanted_from = self._clock()

    def wait(self) -> float | None:
        """Seconds until the work is due, 0 if it is; None where none is wanted."""
        with self._lock:
            if self._wanted_from is None:
                return None
            return max(0.0, max(self._wanted_from, self._ended + EVERY) - self._clock())

    def begin(self) -> None:
        """The work begins: what is wanted from now on is wanted anew."""
        with self._lock:
            self._wanted_from = None

    def end(self) -> None:
        """The work has ended."""
        with self._lock:
            self._ended = self._clock()


class Session:
    """A browser's splats, controls and pictures, kept up to date by a thread of its own.

    Callbacks only note what has changed; the thread computes it, the newest state only.
    """

    def __init__(self, client: Any, content: ViewerContent) -> None:
        self._client = client
        self._content = content
        self._pace = Pace()
        self._wake = threading.Event()
        self._closed = False
        self._picture_of: tuple[int, str] | None = None
        self._splats: Any = None
        self._headlight = add_headlight(client.scene, tuple(client.camera.position))
        self.controls = Controls(client, content, self.options_changed, self.go_to, self._camera)
        client.camera.on_update(lambda _: self.camera_moved())
        if content.decoder is not None:
            if len(content.decoder.beside):
                self._send(content.decoder.beside, 0.0)
            self._pace.want()

    def camera_moved(self) -> None:
        """The camera of the browser has moved."""
        self._pace.moved()
        self._headlight.position = tuple(self._client.camera.position)
        self._wake.set()

    def options_changed(self) -> None:
        """Light, threshold or kind of picture has changed."""
        self._pace.want()
        self._wake.set()

    def model_changed(self, step: int) -> None:
        """The run has been trained on, up to this step."""
        self.controls.step = step
        self._picture_of = None
        self._pace.want()

    def go_to(self, index: int) -> None:
        """Move the browser's camera to the pose of a frame of the video."""
        camera = self._content.frames[index].camera
        wxyz, position = pose(camera)
        axes = camera.camera_to_world[:3, :3].double().cpu().numpy()
        theirs = self._client.camera
        with self._client.atomic():
            theirs.up_direction = -axes[:, 1]
            theirs.position = position
            theirs.look_at = position + self._content.look_distance * axes[:, 2]
            theirs.wxyz = wxyz
            theirs.fov = vertical_fov(camera)
        self.camera_moved()

    def close(self) -> None:
        """The browser has gone."""
        self._closed = True
        self._wake.set()

    def run(self) -> None:
        """Keep the browser up to date until it has gone."""
        make_current(self._content.trained.device)
        while not self._closed:
            wait = self.update()
            if not self._closed:
                self._wake.wait(wait)
                self._wake.clear()

    def update(self) -> float | None:
        """Do what is due. Returns seconds until more is due, 0 where it may be now; None until something changes."""
        try:
            return self._step()
        except Exception:
            if not self._closed:
                logger.exception("the view could not be brought up to date")
                self.controls.status = "The last update failed; see the terminal."
            return None

    def _step(self) -> float | None:
        wanted = (self.controls.frame, self.controls.picture)
        if self._pace.wait() == 0.0:
            self._pace.begin()
            self.controls.camera_rests(self._client.camera.position)
            self._update_splats()
            self._pace.end()
        elif wanted != self._picture_of:
            self._update_picture(*wanted)
        else:
            return self._pace.wait()
        return 0.0

    def _update_splats(self) -> None:
        decoder = self._content.decoder
        if decoder is None:
            return
        began = time.perf_counter()
        with self._content.lock:
            light = self._content.flattened if self.controls.light == FLATTENED else None
            splats = decoder.of(self._camera(), light)
        self._send(splats.part(splats.opacities >= self.controls.least_opacity), time.perf_counter() - began)

    def _send(self, splats: SplatCloud, decoding: float) -> None:
        began = time.perf_counter()
        arguments, unit = on_wire(splats, self._content.unit), self._content.unit
        if self._splats is None:
            self._splats = self._client.scene.add_gaussian_splats("/splats", **arguments, scale=unit)
        else:
            self._splats.set_gaussians(**arguments)
        self._client.flush()
        size, sending = len(splats) * BYTES_PER_SPLAT / 1e6, time.perf_counter() - began  # handed to the connection
        self.controls.status = (
            f"{len(splats):,} Gaussians, {size:.1f} MB; decoded in {decoding:.2f} s, sent in {sending:.2f} s"
        )

    def _update_picture(self, index: int, kind: str) -> None:
        with self._content.lock:
            picture = self._content.pictures.of(self._content.frames[index], kind)
        self.controls.show_picture(picture)
        self._picture_of = (index, kind)

    def _camera(self) -> Camera:
        """The browser's camera as one of ours."""
        theirs = self._client.camera
        height, width = theirs.image_height, theirs.image_width
        focal = 0.5 * height / float(torch.tan(torch.tensor(0.5 * theirs.fov)))
        matrix = torch.eye(4, dtype=torch.float64)
        matrix[:3, :3] = rotation_matrices(torch.as_tensor(theirs.wxyz, dtype=torch.float64)[None])[0]
        matrix[:3, 3] = torch.as_tensor(theirs.position, dtype=torch.float64)
        near = self._content.first_camera.near_plane
        return Camera(focal, focal, 0.5 * width, 0.5 * height, width, height, matrix, near)
