"""Results made for reports: several methods on several scenes, in files and run folders."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace

import numpy as np

from coliags_plugin.comparison.plan import Decision
from coliags_plugin.reporting.image_files import write_depth_tiff, write_png
from coliags_plugin.results.reading import write_result
from coliags_plugin.results.record import (
    CostRecord,
    MetricRecord,
    ProfileRecord,
    ProtocolRecord,
    SceneRecord,
)
from tests.results.made import made_result, made_set

HEIGHT, WIDTH = 12, 16
UNITS = {
    **{"psnr": "dB", "ssim": "", "lpips": "", "depth_mse": "mm^2", "depth_mse_inner": "mm^2"},
    **{"depth_median_error": "mm", "depth_abs_rel": "", "psnr_seen": "dB"},
}
METRICS = {
    name: MetricRecord(unit=unit, direction="higher" if name.startswith(("psnr", "ssim")) else "lower")
    for name, unit in UNITS.items()
}
FRAMES = {"test": ("0004", "0012", "0020", "0028", "0036"), "rotation": ("0100", "0110")}
NO_LPIPS = "no VGG weights & none to be had"


def digest(*parts):
    """64 hexadecimal digits."""
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def set_of(scene, name, frames, psnr, depth, values=()):
    """A test set whose PSNR rises by 1 dB a frame around ``psnr``, without LPIPS; ``depth`` is its error in mm."""
    count = len(frames)
    rising = tuple(float(psnr + step) for step in np.arange(count) - (count - 1) / 2)
    columns = {"psnr": rising, "ssim": (0.9,) * count, "lpips": (None,) * count}
    reasons = {"lpips": NO_LPIPS}
    if depth is None:
        reasons["depth_mse"] = "the frame has no true depth"
    else:
        errors = {"mse": depth**2, "mse_inner": depth**2 / 4, "median_error": depth / 2, "abs_rel": depth / 40}
        columns |= {f"depth_{error}": (value,) * count for error, value in errors.items()}
    if name == "rotation":
        columns["psnr_seen"] = tuple(value + 2.0 for value in rising)
    return made_set(
        tuple(frames),
        values=columns | dict(values),
        reasons=reasons,
        predictions_sha256=digest(scene, name, psnr),
        truth_sha256=digest(scene, name),
        profiles={} if depth is None else {"distance": profile(depth, "mm"), "angle": profile(depth, "degrees")},
    )


def profile(depth, unit):
    """Errors that grow over three bins; the last is empty."""
    rgb, depths = (0.001, 0.004, None), (depth**2, 4 * depth**2, None)
    return ProfileRecord(unit=unit, edges=(0.0, 10.0, 20.0, 30.0), pixels=(100, 300, 0), rgb_mse=rgb, depth_mse=depths)


COST = {
    **{"device": "a processor", "threads": 2, "train_seconds": 80.0, "processor_seconds": 150.0, "render_fps": 12.5},
    **{"peak_memory_mib": 700.0, "gaussians": 1040.0, "checkpoint_bytes": 3 * 2**20},
    "seconds_to_psnr": {"25": 10.0, "30": None},
}


def result_of(
    method, scene="cecum", *, seed=0, psnr=30.0, depth=0.5, frames=FRAMES, values=(), split="every-8th",
    size=(WIDTH, HEIGHT), train=("0001", "0002"), version=1, steps=40, config=(), cost=(), software=(), data=(),
):  # fmt: skip
    """A result; ``values`` overrides metrics of the test set."""
    sets = {
        name: set_of(scene, name, names, psnr, depth, values if name == "test" else ())
        for name, names in frames.items()
    }
    return made_result(
        sets,
        key=digest(method, scene, seed, split, steps, config)[:16],
        method=method,
        scene=SceneRecord(name=scene, fingerprint=digest(scene), split=split, train=tuple(train), size=size),
        protocol=ProtocolRecord(name="paper", version=version, description="as in the <paper>"),
        seed=seed,
        steps=steps,
        metrics=METRICS,
        cost=CostRecord(**COST | dict(cost)),
        config={"name": method, "schedule": {"steps": steps}, **dict(config)},
        software={"package_version": "0.1.0", "git": "abc1234", "threads": 2, **dict(software)},
        provenance={
            "training": {"renderer": "torch", "renderer_reason": "no CUDA device"},
            "scene": {"dataset": "c3vd", "calibration": "legacy-pinhole", **dict(data)},
        },
    )


def write_run(folder, result, *, depth=0.5):
    """A finished and evaluated run folder with the images of a result; ``depth`` is its error, None without depth."""
    evaluation = folder / "eval" / result.protocol.name
    rng = np.random.default_rng(0)
    for name, part in result.sets.items():
        for frame in part.frames:
            width, height = result.scene.size
            truth = rng.integers(0, 256, (height, width, 3), dtype=np.uint8)
            write_png(evaluation / "truth" / name / f"{frame}.png", truth)
            write_png(evaluation / "renders" / name / f"{frame}.png", 255 - truth)
            if depth is not None:
                true = np.linspace(20, 60, height * width, dtype=np.float32).reshape(height, width)
                true[0] = np.nan
                write_depth_tiff(evaluation / "true_depth" / name / f"{frame}.tiff", true)
                write_depth_tiff(evaluation / "depth" / name / f"{frame}.tiff", np.nan_to_num(true) + depth)
    write_result(evaluation / "result.json", result)
    (folder / "config.yaml").write_text("name: made\n")
    with (folder / "metrics.jsonl").open("w") as file:
        for step in range(1, result.steps + 1):
            line = {"step": step, "loss": 1.0 / step, "terms": {"l1": 0.5 / step}, "psnr": 20 + step / 10}
            file.write(json.dumps(line | {"seconds": 2.0 * step, "gaussians": 1000 + step}) + "\n")
    return folder


def place_of(scene, method, seed, key):
    """Place of a cell below runs, results and failures."""
    return f"{scene}/{method.replace('/', '-')}/s{seed}-{key[:8]}"


def write_comparison(folder, results, failures=()):
    """The folder of a comparison, without run folders: results, and failures as (scene, method, seed, reason)."""
    for result in results:
        place = place_of(result.scene.name, result.method, result.seed, result.key)
        write_result(folder / "results" / f"{place}.json", result)
    for scene, method, seed, reason in failures:
        file = folder / "failures" / f"{place_of(scene, method, seed, digest(scene, method))}.json"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps({"reason": reason}))
    write_plan(folder, results, *(failure[:3] for failure in failures))
    return folder


def write_plan(folder, results, *more, decided=None):
    """The plan of results, and of cells (scene, method, seed) without one."""
    cells = [(result.scene.name, result.method, result.seed, result.key) for result in results]
    cells += [(scene, method, seed, digest(scene, method)) for scene, method, seed in more]
    entries = [
        {"scene": cell[0], "method": cell[1], "seed": cell[2], "protocol": "paper", "key": "",
         "run": f"runs/{place_of(*cell)}", "result": f"results/{place_of(*cell)}.json"}
        for cell in cells
    ]  # fmt: skip
    content = {"format": "coliags-comparison", "decided": decided, "cells": entries}
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "plan.json").write_text(json.dumps(content))


def decided(study, *primary, reference="coliags"):
    """The study as of a comparison that decided its reference and primary metrics before the first run."""
    return replace(study, decided=Decision(reference=reference, primary=primary, date="2026-11-01"))


def made_scenes(methods, scenes=8, seeds=1, **options):
    """Methods on several scenes: each scene has its level, each method its lead of about so many dB."""
    rng, depth_rng = (np.random.default_rng(seed) for seed in (4, 5))  # ties take scipy's Wilcoxon test long
    levels = {f"scene-{index + 1}": float(rng.normal(30, 2)) for index in range(scenes)}
    return [
        result_of(
            method,
            scene,
            seed=seed,
            psnr=level + lead + float(rng.normal(0, 0.2)),
            depth=1.6 - lead / 10 + float(depth_rng.normal(0, 0.02)),
            **options,
        )
        for method, lead in methods.items()
        for scene, level in levels.items()
        for seed in range(seeds)
    ]
