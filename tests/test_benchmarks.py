"""Benchmarks run, as far as a few steps on a small scene tell; what they measure is not looked at."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from coliags_plugin.core.images import read_rgb
from tests.scenes import write_wall

pytestmark = pytest.mark.thorough

ROOT = Path(__file__).parents[1]
METHODS = ROOT / "method_configs"


def run(script, *argv):
    command = [sys.executable, str(ROOT / "benchmarks" / script), *map(str, argv)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_training_step_by_stages():
    table = run("train_stages.py", "--anchors", 300, "--steps", 1, "--size", "48x36", "--renderers", "cpu")
    assert "| render ms |" in table and "| cpu | 300 |" in table


@pytest.mark.parametrize("scene", ["wall", "lining"])
def test_surfels_beside_3d_gaussians(scene):
    options = ("--counts", 300, "--repeats", 1, "--patience", 0.01, "--scene", scene)
    table = run("rasterizer.py", "--backends", "cpu", "--primitives", "flat,surfels", *options)
    assert "| cpu | flat | 300 |" in table and "| cpu | surfels | 300 |" in table and "| both, of flat |" in table


def test_the_training_step_of_every_method():
    """But of reim-nerf, whose networks are as large on the smallest scene."""
    methods = sorted({path.stem for path in METHODS.glob("*.yaml")} - {"reim-nerf"})
    options = ("--gaussians", 500, "--steps", 1, "--size", "48x36")
    table = run("train_step.py", "--methods", ",".join(methods), *options)
    assert [row.split("|")[1].strip() for row in table.splitlines() if row.startswith("| ")][1:] == methods


@pytest.mark.parametrize("method", ["coliags", "3dgs"])
def test_a_training_curve(method, tmp_path):
    write_wall(tmp_path / "wall")
    options = ("--steps", 4, "--every", 2, "--set", "datamanager.points_count=500")
    run("training_curve.py", "--data", tmp_path / "wall", "--method", method, "--out", tmp_path / "run", *options)
    rows = [json.loads(line) for line in (tmp_path / "run" / "curve.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows] == [2, 4]
    assert all(row["elements"] > 0 and row["psnr"] > 0 and row["depth_mse"] >= 0 for row in rows)


def test_updates_of_the_browser_view():
    pytest.importorskip("viser")
    assert "| 300 anchors |" in run("view.py", "--anchors", 300, "--repeats", 1)


@pytest.mark.slow
def test_all_methods_on_a_scene(tmp_path):
    write_wall(tmp_path / "wall")
    options = ("--data", tmp_path / "wall", "--out", tmp_path / "runs", "--steps", 3)
    run("all_methods.py", *options, "--methods", "coliags", "--timed", "3dgs")
    rows = json.loads((tmp_path / "runs" / "table.json").read_text())
    assert [row["method"] for row in rows] == ["coliags", "3dgs"]
    assert all(row["peak MiB"] > 100 and float(row["PSNR dB"]) > 0 and row["steps"] >= 1 for row in rows)
    sheet = read_rgb(tmp_path / "runs" / "sheet.jpg")
    assert sheet.shape == (3 * 12, 2 * 16, 3)  # truth and two runs; colour and depth of the one test set
    stamp = (tmp_path / "runs" / "coliags" / "config.yaml").stat().st_mtime_ns
    run("all_methods.py", *options, "--methods", "coliags", "--timed", "3dgs")
    assert (tmp_path / "runs" / "coliags" / "config.yaml").stat().st_mtime_ns == stamp
