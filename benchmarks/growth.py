"""How processor time and memory grow with anchors, pixels and frames, with fitted exponents.

    python benchmarks/growth.py --anchors 10000,100000,1000000 --sizes 338x270,1350x1080 --frames 100,10000 --json FILE

Of a training step of `coliags` with so many anchors, at 338x270 pixels; with 50,000 anchors at so many pixels; and of
reading a sequence of so many frames of 338x270 whose images stay on disk. Each case is a process of its own. Exponents
are slopes of logarithms, by least squares over all sizes, and between the two largest, where fixed costs count least.
"""

from __future__ import annotations

import math
import os
import statistics
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("GOMP_SPINCOUNT", "10000")  # as the command line does; read when torch is first imported

import numpy as np
import torch
import tyro
from load_scene import write_sequence
from machine import numbers_of, peak_mib, show, size_of

LOADING = Path(__file__).with_name("load_scene.py")
SIZE, ANCHORS = "338x270", 50_000


@dataclass(frozen=True)
class Options:
    """Measure training steps and reading at several sizes."""

    anchors: str = "10000,20000,50000,100000,200000"
    """Numbers of anchors, comma separated; empty: none."""
    sizes: str = "169x135,338x270,675x540,1350x1080"
    """Image sizes WxH, pixels, comma separated; empty: none."""
    frames: str = "100,1000,10000"
    """Lengths of sequences, comma separated; empty: none."""
    steps: int = 9
    """Timed training steps; two more come first to warm up."""
    threads: int = 1
    """Threads of a training step."""
    json: Path | None = None
    """Also write the rows here."""
    child: bool = False
    """Measure one case in this process and print it; what the benchmark starts itself."""


def train(options: Options) -> tuple[float, float, float]:
    """Processor seconds of a training step, its median; resident memory before the first and at the peak, MiB."""
    from tube import tube_scene

    from coliags_plugin.config.method_config import load_method
    from coliags_plugin.engine.run_folder import RunFolder
    from coliags_plugin.engine.trainer import Trainer

    torch.set_num_threads(options.threads)
    width, height = size_of(options.sizes)
    scene = tube_scene(int(options.anchors), frames=4, width=width, height=height)
    # A voxel far below the points' distance keeps one anchor per point.
    method = load_method("coliags", ["renderer.name=cpu", "field.voxel_size=0.001"])
    trainer = Trainer(method, scene, "tube", RunFolder(Path(tempfile.gettempdir())), 0, torch.device("cpu"))
    before, taken = peak_mib(), []
    for _ in range(options.steps + 2):
        began = time.process_time()
        trainer.take_step()
        taken.append(time.process_time() - began)
    return statistics.median(taken[2:]), before, peak_mib()


def training_row(options: Options, axis: str, anchors: int, size: str) -> dict[str, Any]:
    """One number of anchors at one size."""
    settings = {"anchors": anchors, "sizes": size, "steps": options.steps, "threads": options.threads}
    seconds, before, peak = numbers_of(
        __file__, "--child", *(word for name, value in settings.items() for word in (f"--{name}", str(value)))
    )
    along = anchors if axis == "anchors" else math.prod(size_of(size))
    return {"along": axis, "size": along, "ms": 1e3 * seconds, "before_mib": before, "peak_mib": peak}


def reading_rows(lengths: list[int]) -> Iterator[dict[str, Any]]:
    """Sequences of several lengths."""
    for frames in lengths:
        with tempfile.TemporaryDirectory() as folder:
            scene = write_sequence(Path(folder), frames, *size_of(SIZE))
            before, peak, _, seconds = numbers_of(str(LOADING), "--child", str(scene), "--no-keep-pixels")
        yield {"along": "frames", "size": frames, "ms": 1e3 * seconds, "before_mib": before, "peak_mib": peak}


def exponents(rows: list[dict[str, Any]], key: str) -> str:
    """Fitted powers of the size, over all and between the two largest."""
    sizes, values = (np.log([row[name] for row in rows]) for name in ("size", key))
    return f"{np.polyfit(sizes, values, 1)[0]:.2f} ({np.polyfit(sizes[-2:], values[-2:], 1)[0]:.2f})"


def main(options: Options) -> None:
    """Run, print a table with exponents, and write JSON where asked."""
    if options.child:
        print(*train(options))
        return
    listed = {"anchors": options.anchors, "pixels": options.sizes, "frames": options.frames}
    anchors, sizes, frames = ([word for word in text.split(",") if word] for text in listed.values())
    rows = [training_row(options, "anchors", int(count), SIZE) for count in anchors]
    rows += [training_row(options, "pixels", ANCHORS, size) for size in sizes]
    rows += reading_rows([int(count) for count in frames])
    show(rows, options.json)
    for axis in listed:
        along = [row for row in rows if row["along"] == axis]
        if len(along) > 1:
            print(f"{axis}: exponents of time {exponents(along, 'ms')}, of peak memory {exponents(along, 'peak_mib')}")


if __name__ == "__main__":
    main(tyro.cli(Options))
