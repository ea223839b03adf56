"""An HTTP server on this machine."""

from __future__ import annotations

import threading
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


class FileServer:
    """What a server has, how it fails, and what it was asked for."""

    def __init__(self, port):
        self.url = f"http://127.0.0.1:{port}"
        self.files = {}
        self.statuses = {}  # path -> status other than success
        self.cut = False  # whether responses end half way
        self.requests = []  # paths


@contextmanager
def file_server():
    """A running FileServer on a free port of 127.0.0.1."""

    class Handler(BaseHTTPRequestHandler):
        def log_message(self, *args):
            pass

        def do_GET(self):
            state.requests.append(self.path)
            if self.path in state.statuses:
                return self.send_error(state.statuses[self.path])
            data = state.files[self.path]
            self.send_response(200)
            self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            self.wfile.write(data[: len(data) // 2] if state.cut else data)

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    state = FileServer(server.server_port)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
    thread.start()
    try:
        yield state
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
