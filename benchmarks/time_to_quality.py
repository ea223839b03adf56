"""Seconds of training until held-out views reach a PSNR.

    python benchmarks/time_to_quality.py --data PHANTOM --methods coliags,scaffold-gs-depth --json FILE

The clock stands still while the held-out views are rendered.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from machine import describe_machine, markdown_table, write_results

from coliags_plugin.config.method_config import load_method
from coliags_plugin.engine.data_formats import load_scene
from coliags_plugin.engine.devices import choose_device
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.engine.scoring import Scorer
from coliags_plugin.engine.trainer import Trainer


@dataclass(frozen=True)
class Options:
    """Time the way to a PSNR on held-out views."""

    data: Path
    """The scene's folder, for instance a phantom."""
    methods: str = "coliags,scaffold-gs-depth"
    """Method configs, comma separated."""
    renderer: str = "auto"
    """Renderer by name."""
    steps: int = 2000
    """Training steps, to which schedules are compressed."""
    every: int = 50
    """Steps between looks at the held-out views."""
    levels: str = "30,32,34"
    """PSNR levels, dB, comma separated."""
    device: str = "auto"
    """Where to compute."""
    json: Path | None = None
    """Also write the rows here."""


def held_out_psnr(trainer: Trainer, scorer: Scorer) -> float:
    """Mean PSNR of the test frames, dB."""
    frames = trainer.scene.test_sets["test"]
    scores = [scorer.score(scorer.compare(trainer.model, frame, trainer.device)) for frame in frames]
    return sum(score.values["psnr"] for score in scores) / len(scores)


def race(options: Options, name: str) -> dict[str, Any]:
    """Train one method and note when it passes each level."""
    method = load_method(name, [f"schedule.steps={options.steps}", f"renderer.name={options.renderer}"])
    scene = load_scene(method.config, options.data)
    run = RunFolder(Path(tempfile.gettempdir()))
    trainer = Trainer(method, scene, str(options.data), run, 0, choose_device(options.device))
    levels = [float(level) for level in options.levels.split(",")]
    scorer = Scorer("paper", only=["psnr"])
    passed: dict[float, float] = {}
    seconds, psnr = 0.0, 0.0
    while trainer.step < options.steps and len(passed) < len(levels):
        began = time.perf_counter()
        for _ in range(options.every):
            trainer.take_step()
        seconds += time.perf_counter() - began
        psnr = held_out_psnr(trainer, scorer)
        passed |= {level: seconds for level in levels if psnr >= level and level not in passed}
    row: dict[str, Any] = {"method": name, "renderer": trainer.chosen.name}
    row |= {f"s to {level:g} dB": passed.get(level, "not reached") for level in levels}
    return {**row, "steps": trainer.step, "s": seconds, "psnr_db": psnr}


def main(options: Options) -> None:
    """Run, print a table, and write JSON where asked."""
    rows = [race(options, name) for name in options.methods.split(",")]
    print(", ".join(f"{key}: {value}" for key, value in describe_machine().items()), end="\n\n")
    print(markdown_table(rows))
    write_results(options.json, rows)


if __name__ == "__main__":
    main(tyro.cli(Options))
