"""Results made for reports: several methods on several scenes, in files and run folders."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from coliags_plugin.comparison.plan_file import Decision
from coliags_plugin.comparison.report.study import Study
from coliags_plugin.reporting.image_files import write_depth_tiff, write_png
from coliags_plugin.results.reading import write_result
from coliags_plugin.results.record import (
    CostRecord,
    MetricRecord,
    ProfileRecord,
    ProtocolRecord,
    Result,
    SceneRecord,
    SetRecord,
)
from tests.results.made import made_result, made_set

HEIGHT, WIDTH = 12, 16
METRICS = {
    "psnr": MetricRecord(unit="dB", direction="higher"),
    "ssim": MetricRecord(unit="", direction="higher"),
    "lpips": MetricRecord(unit="", direction="lower"),
    "depth_mse": MetricRecord(unit="mm^2", direction="lower"),
    "depth_mse_inner": MetricRecord(unit="mm^2", direction="lower"),
    "depth_median_error": MetricRecord(unit="mm", direction="lower"),
    "depth_abs_rel": MetricRecord(unit="", direction="lower"),
    "psnr_seen": MetricRecord(unit="dB", direction="higher"),
}
FRAMES = {"test": ("0004", "0012", "0020", "0028", "0036"), "rotation": ("0100", "0110")}
NO_LPIPS = "no VGG weights & none to be had"


def digest(*parts: object) -> str:
    """64 hexadecimal digits."""
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def set_of(
    scene: str, name: str, frames: Sequence[str], psnr: float, depth: float | None, values: Mapping[str, tuple] | None
) -> SetRecord:
    """A test set whose PSNR rises by 1 dB a frame around ``psnr``, without LPIPS; ``depth`` is its error in mm."""
    count = len(frames)
    steps = np.arange(count) - (count - 1) / 2
    made: dict[str, tuple] = {
        "psnr": tuple(float(psnr + step) for step in steps),
        "ssim": (0.9,) * count,
        "lpips": (None,) * count,
    }
    if depth is not None:
        made |= {
            "depth_mse": (depth**2,) * count,
            "depth_mse_inner": (depth**2 / 4,) * count,
            "depth_median_error": (depth / 2,) * count,
            "depth_abs_rel": (depth / 40,) * count,
        }
    if name == "rotation":
        made["psnr_seen"] = tuple(value + 2.0 for value in made["psnr"])
    profiles = {} if depth is None else {"distance": profile(depth, "mm"), "angle": profile(depth, "degrees")}
    reasons = {"lpips": NO_LPIPS} | ({} if depth is not None else {"depth_mse": "the frame has no true depth"})
    return made_set(
        tuple(frames),
        values=made | dict(values or {}),
        reasons=reasons,
        predictions_sha256=digest(scene, name, psnr),
        truth_sha256=digest(scene, name),
        profiles=profiles,
    )


def profile(depth: float, unit: str) -> ProfileRecord:
    """Errors that grow over three bins; the last is empty."""
    return ProfileRecord(
        unit=unit,
        edges=(0.0, 10.0, 20.0, 30.0),
        pixels=(100, 300, 0),
        rgb_mse=(0.001, 0.004, None),
        depth_mse=(depth**2, 4 * depth**2, None),
    )


def result_of(
    method: str,
    scene: str = "cecum",
    *,
    seed: int = 0,
    psnr: float = 30.0,
    depth: float | None = 0.5,
    frames: Mapping[str, Sequence[str]] | None = None,
    values: Mapping[str, tuple] | None = None,
    split: str = "every-8th",
    size: tuple[int, int] = (WIDTH, HEIGHT),
    train: Sequence[str] = ("0001", "0002"),
    version: int = 1,
    steps: int = 40,
    config: Mapping[str, object] | None = None,
    cost: Mapping[str, object] | None = None,
    software: Mapping[str, object] | None = None,
    data: Mapping[str, object] | None = None,
) -> Result:
    """A result; ``values`` overrides metrics of the test set."""
    frames = FRAMES if frames is None else frames
    sets = {
        name: set_of(scene, name, names, psnr, depth, values if name == "test" else None)
        for name, names in frames.items()
    }
    costs = {
        "device": "a processor",
        "threads": 2,
        "train_seconds": 80.0,
        "processor_seconds": 150.0,
        "peak_memory_mib": 700.0,
        "render_fps": 12.5,
        "gaussians": 1040.0,
        "checkpoint_bytes": 3 * 2**20,
        "seconds_to_psnr": {"25": 10.0, "30": None},
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
        cost=CostRecord(**{**costs, **(cost or {})}),
        config={"name": method, "schedule": {"steps": steps}, **(config or {})},
        software={"package_version": "0.1.0", "git": "abc1234", "threads": 2, **(software or {})},
        provenance={
            "training": {"renderer": "torch", "renderer_reason": "no CUDA device"},
            "scene": {"dataset": "c3vd", "calibration": "legacy-pinhole", **(data or {})},
        },
    )


def write_run(folder: Path, result: Result, *, depth: float | None = 0.5) -> Path:
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


def write_comparison(
    folder: Path, results: Sequence[Result], failures: Sequence[tuple[str, str, int, str]] = ()
) -> Path:
    """The folder of a comparison, without run folders: results, and failures as (scene, method, seed, reason)."""
    for result in results:
        place = f"{result.scene.name}/{result.method.replace('/', '-')}/s{result.seed}-{result.key[:8]}.json"
        write_result(folder / "results" / place, result)
    for scene, method, seed, reason in failures:
        file = folder / "failures" / scene / method / f"s{seed}-{digest(scene, method)[:8]}.json"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps({"reason": reason}))
    if failures:
        write_plan(folder, results, *(failure[:3] for failure in failures))
    return folder


def write_plan(
    folder: Path, results: Sequence[Result], *more: tuple[str, str, int], decided: Mapping[str, object] | None = None
) -> None:
    """The plan of results, and of cells (scene, method, seed) without one."""
    cells = [(result.scene.name, result.method, result.seed, result.key) for result in results]
    cells += [(scene, method, seed, digest(scene, method)) for scene, method, seed in more]
    places = [f"{scene}/{method.replace('/', '-')}/s{seed}-{key[:8]}" for scene, method, seed, key in cells]
    entries = [
        {"scene": scene, "method": method, "seed": seed, "protocol": "paper", "key": "", "run": f"runs/{place}",
         "result": f"results/{place}.json"}
        for (scene, method, seed, _), place in zip(cells, places, strict=True)
    ]  # fmt: skip
    content = {"format": "coliags-comparison", "decided": decided, "cells": entries}
    (folder / "plan.json").write_text(json.dumps(content))


def decided(study: Study, *primary: str, reference: str = "coliags") -> Study:
    """The study as of a comparison that decided its reference and primary metrics before the first run."""
    return replace(study, decided=Decision(reference=reference, primary=primary, date="2026-11-01"))


def made_scenes(methods: Mapping[str, float], scenes: int = 8, seeds: int = 1, **options) -> list[Result]:
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
