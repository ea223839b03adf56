"""Time of a training step of every method, at the same number of Gaussians drawn.

    python benchmarks/train_step.py --gaussians 50000 --json FILE

Methods take turns step by step, and a ratio is the median over the turns of a method's time over that of the first
method in the same turn, so that what else the machine does cancels. Every method is at the same share of its own run,
where terms that begin late are active. ``train_stages.py`` splits the step of one method into stages. On a machine that
is busy with other work, --threads 1 --clock processor counts only the time that it gave to this.
"""

from __future__ import annotations

import os
import statistics
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

os.environ.setdefault("GOMP_SPINCOUNT", "10000")  # as the command line does; read when torch is first imported

import torch
import tyro
from machine import CLOCKS, show, size_of
from tube import tube_scene

from coliags_plugin.config.method_config import LoadedMethod, load_method, method_files
from coliags_plugin.contracts import GaussianField
from coliags_plugin.engine.devices import choose_device
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.engine.trainer import Trainer


@dataclass(frozen=True)
class Options:
    """Time training steps of methods."""

    methods: str = "all"
    """Methods by name, comma separated, the first of which ratios refer to; all: those of the top level, coliags
    first."""
    gaussians: int = 50_000
    """Gaussians in view of the first frame, approximately."""
    progress: float = 0.24
    """Share of the run at which steps are timed."""
    steps: int = 15
    """Timed steps; three more come first to warm up."""
    size: str = "338x270"
    """Image size WxH, pixels."""
    device: str = "cpu"
    """Where to compute."""
    threads: int | None = None
    """CPU threads of torch and of the numba kernels; default: as many as torch chooses."""
    clock: Literal["wall", "processor"] = "wall"
    """Measure elapsed time, or the processor time of this process, summed over its threads."""
    json: Path | None = None
    """Also write the rows here."""


def trainer_of(method: LoadedMethod, points: int, options: Options) -> Trainer:
    """A trainer on the tube, at the chosen share of its run."""
    width, height = size_of(options.size)
    scene = tube_scene(points, width=width, height=height)
    folder = RunFolder(Path(tempfile.gettempdir()))
    trainer = Trainer(method, scene, "tube", folder, 0, choose_device(options.device))
    trainer.step = round(options.progress * trainer.steps) // 100 * 100 + 1  # an event is at least 99 steps away
    trainer.model.field.before_step(trainer.step, trainer.schedule)
    return trainer


def in_view(trainer: Trainer) -> int:
    """Gaussians that the first camera sees; 0 for a radiance field."""
    field = trainer.model.field
    if not isinstance(field, GaussianField):
        return 0
    with torch.no_grad():
        return len(field.gaussians(trainer.scene.train[0].camera))


def matched_trainer(name: str, options: Options) -> Trainer:
    """A trainer of a method whose first view has about the number of Gaussians asked for."""
    method = load_method(name)
    if method.config.field.name == "anchors":  # a voxel far below the points' distance keeps one anchor per point
        method = load_method(name, ["field.voxel_size=0.01"])
    points = max(options.gaussians // 8, 200)
    seen = in_view(trainer_of(method, points, options))
    return trainer_of(method, round(points * options.gaussians / seen) if seen else points, options)


def main(options: Options) -> None:
    """Run, print a table, and write JSON where asked."""
    if options.threads is not None:
        torch.set_num_threads(options.threads)
    clock = CLOCKS[options.clock]
    names = options.methods.split(",")
    if options.methods == "all":
        names = sorted((name for name in method_files() if "/" not in name), key=lambda name: (name != "coliags", name))
    trainers = {name: matched_trainer(name, options) for name in names}
    seen = {name: in_view(trainer) for name, trainer in trainers.items()}
    times: dict[str, list[float]] = {name: [] for name in names}
    for turn in range(options.steps + 3):
        for name, trainer in trainers.items():
            _wait(trainer)
            began = clock()
            trainer.take_step()
            _wait(trainer)
            if turn >= 3:
                times[name].append(1e3 * (clock() - began))
    rows: list[dict[str, Any]] = []
    for name in names:
        shares = [own / first for own, first in zip(times[name], times[names[0]], strict=True)]
        medians = {"step ms": statistics.median(times[name]), f"of {names[0]}": statistics.median(shares)}
        rows.append({"method": name, "gaussians": seen[name] or "none", **medians})
    show(rows, options.json)


def _wait(trainer: Trainer) -> None:
    if trainer.device.type == "cuda":
        torch.cuda.synchronize(trainer.device)


if __name__ == "__main__":
    main(tyro.cli(Options))
