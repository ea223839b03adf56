"""Peak memory of training, each case in a process of its own.

python benchmarks/memory.py --anchors 20000,100000 --renderers torch,cpu --json FILE
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from machine import numbers_of, peak_mib, show, size_of


@dataclass(frozen=True)
class Options:
    """Measure the peak memory of a few training steps."""

    anchors: str = "20000,100000"
    """Numbers of anchors, comma separated."""
    renderers: str = "torch"
    """Renderers by name, comma separated."""
    steps: int = 4
    """Training steps."""
    size: str = "338x270"
    """Image size WxH, pixels."""
    json: Path | None = None
    """Also write the rows here."""
    child: bool = False
    """Measure one case in this process and print it; what the benchmark starts itself."""


def train(options: Options) -> tuple[float, float]:
    """Resident memory before the first step and at the peak, MiB."""
    from tube import tube_scene

    from coliags_plugin.config.method_config import load_method
    from coliags_plugin.engine.run_folder import RunFolder
    from coliags_plugin.engine.trainer import Trainer

    width, height = size_of(options.size)
    scene = tube_scene(int(options.anchors), frames=4, width=width, height=height)
    method = load_method("coliags", [f"renderer.name={options.renderers}", "field.voxel_size=0.01"])
    trainer = Trainer(method, scene, "tube", RunFolder(Path(tempfile.gettempdir())), 0, torch.device("cpu"))
    before = peak_mib()
    for _ in range(options.steps):
        trainer.take_step()
    return before, peak_mib()


def main(options: Options) -> None:
    """Run, print a table, and write JSON where asked."""
    if options.child:
        print(*train(options))
        return
    rows = []
    for anchors in options.anchors.split(","):
        for renderer in options.renderers.split(","):
            case = ["--anchors", anchors, "--renderers", renderer, "--steps", str(options.steps)]
            before, peak = numbers_of(__file__, "--child", *case, "--size", options.size)
            rows.append({"renderer": renderer, "anchors": int(anchors), "before_mib": before, "peak_mib": peak})
    show(rows, options.json)


if __name__ == "__main__":
    main(tyro.cli(Options))
