"""Trains and evaluates methods on one scene, and writes their table and a contact sheet of their views.

    python benchmarks/all_methods.py --data SCENE --out RUNS --steps 3000

Runs that are there already are kept, so the command can be interrupted and repeated. Methods of ``--timed`` are trained
for as many steps as fit into the processor time that the slowest of the others took: on a busy machine that says more
than the time of the clock. Set COLIAGS_LPIPS_WEIGHTS for LPIPS.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tyro
from machine import describe_machine, markdown_table, write_results

from coliags_plugin.comparison.report.sources import read_study
from coliags_plugin.config.method_config import load_method
from coliags_plugin.core.images import read_rgb
from coliags_plugin.outputs.colormaps import colorize_depth
from coliags_plugin.outputs.image_files import encode_jpeg, read_depth_tiff
from coliags_plugin.results.record import Result

PAPER = "3dgs,2dgs,scaffold-gs,gaussian-pancakes,pr-endo,coliags,3dgs-depth,scaffold-gs-depth"
#: Column title -> test set and metric.
COLUMNS = {
    "PSNR dB": ("test", "psnr"),
    "SSIM": ("test", "ssim"),
    "LPIPS": ("test", "lpips_squeeze"),
    "depth MSE mm2": ("test", "depth_mse"),
    "inner": ("test", "depth_mse_inner"),
    "median error mm": ("test", "depth_median_error"),
    "rotation PSNR dB": ("rotation", "psnr_seen"),
    "rotation depth MSE mm2": ("rotation", "depth_mse_seen"),
}
#: Steps of the two runs that measure the time of a step.
PROBE_STEPS = (2, 12)


@dataclass(frozen=True)
class Options:
    """Compare methods on one scene."""

    data: Path
    """Scene."""
    out: Path
    """Folder of the runs, of their table as Markdown and JSON, and of the contact sheet."""
    methods: str = PAPER
    """Methods by name, comma separated."""
    timed: str = "reim-nerf-small"
    """Methods to train for as long as the slowest of the others (processor time), comma separated; empty for none."""
    steps: int = 3000
    """Steps of the others."""
    seed: int = 0
    """Of all runs."""
    jobs: int = 1
    """Runs at a time, each with its share of the CPUs as threads."""
    depth_limit: float = 80.0
    """Upper end of the colours of depth, mm."""


def main(options: Options) -> None:
    """Train and evaluate what is missing, then write table and contact sheet."""
    options.out.mkdir(parents=True, exist_ok=True)
    methods = [name for name in options.methods.split(",") if name]
    timed = [name for name in options.timed.split(",") if name]
    with ThreadPoolExecutor(options.jobs) as pool:
        list(pool.map(lambda name: complete(name, options.steps, options), methods))
    slowest = max((spent(name, options)["processor_seconds"] for name in methods), default=0.0)
    for name in timed:
        if not (options.out / f"{name}.json").is_file():
            complete(name, max(1, round(slowest / seconds_per_step(name, options))), options)
    runs = [options.out / name for name in (*methods, *timed)]
    results = [run.result for run in read_study(runs).runs]
    rows = [row(run, result, options) for run, result in zip(runs, results, strict=True)]
    header = ", ".join(f"{key}: {value}" for key, value in describe_machine().items())
    text = f"{header}; {options.jobs} runs at a time\n\n{markdown_table(rows)}\n"
    (options.out / "table.txt").write_text(text, encoding="utf-8")
    write_results(options.out / "table.json", rows)
    (options.out / "sheet.jpg").write_bytes(encode_jpeg(contact_sheet(runs, options), quality=88))
    print(text)


def complete(name: str, steps: int, options: Options) -> None:
    """Train and evaluate one method unless its record is there."""
    record, run = options.out / f"{name}.json", options.out / name
    if record.is_file():
        return
    resume = ["--resume"] if (run / "config.yaml").is_file() else []
    cost = call(["train", name, *_where(options, run), "--steps", str(steps), *resume], options)
    call(["eval", str(run)], options)
    record.write_text(json.dumps({"steps": steps, **cost}), encoding="utf-8")


def seconds_per_step(name: str, options: Options) -> float:
    """Processor time of a step of a method, from two short runs: what both take is not of the steps."""
    run = options.out / f"{name}-probe"
    short, longer = (
        call(["train", name, *_where(options, run), "--steps", str(steps), "--overwrite"], options)["processor_seconds"]
        for steps in PROBE_STEPS
    )
    return (longer - short) / (PROBE_STEPS[1] - PROBE_STEPS[0])


def _where(options: Options, run: Path) -> list[str]:
    return ["--data", str(options.data), "--output", str(run), "--seed", str(options.seed)]


def call(argv: Sequence[str], options: Options) -> dict[str, float]:
    """Run one command of coliags; its wall time and processor time in seconds, and its peak resident memory in MiB."""
    threads = max(1, (os.cpu_count() or 1) // options.jobs)
    environment = {**os.environ, "OMP_NUM_THREADS": str(threads)}
    began = time.monotonic()
    command = [sys.executable, "-c", "from coliags_plugin.cli import main; raise SystemExit(main())", *argv]
    child = subprocess.Popen(command, env=environment)
    _, status, usage = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode:
        raise SystemExit(f"coliags {' '.join(argv)} ended with status {child.returncode}")
    return {
        "seconds": time.monotonic() - began,
        "processor_seconds": usage.ru_utime + usage.ru_stime,
        "peak_mib": usage.ru_maxrss / 1024,
    }


def spent(name: str, options: Options) -> dict[str, Any]:
    """The record of a method: steps, seconds, processor_seconds, peak_mib."""
    record: dict[str, Any] = json.loads((options.out / f"{name}.json").read_text(encoding="utf-8"))
    return record


def row(run: Path, result: Result, options: Options) -> dict[str, Any]:
    """A run's row of the table."""
    means = {
        title: result.sets[set_name].mean(metric) if set_name in result.sets else None
        for title, (set_name, metric) in COLUMNS.items()
    }
    log = (run / "metrics.jsonl").read_text(encoding="utf-8").splitlines()
    record, drawn = spent(run.name, options), json.loads(log[-1]).get("gaussians", "none")
    return {
        "method": run.name,
        **{title: "" if value is None else f"{value:.4f}" for title, value in means.items()},
        "steps": record["steps"],
        "Gaussians drawn": drawn,
        "seconds": round(record["seconds"]),
        "processor seconds": round(record["processor_seconds"]),
        "peak MiB": round(record["peak_mib"]),
    }


