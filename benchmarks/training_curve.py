"""Held-out figures over a whole training run, one row every so many steps.

    python benchmarks/training_curve.py --data PHANTOM --method coliags --out RUN --threads 1

RUN becomes a run folder as `coliags train` makes it, with `curve.jsonl` beside its log. A killed curve goes on where it
was when the same command is given again. Seconds are those of training alone, of the clock and of the processor, all
threads together; looking at the views does not count.
"""

from __future__ import annotations

import json
import logging
import os
import resource
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("GOMP_SPINCOUNT", "10000")  # as the command line does; read when torch is first imported

import torch
import tyro

from coliags_plugin.config.options import Assignments
from coliags_plugin.core.files import atomic_write
from coliags_plugin.core.scenes import Frame
from coliags_plugin.engine.data_formats import load_method_for, load_scene
from coliags_plugin.engine.devices import choose_device
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.engine.scoring import Scorer, within_seen
from coliags_plugin.engine.trainer import Trainer
from coliags_plugin.results.record import MAIN_SET

#: Figures of protocol `paper` that a curve holds; LPIPS would cost more than the training between two looks.
METRICS = ("psnr", "ssim", "depth_mse", "depth_mse_inner", "depth_median_error")


@dataclass(frozen=True)
class Options:
    """Train and look at the held-out views every so often."""

    data: Path
    """The scene's folder."""
    out: Path
    """Run folder; goes on where it was if it is there."""
    method: str = "coliags"
    """Method config."""
    steps: int = 30_000
    """Training steps."""
    every: int = 1000
    """Steps between looks."""
    seed: int = 0
    """Seed of every random stream."""
    threads: int | None = None
    """Threads to compute with; default: torch's own choice."""
    set: Assignments = ()
    """Change a value of the method config, for instance strategy.name=none."""
    device: str = "auto"
    """Where to compute."""


def look(trainer: Trainer, frames: list[Frame], scorer: Scorer, seen_only: bool) -> dict[str, float]:
    """Means over frames, of all pixels or of those that training frames see where the frames tell."""
    rows = []
    for frame in frames:
        comparison = scorer.compare(trainer.model, frame, trainer.device)
        rows.append(scorer.score(within_seen(comparison, frame) if seen_only else comparison).values)
    found = {name: [row[name] for row in rows if name in row] for name in scorer.metrics}
    return {name: sum(values) / len(values) for name, values in found.items() if values}


def curve_row(trainer: Trainer, scorer: Scorer, taken: dict[str, Any], spent: dict[str, float]) -> dict[str, Any]:
    """One row of the curve."""
    row: dict[str, Any] = {"step": trainer.step}
    for name, frames in trainer.scene.test_sets.items():
        beside = name != MAIN_SET  # views turned away from the path show what no training frame did
        scores = look(trainer, frames, scorer, seen_only=beside)
        row |= {f"{name}_{key}" if beside else key: value for key, value in scores.items()}
    return {
        **row,
        "elements": trainer.model.field.element_count,
        "gaussians": taken.get("gaussians", 0),
        "train_psnr": taken["psnr"],
        "loss": taken["loss"],
        **{name: round(value, 1) for name, value in spent.items()},
        "peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
    }


def rows_until(path: Path, step: int) -> list[dict[str, Any]]:
    """The rows of a curve up to a step."""
    if not path.is_file():
        return []
    return [row for line in path.read_text(encoding="utf-8").splitlines() if (row := json.loads(line))["step"] <= step]


def main(options: Options) -> None:
    """Train to the end, or go on."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    if options.threads is not None:
        torch.set_num_threads(options.threads)
    changes = [*options.set, f"schedule.steps={options.steps}"]
    method = load_method_for(options.data, options.method, changes, None)
    scene = load_scene(method.config, options.data)
    run = RunFolder(options.out)
    trainer = Trainer(method, scene, str(options.data.resolve()), run, options.seed, choose_device(options.device))
    curve = options.out / "curve.jsonl"
    if any(run.checkpoints.glob("step-*")):
        trainer.resume()
    else:
        trainer.start(overwrite=True)
    scorer = Scorer("paper", only=METRICS)
    rows = rows_until(curve, trainer.step)
    clocks = {"seconds": time.perf_counter, "processor_seconds": time.process_time}
    spent = {name: float(rows[-1][name]) if rows else 0.0 for name in clocks}
    while trainer.step < options.steps:
        began = {name: clock() for name, clock in clocks.items()}
        events: dict[str, int] = {}
        while True:
            taken = trainer.take_step()
            for name in ("grown", "pruned"):
                events[name] = events.get(name, 0) + taken.get(name, 0)
            if trainer.step % options.every == 0 or trainer.step == options.steps:
                break
        spent = {name: spent[name] + clock() - began[name] for name, clock in clocks.items()}
        rows.append({**curve_row(trainer, scorer, taken, spent), **events})
        print(json.dumps(rows[-1]), flush=True)
        trainer.save()
        atomic_write(curve, "".join(json.dumps(row) + "\n" for row in rows))


if __name__ == "__main__":
    main(tyro.cli(Options))
