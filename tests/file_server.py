"""An HTTP server on this machine, with the faults that servers and connections have."""

from __future__ import annotations

import re
import socket
import struct
import threading
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


class FileServer:
    """What a server has, how it fails, and what it was asked for."""

    def __init__(self, port):
        self.url = f"http://127.0.0.1:{port}"
        self.port = port
        self.files = {}
        self.ranges = True  # or it answers with the whole file
        self.shift = 0  # by which the parts it sends begin too early
        self.lengths = True  # or it tells none
        self.statuses = {}  # path -> status other than success
        self.moved = {}  # path -> path
        self.cuts = []  # bytes after which the next responses end
        self.reset = False  # whether cut connections are reset rather than closed
        self.go_on = None  # an event that cut responses wait for, and then send the rest
        self.requests = []  # (method, path, Range)
        self.agents = set()
        self.sent = 0  # bytes of files


@contextmanager
def file_server():
    """A running FileServer on a free port of 127.0.0.1."""

    class Handler(BaseHTTPRequestHandler):
        def log_message(self, *args):
            pass

        def do_CONNECT(self):
            state.requests.append(("CONNECT", self.path, None))
            self.send_error(502)

        def do_GET(self):
            state.requests.append(("GET", self.path, self.headers["Range"]))
            state.agents.add(self.headers["User-Agent"])
            if self.path in state.statuses:
                return self.send_error(state.statuses[self.path])
            if self.path in state.moved:
                self.send_response(302)
                self.send_header("Location", state.moved[self.path])
                return self.end_headers()
            data = state.files[self.path]
            first = 0
            if self.headers["Range"] and state.ranges:
                first = int(re.fullmatch(r"bytes=(\d+)-", self.headers["Range"])[1]) - state.shift
                if first >= len(data):
                    return self.send_error(416)
                self.send_response(206)
                self.send_header("Content-Range", f"bytes {first}-{len(data) - 1}/{len(data)}")
            else:
                self.send_response(200)
            body = data[first:]
            if state.lengths:
                self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            cut = state.cuts.pop(0) if state.cuts else len(body)
            self.send(body[:cut])
            if cut >= len(body):
                return
            if state.go_on is not None:
                state.go_on.wait(60)
            if state.reset:
                self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                self.rfile.close()
                self.connection.close()
            elif state.go_on is not None:
                self.send(body[cut:])

        def send(self, data):
            try:
                state.sent += len(data)  # before the client can have it all and look
                self.wfile.write(data)
            except OSError:  # the client is gone
                pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    state = FileServer(server.server_port)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
    thread.start()
    try:
        yield state
    finally:
        if state.go_on is not None:
            state.go_on.set()
        server.shutdown()
        server.server_close()
        thread.join()