def contact_sheet(runs: Sequence[Path], options: Options) -> np.ndarray:
    """The truth and every run, one row each: a held-out and a rotated view, each beside its depth; half size."""
    chosen = [(name, frames) for name in ("test", "rotation") if (frames := _frames(runs[0], name))]
    views = [(name, frames[len(frames) // 2]) for name, frames in chosen]
    rows = [_strip("truth", runs[0], views, ("truth", "true_depth"), options)]
    rows += [_strip(run.name, run, views, ("renders", "depth"), options) for run in runs]
    return np.concatenate(rows)


def _frames(run: Path, name: str) -> list[str]:
    return sorted(path.stem for path in (run / "eval/paper/renders" / name).glob("*.png"))


def _strip(
    title: str, run: Path, views: Sequence[tuple[str, str]], kinds: tuple[str, str], options: Options
) -> np.ndarray:
    cells = []
    for name, frame in views:
        cells.append(read_rgb(run / "eval/paper" / kinds[0] / name / f"{frame}.png"))
        depth = run / "eval/paper" / kinds[1] / name / f"{frame}.tiff"
        shown = np.zeros_like(cells[-1])
        if depth.is_file():
            shown = np.asarray(colorize_depth(read_depth_tiff(depth), (0.0, options.depth_limit)))
        cells.append(shown[: len(cells[-1])])
    strip = cv2.resize(np.concatenate(cells, axis=1), None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    cv2.rectangle(strip, (0, 0), (9 * len(title), 18), (0, 0, 0), cv2.FILLED)
    cv2.putText(strip, title, (4, 13), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 255), 1, cv2.LINE_AA)
    return strip


if __name__ == "__main__":
    # A typing error in a method's name is found before hours of training.
    chosen = tyro.cli(Options)
    for method in (*chosen.methods.split(","), *chosen.timed.split(",")):
        if method:
            load_method(method)
    main(chosen)
