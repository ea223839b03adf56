"""Where the time of a training step goes.

    python benchmarks/train_stages.py --anchors 20000,100000 --renderers torch,cpu --json FILE

Stages are timed one after the other on the same step: gradients are cut at the stage's borders and handed on by hand,
which changes no number. Medians over the steps; renderers take turns step by step.
"""

from __future__ import annotations

import os
import statistics
import tempfile
import time
from collections import defaultdict
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

os.environ.setdefault("GOMP_SPINCOUNT", "10000")  # as the command line does; read when torch is first imported

import torch
import tyro
from machine import show, size_of
from torch import Tensor
from tube import tube_scene

from coliags_plugin.config.method_config import load_method
from coliags_plugin.contracts import TrainingStep
from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.engine.devices import choose_device
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.engine.trainer import Trainer

STAGES = ("decode", "render", "loss", "loss backward", "render backward", "decode backward", "strategy", "optimiser")


@dataclass(frozen=True)
class Options:
    """Time the stages of a training step."""

    anchors: str = "20000,100000"
    """Numbers of anchors, comma separated."""
    renderers: str = "torch"
    """Renderers by name, comma separated."""
    method: str = "coliags"
    """Method config."""
    steps: int = 15
    """Timed steps; three more come first to warm up."""
    size: str = "338x270"
    """Image size WxH, pixels."""
    device: str = "cpu"
    """Where to compute."""
    json: Path | None = None
    """Also write the rows here."""


class Handed:
    """A field that hands out Gaussians made before."""

    def __init__(self, gaussians: Gaussians, primitive: str) -> None:
        self.made = gaussians
        self.primitive = primitive

    def gaussians(self, camera: Any, light: object = None, generator: object = None) -> Gaussians:
        """The same whatever the camera."""
        return self.made


class Clock:
    """Milliseconds by stage."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.times: dict[str, list[float]] = defaultdict(list)
        self.began = 0.0

    def start(self) -> None:
        """From here on."""
        self._wait()
        self.began = time.perf_counter()

    def stop(self, stage: str) -> None:
        """The stage ends here and the next begins."""
        self._wait()
        now = time.perf_counter()
        self.times[stage].append(1e3 * (now - self.began))
        self.began = now

    def _wait(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)


def cut(value: Tensor) -> Tensor:
    """The same numbers as the leaf of a new graph."""
    return value.detach().requires_grad_(value.is_floating_point() and value.requires_grad)


def hand_back(values: list[Tensor], cuts: list[Tensor]) -> None:
    """Continue the backward pass behind a cut."""
    pairs = [(value, leaf.grad) for value, leaf in zip(values, cuts, strict=True) if leaf.grad is not None]
    torch.autograd.backward([value for value, _ in pairs], [gradient for _, gradient in pairs])


def timed_step(trainer: Trainer, clock: Clock) -> int:
    """One training step, stage by stage; returns how many Gaussians it drew."""
    step = trainer.step + 1
    (draw,) = trainer.sampler.next()
    frame = trainer.scene.train[draw.frame].to(trainer.device)
    clock.start()
    decoded = trainer.model.field.gaussians(frame.camera)
    clock.stop("decode")
    names = [f.name for f in fields(Gaussians) if getattr(getattr(decoded, f.name), "requires_grad", False)]
    leaves = replace(decoded, **{name: cut(getattr(decoded, name)) for name in names})
    clock.start()
    output = trainer.chosen.renderer.render(Handed(leaves, trainer.model.field.primitive), frame.camera, trainer.wants)
    clock.stop("render")
    images = [output.rgb, output.alpha, *output.maps.values()]
    image_leaves = [cut(image) for image in images]
    maps = dict(zip(output.maps, image_leaves[2:], strict=True))
    seen = replace(output, rgb=image_leaves[0], alpha=image_leaves[1], maps=maps)
    clock.start()
    weights = {key: loss.settings.weight_at(step, trainer.steps) for key, loss in trainer.losses.items()}
    taken = TrainingStep(seen, frame.target, trainer.model, step, trainer.schedule)
    total = torch.stack([weights[key] * loss(taken) for key, loss in trainer.losses.items()]).sum()
    clock.stop("loss")
    torch.autograd.backward(total)
    clock.stop("loss backward")
    hand_back(images, image_leaves)
    clock.stop("render backward")
    hand_back([getattr(decoded, name) for name in names], [getattr(leaves, name) for name in names])
    clock.stop("decode backward")
    trainer.strategy.after_backward(replace(taken, output=output), trainer.optimizers)
    clock.stop("strategy")
    trainer.optimizers.step(step)
    clock.stop("optimiser")
    trainer.step = step
    return len(decoded)


def main(options: Options) -> None:
    """Run, print a table, and write JSON where asked."""
    width, height = size_of(options.size)
    device = choose_device(options.device)
    rows = []
    for anchors in map(int, options.anchors.split(",")):
        scene = tube_scene(anchors, width=width, height=height)
        names = options.renderers.split(",")
        trainers, clocks = {}, {name: Clock(device) for name in names}
        drawn: dict[str, list[int]] = defaultdict(list)
        for name in names:
            # A voxel far below the points' distance keeps one anchor per point; statistics from the first step on.
            changes = [f"renderer.name={name}", "field.voxel_size=0.01", "strategy.statistics_from=0"]
            method = load_method(options.method, changes)
            trainers[name] = Trainer(method, scene, "tube", RunFolder(Path(tempfile.gettempdir())), 0, device)
        for turn in range(options.steps + 3):
            for name in names:
                clock = clocks[name] if turn >= 3 else Clock(device)
                drawn[name].append(timed_step(trainers[name], clock))
        for name in names:
            medians = {stage: statistics.median(clocks[name].times[stage]) for stage in STAGES}
            total = statistics.median(map(sum, zip(*clocks[name].times.values(), strict=True)))
            row = {"renderer": name, "anchors": anchors, "gaussians": int(statistics.median(drawn[name]))}
            rows.append({**row, "step_ms": total, **{f"{stage} ms": value for stage, value in medians.items()}})
    show(rows, options.json)


if __name__ == "__main__":
    main(tyro.cli(Options))
