"""Time and size of an update of the browser view: decoding for a new camera, packing, and the way to the browser.

A field of ``coliags`` on a tube (``tube.py``) is decoded for its cameras and sent to a connection on this machine. With
``--run``, a run's.
"""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
import tyro
from machine import show
from tube import tube_scene
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from coliags_plugin.config.method_config import load_method
from coliags_plugin.contracts import GaussianField
from coliags_plugin.core.cameras import Camera
from coliags_plugin.export.baking.baking import mean_gaussians
from coliags_plugin.export.viewer.content import spread
from coliags_plugin.export.viewer.serving import import_viser, start_server, stop_server
from coliags_plugin.export.viewer.splats import BYTES_PER_SPLAT, ViewDecoder, on_wire, shown, wire_unit


@dataclass(frozen=True)
class Options:
    """Time updates of the browser view."""

    anchors: str = "10000,20000"
    """Numbers of anchors of a fresh field, separated by commas."""
    run: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """A run folder, to be decoded instead."""
    repeats: int = 5
    """Views, each timed once."""
    threads: int = 2
    """CPU threads."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Also write the rows here."""


def main(options: Options) -> None:
    """Print a table of medians."""
    torch.set_num_threads(options.threads)
    rows = [timed(*field, options.repeats) for field in fields(options)]
    show(rows, options.json)


def fields(options: Options) -> list[tuple[str, GaussianField, list[Camera]]]:
    """Name, field and cameras of each row."""
    if options.run is not None:
        from coliags_plugin.api.runs import load_run

        trained = load_run(options.run).load()
        field = trained.model.field
        assert isinstance(field, GaussianField)
        return [(trained.method, field, [frame.camera for frame in trained.scene.train])]
    made = []
    for anchors in map(int, options.anchors.split(",")):
        scene = tube_scene(anchors, frames=options.repeats + 1)  # viser does not send the same splats again
        node = load_method("coliags", ["field.voxel_size=0.01"]).config.field
        field = node.target.from_scene(scene, node.settings, torch.Generator().manual_seed(0))
        made.append((f"{anchors} anchors", field, [frame.camera for frame in scene.train]))
    return made


#: Of a splat on the wire after compression.
_LEAST_BYTES = 8


def timed(name: str, field: GaussianField, cameras: list[Camera], repeats: int) -> dict[str, str | float]:
    """Medians of one field."""
    viser = import_viser()
    baked = shown(mean_gaussians(field, spread(cameras)))
    decoder, unit = ViewDecoder(field, baked.part(baked.opacities > 1.0), torch.device("cpu")), wire_unit(baked)
    decoding, sending, counts = [], [], []
    server = start_server("127.0.0.1", 0)
    handle = server.scene.add_gaussian_splats("/splats", **on_wire(baked, unit), scale=unit)
    browser = connect(
        f"ws://127.0.0.1:{server.get_port()}",
        subprotocols=[Subprotocol(f"viser-v{viser.__version__}")],
        max_size=None,
        compression=None,
    )
    arrived(browser, len(baked))
    for turn in range(-1, repeats):
        camera = cameras[turn % len(cameras)]
        began = time.perf_counter()
        splats = decoder.of(camera)
        decoded = time.perf_counter()
        handle.set_gaussians(**on_wire(splats, unit))
        server.flush()
        arrived(browser, len(splats))
        if turn >= 0:
            decoding.append(decoded - began)
            sending.append(time.perf_counter() - decoded)
            counts.append(len(splats))
    browser.close()
    stop_server(server)
    count = statistics.median(counts)
    return {
        "field": name,
        "Gaussians sent": int(count),
        "MB": count * BYTES_PER_SPLAT / 1e6,
        "decode ms": 1e3 * statistics.median(decoding),
        "send ms": 1e3 * statistics.median(sending),
    }


def arrived(browser: ClientConnection, count: int) -> None:
    """Wait for a message that is large enough to hold so many splats, compressed."""
    while len(browser.recv(timeout=60.0)) < count * _LEAST_BYTES:
        pass


if __name__ == "__main__":
    main(tyro.cli(Options))
