"""Benchmarks run, as far as a few steps on a small scene tell; what they measure is not looked at."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tarfile
from importlib import import_module
from pathlib import Path

import cv2
import numpy as np
import pytest
import tyro

import coliags_plugin
from coliags_plugin.core.images import read_rgb, write_image
from tests.comparison.small import InlineExecutor
from tests.pipeline.reconstructions import SUBMAPS, join, similarity, write_long
from tests.scenes import write_wall
from tests.textured_tube import tube_frames

pytestmark = pytest.mark.thorough

ROOT = Path(__file__).parents[1]
#: But reim-nerf, whose networks are as large on the smallest scene.
METHODS = sorted({path.stem for path in (ROOT / "method_configs").glob("*.yaml")} - {"reim-nerf"})
SIZE = ("--size", "48x36")


@pytest.fixture
def run(monkeypatch, capsys):
    """Runs a benchmark in this process and returns what it prints."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))

    def of(name, *argv):
        benchmark = import_module(name)
        benchmark.main(tyro.cli(benchmark.Options, args=list(map(str, argv))))
        return capsys.readouterr().out

    return of


@pytest.mark.parametrize("is_right", [True, False])
def test_joins_of_a_procedure_are_judged_by_its_truth(run, monkeypatch, tmp_path, is_right):
    monkeypatch.setattr(import_module("procedure"), "FRAMES", 58)
    tube_poses = [frame.camera.camera_to_world.numpy() for frame in tube_frames(14, 1.0, (40, 32))]
    of_both = np.eye(4) if is_right else similarity(1)
    joined = join(["segment-000", "segment-001"], ["sparse/2", "sparse/0"], of_both)
    out = write_long(tmp_path / "out", joins=[joined])
    phantom = tmp_path / "phantoms" / "phantom-0"
    poses, depths = np.tile(np.eye(4), (58, 1, 1)), np.full(58, 65535, np.uint16)
    for name, frames in reversed(SUBMAPS.items()):  # of frames that two have, the depth is that of the first
        poses[frames.start : frames.stop] = tube_poses[: len(frames)]
        depths[frames.start : frames.stop] = round(2.0 * (1 + int(name[-1])) / 100.0 * 65535)
    for number, depth in enumerate(depths):
        write_image(phantom / "depths" / f"{number:04d}_depth.png", np.full((32, 40), depth))
    (phantom / "truth").mkdir()
    np.save(phantom / "truth" / "camera_to_wall.npy", poses)
    table = run("procedure", "judge", tmp_path / "phantoms", out)
    assert "| frames | 100 |" in table and "| of these posed, % | 98.28 |" in table and "| others posed | 0 |" in table
    assert "| ATE, mm | 0.01 (median of 6), 0.00 to 0.02 |" in table and "| poses of another phantom | 0 |" in table
    assert f"| joins of segments | {'1 right, 0 wrong' if is_right else '0 right, 1 wrong'}, 0 not judged |" in table


def test_results_are_packed_tabulated_and_drawn(monkeypatch, tmp_path):
    monkeypatch.setattr("coliags_plugin.comparison.compare.make_executor", lambda options: InlineExecutor())
    monkeypatch.syspath_prepend(str(ROOT / "docs" / "tools"))
    tool, scene, out = import_module("results"), write_wall(tmp_path / "wall", frames=16), tmp_path / "walls"
    coliags_plugin.compare(["coliags", "3dgs-depth"], [scene], out, steps=2, seeds=2, jobs=1)
    shutil.rmtree(next(out.glob("results/*/3dgs-depth")))
    first = tmp_path / "first.tar.xz"
    for archive in (first, tmp_path / "second.tar.xz"):
        tool.pack([out], archive)
    assert first.read_bytes() == (tmp_path / "second.tar.xz").read_bytes()
    with tarfile.open(first) as archive:
        archive.extractall(tmp_path / "packed", filter="data")
    page = "".join(f"<!-- table walls {kind} -->\nold<!-- end -->" for kind in tool.TABLES)
    tables = tool.filled(page, tmp_path / "packed")
    assert "old" not in tables and "3dgs-depth" not in tables, "cells without a result are left out"
    runs = [coliags_plugin.load_run(path) for path in out.glob("runs/*/coliags/s*")]
    psnr = np.mean([run.results["paper"].mean("psnr") for run in runs])
    assert len(runs) == 2 and f"\n| coliags | {psnr:.2f} | " in tables
    for name, value in (("SHOWN", ("coliags",)), ("CHOSEN_BY", {"test": "psnr"})):
        monkeypatch.setattr(tool, name, value)
    drawn = tool.draw(out)
    height, width = (2 * size for size in read_rgb(next((scene / "images").glob("*.png"))).shape[:2])
    assert drawn.shape == (2 * (24 + height) + 24 + 52, max(2 * width + 8, 480), 3), "two rows, and a scale"
    shown = cv2.resize(drawn[48 : 48 + height, :width], None, fx=0.5, fy=0.5).astype(float)
    assert min(np.abs(shown - read_rgb(path)).mean() for path in (scene / "images").glob("*.png")) < 8


def test_a_factor_of_depth_is_measured_exactly(run, tmp_path):
    truth = write_wall(tmp_path / "truth")
    estimate = Path(shutil.copytree(truth, tmp_path / "estimate"))
    for path in (estimate / "depths").iterdir():
        stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(path), np.rint(stored * 0.9).astype(np.uint16))
    run("depth_check", estimate, truth, "--json", tmp_path / "rows.json")
    plain, scaled = json.loads((tmp_path / "rows.json").read_text())
    assert plain["median %"] == pytest.approx(10.0, abs=0.01) and plain["bias %"] == pytest.approx(-10.0, abs=0.01)
    assert plain["of truth %"] == 100.0 and plain["within 5 %"] == 0.0
    assert scaled["pixels"] == "all, times 1.111"
    assert scaled["90th %"] < 0.01 and scaled["within 5 %"] == 100.0


