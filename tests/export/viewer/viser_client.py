"""A browser of viser's, as far as its connection goes: it sends a camera and receives messages."""

from __future__ import annotations

import math
import time
from typing import Any

import cv2
import msgspec
import numpy as np
import viser
import zstandard
from viser import transforms
from viser._messages import GuiUpdateMessage, ViewerCameraMessage
from websockets.sync.client import connect

from coliags_plugin.core.cameras import Camera

#: Of the window, px.
WIDTH, HEIGHT = 64, 48


class ViserClient:
    """A connection to a server on this machine. Use it as a context manager."""

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
