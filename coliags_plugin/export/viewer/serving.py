"""Serving a run to browsers with viser."""

from __future__ import annotations

import contextlib
import errno
import io
import logging
import os
import socket
import sys
import threading
import warnings
import webbrowser
from types import TracebackType
from typing import Any

import numpy as np
from typing_extensions import Self

from coliags_plugin.core.errors import InputError
from coliags_plugin.engine.trained import TrainedRun
from coliags_plugin.export.viewer.content import ViewerContent, vertical_fov
from coliags_plugin.export.viewer.layers import pose
from coliags_plugin.export.viewer.session import Session

logger = logging.getLogger(__name__)


class Viewer:
    """A run that is being served to browsers, until it is closed. Use it as a context manager, or close it.

    It listens on the name or address ``host``, at a port, any free one for 0. With ``content``, sessions are brought up
    to date by their :meth:`~coliags_plugin.export.viewer.session.Session.update`, and not by threads of their own.
    """

    def __init__(
        self, trained: TrainedRun, host: str = "127.0.0.1", port: int = 8080, content: ViewerContent | None = None
    ) -> None:
        self._server = start_server(host, port)
        self._host = host
        self._sessions: dict[int, Session] = {}
        self._threads: list[threading.Thread] = []
        self._lock = threading.Lock()
        try:
            self.content = content or ViewerContent.of(trained)
            self._own_threads = content is None
            set_start(self._server, self.content)
        except BaseException:
            stop_server(self._server)
            raise
        self._server.on_client_connect(self._connected)
        self._server.on_client_disconnect(self._gone)

    @property
    def port(self) -> int:
        """Where it listens."""
        return int(self._server.get_port())

    @property
    def url(self) -> str:
        """Address for a browser on this machine."""
        return f"http://{'localhost' if self._host in ('0.0.0.0', '::', '') else self._host}:{self.port}"

    @property
    def sessions(self) -> list[Session]:
        """Of the browsers that look at it."""
        with self._lock:
            return list(self._sessions.values())

    def wait(self) -> None:
        """Wait until the process is interrupted."""
        threading.Event().wait()

    def open(self) -> bool:
        """Open a browser on this machine; False where there is no display, or none could be opened."""
        return has_display() and webbrowser.open(self.url)

    def close(self) -> None:
        """Stop serving, once what is being computed for a browser is done: threads that end later crash the process."""
        for session in self.sessions:
            session.close()
        for thread in self._threads:
            thread.join()
        stop_server(self._server)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _connected(self, client: Any) -> None:
        session = Session(client, self.content)
        with self._lock:
            self._sessions[client.client_id] = session
        if client.client_id not in self._server.get_clients():  # it has left in the meantime
            self._gone(client)
        if not self._own_threads:
            return
        thread = threading.Thread(target=session.run, name=f"view-{client.client_id}", daemon=True)
        self._threads = [*(one for one in self._threads if one.is_alive()), thread]
        thread.start()

    def _gone(self, client: Any) -> None:
        with self._lock:
            session = self._sessions.pop(client.client_id, None)
        if session is not None:
            session.close()


def set_start(server: Any, content: ViewerContent) -> None:
    """Let browsers start at the content's first camera, upright, before black, with a plain panel and no lights."""
    camera = content.first_camera
    _, position = pose(camera)
    axis = camera.optical_axis.double().cpu().numpy()
    server.scene.set_up_direction(tuple(content.up))
    start = server.initial_camera
    start.position, start.up = position, content.up
    start.look_at = position + content.look_distance * axis
    start.fov = vertical_fov(camera)
    start.near, start.far = content.near_plane, 1000.0 * content.look_distance
    server.scene.configure_default_lights(enabled=False)
    server.scene.configure_environment_map(hdri=None)
    server.scene.set_background_image(np.zeros((1, 1, 3), np.uint8), format="png")
    server.gui.set_panel_label(content.title)
    server.gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)


def has_display() -> bool:
    """Whether a browser can be shown here."""
    if sys.platform in ("darwin", "win32"):
        return "SSH_CONNECTION" not in os.environ
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def import_viser() -> Any:
    """viser, the optional library that serves the browser view."""
    try:
        import viser
    except ImportError as error:
        raise InputError(
            f"viser cannot be imported ({error})",
            "viser, which draws runs in the browser",
            "Install it with `pip install 'coliags_plugin[viewer]'`",
        ) from error
    return viser


def check_server(host: str, port: int) -> None:
    """Raise InputError where viser is not installed, or cannot listen at an address."""
    import_viser()
    _check_address(host, port)


def start_server(host: str, port: int) -> Any:
    """A running ``viser.ViserServer`` at exactly this address, or any free port for 0.

    viser itself would take the next free port, and print.
    """
    viser = import_viser()
    # A browser may leave while something is computed for it.
    warnings.filterwarnings("ignore", message="Queued a .* on a closed connection", category=UserWarning)
    logging.getLogger("websockets").setLevel(logging.WARNING)  # else it reports each start and end of a server
    _check_address(host, port)
    with contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host=host, port=port, verbose=False)
    if port and server.get_port() != port:
        stop_server(server)
        raise _taken(host, port)
    return server


def stop_server(server: Any) -> None:
    """Stop a server without its message."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def _check_address(host: str, port: int) -> None:
    if not 0 <= port <= 65535:
        raise InputError(f"--port {port}", "a number from 0 (any free port) to 65535")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    except OSError as error:
        raise InputError(
            f"--host {host}: {error.strerror or error}", "a name or address of this machine, for instance 127.0.0.1"
        ) from error
    with socket.socket(family, kind, protocol) as probe:
        # As the server does: a port whose last connections are being closed is free.
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(address)
            probe.listen(1)
        except PermissionError as error:
            raise InputError(f"--port {port}: {error.strerror}", "a port above 1023") from error
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                raise _taken(host, port) from error
            raise InputError(
                f"--host {host}: {error.strerror}", "a name or address of this machine, for instance 127.0.0.1"
            ) from error


def _taken(host: str, port: int) -> InputError:
    return InputError(
        f"--port {port} is in use on {host}", "a free port", f"Pass another, for instance --port {port + 1}"
    )