def test_errors_of_depth_by_confidence(monkeypatch):
    """A hundredth of a bin's pixels for each hundredth of its confidence is good, and one pixel has no estimate."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    stated = np.repeat([0.25, 0.75], 100)
    good = np.concatenate([np.arange(100) < 25, np.arange(100) < 75])
    estimates = np.stack([np.where(good, 20.0, 30.0), np.full(200, 20.0), stated], axis=1)
    estimates[-1, 0] = np.nan
    _, _, low, high = import_module("depth_check").rows_of(estimates)
    assert [row["pixels"] for row in (low, high)] == ["confidence 0.2 to 0.3", "confidence 0.7 to 0.8"]
    assert low["within 5 %"] == low["stated %"] == 25.0
    assert high["within 5 %"] == pytest.approx(100 * 75 / 99) and high["stated %"] == 75.0


SURFELS = ("--backends", "cpu", "--primitives", "flat,surfels", "--counts", 300, "--repeats", 1, "--patience", 0.01)


@pytest.mark.parametrize(
    ("name", "argv", "cells"),
    [
        ("train_stages", ("--anchors", 300, "--steps", 1, *SIZE, "--renderers", "cpu"), ["render ms", "cpu | 300"]),
        ("rasterizer", (*SURFELS, "--scene", "lining"), ["cpu | flat | 300", "cpu | surfels | 300", "both, of flat"]),
        ("load_scene", ("--frames", 20, *SIZE), ["True | 20 | 48x36"]),
    ],
)
def test_tables_that_are_printed(run, name, argv, cells):
    table = run(name, *argv)
    assert [cell for cell in cells if f"| {cell} |" not in table] == []


def test_differences_between_renderers(run, tmp_path):
    run("rasterizer", "--backends", "torch,cpu", "--counts", 300, "--repeats", 1, "--json", tmp_path / "rows.json")
    first, second = json.loads((tmp_path / "rows.json").read_text())
    assert first["outputs_differ"] == first["gradients_differ"] == 0
    assert all(0 < second[name] < 1e-3 for name in ("outputs_differ", "gradients_differ"))


def test_the_training_step_of_every_method(run):
    table = run("train_step", "--methods", ",".join(METHODS), "--gaussians", 500, "--steps", 1, *SIZE)
    assert [row.split("|")[1].strip() for row in table.splitlines() if row.startswith("| ")][1:] == METHODS


def test_growth_with_anchors_pixels_and_frames(run, tmp_path):
    sizes = ("--anchors", "300,600", "--sizes", "48x36", "--frames", "20,40")
    printed = run("growth", *sizes, "--steps", 1, "--json", tmp_path / "rows.json")
    rows = json.loads((tmp_path / "rows.json").read_text())
    assert [(row["along"], row["size"]) for row in rows] == [
        *(("anchors", 300), ("anchors", 600), ("pixels", 48 * 36), ("frames", 20), ("frames", 40)),
    ]
    assert all(row["peak_mib"] >= row["before_mib"] > 0 and row["ms"] > 0 for row in rows)
    assert "frames: exponents of time" in printed and "pixels: exponents" not in printed


def gpu_script(folder, *argv, **variables):
    """Exit status, parts by name, and the summary of `gpu.sh` on the CPU."""
    command = [str(ROOT / "benchmarks" / "gpu.sh"), "--device", "cpu", "--small", "--out", str(folder), *argv]
    environment = {**os.environ, "PYTHON": sys.executable, **variables}
    process = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=900)
    parts = [json.loads(line) for line in (folder / "parts.jsonl").read_text().splitlines()]
    return (
        process.returncode,
        {part["part"]: part["status"] for part in parts},
        (folder / "summary").with_suffix(".md").read_text(),
    )


def test_everything_for_a_gpu_runs_on_a_cpu(tmp_path):
    status, parts, summary = gpu_script(tmp_path / "out")
    assert status == 0 and set(parts.values()) == {"ok"}, summary
    assert list(parts)[:4] == ["installation", "tests", "rasterizer", "against-torch"] and list(parts)[-1] == "report"
    assert {"step-coliags", "frames-per-second", "comparison", "run-3dgs", "eval-3dgs"} <= parts.keys()
    assert "| step-coliags | ok |" in summary and "| cpu | surfels | 300 |" in summary and "1 of 1" in summary
    for name in ("rasterizer", "against-torch", "step-3dgs", "frames-per-second"):
        assert json.loads((tmp_path / "out" / f"{name}.json").read_text())
    assert (tmp_path / "out" / "report").with_suffix(".md").is_file()


def test_a_part_for_a_gpu_that_fails_is_recorded_and_the_others_run(tmp_path):
    status, parts, summary = gpu_script(tmp_path / "out", "--device", "cuda", PYTHON="false")
    assert status == 1 and set(parts.values()) == {"failed (1)"} and len(parts) > 6
    assert "## installation: failed (1)" in summary
    status, parts, _ = gpu_script(tmp_path / "idle", "--device", "cuda", PYTHON="true")
    assert status == 0 and set(parts.values()) == {"ok"} and list(parts)[-1] == "report"
    status, parts, _ = gpu_script(tmp_path / "late", "--minutes", "0")
    assert status == 0 and set(parts.values()) == {"no time left"}
