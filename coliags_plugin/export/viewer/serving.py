"""A server of viser at exactly one address."""

from __future__ import annotations

import contextlib
import errno
import io
import logging
import os
import socket
import sys
import warnings
from typing import Any

from coliags_plugin.core.errors import InputError


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
        raise InputError(f"`port={port}`", "a number from 0 (any free port) to 65535")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    except OSError as error:
        raise InputError(
            f"`host={host}`: {error.strerror or error}", "a name or address of this machine, for instance 127.0.0.1"
        ) from error
    with socket.socket(family, kind, protocol) as probe:
        # As the server does: a port whose last connections are being closed is free.
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(address)
            probe.listen(1)
        except PermissionError as error:
            raise InputError(f"`port={port}`: {error.strerror}", "a port above 1023") from error
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                raise _taken(host, port) from error
            raise InputError(
                f"`host={host}`: {error.strerror}", "a name or address of this machine, for instance 127.0.0.1"
            ) from error


def _taken(host: str, port: int) -> InputError:
    return InputError(
        f"`port={port}` is in use on {host}", "a free port", f"Pass another, for instance `port={port + 1}`"
    )
