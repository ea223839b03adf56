"""Frames a second of a trained field, decoding included.

python benchmarks/render_fps.py --anchors 20000,100000 --renderers torch,cpu --json FILE
"""

from __future__ import annotations

import os
import statistics
import time
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("GOMP_SPINCOUNT", "10000")  # as the command line does; read when torch is first imported

import torch
import tyro
from machine import show, size_of
from tube import tube_scene

from coliags_plugin.config.method_config import load_method
from coliags_plugin.core.components import make_component
from coliags_plugin.engine.devices import choose_device
from coliags_plugin.renderers.splatting import choose_renderer


@dataclass(frozen=True)
class Options:
    """Time rendering."""

    method: str = "coliags"
    """Method config, of a field of anchors."""
    anchors: str = "20000,100000"
    """Numbers of anchors, comma separated."""
    renderers: str = "torch"
    """Renderers by name, comma separated."""
    frames: int = 16
    """Timed frames; two more come first to warm up."""
    size: str = "338x270"
    """Image size WxH, pixels."""
    device: str = "cpu"
    """Where to compute."""
    json: Path | None = None
    """Also write the rows here."""


@torch.no_grad()
def main(options: Options) -> None:
    """Run, print a table, and write JSON where asked."""
    width, height = size_of(options.size)
    device = choose_device(options.device)
    rows = []
    for anchors in map(int, options.anchors.split(",")):
        scene = tube_scene(anchors, frames=options.frames, width=width, height=height)
        node = load_method(options.method, ["field.voxel_size=0.01"]).config.field
        field = node.target.from_scene(scene, node.settings, torch.Generator().manual_seed(0)).to(device)
        names = options.renderers.split(",")
        chosen = {name: choose_renderer(make_component("renderers", name), field.primitive, device) for name in names}
        times: dict[str, list[float]] = defaultdict(list)
        for turn, frame in enumerate([*scene.train[:2], *scene.train]):
            for name in names:
                began = time.perf_counter()
                output = chosen[name].renderer.render(field, frame.camera.to(device), ("rgb", "alpha"))
                float(output.alpha[0, 0])  # waits for a GPU
                if turn >= 2:
                    times[name].append(time.perf_counter() - began)
        for name in names:
            seconds = statistics.median(times[name])
            rows.append({"renderer": name, "anchors": anchors, "ms": 1e3 * seconds, "frames_per_s": 1 / seconds})
    show(rows, options.json)


if __name__ == "__main__":
    main(tyro.cli(Options))
