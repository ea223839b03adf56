"""The example package of docs/, installed beside this one as far as entry points can tell."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.scenes import write_wall

tomllib = pytest.importorskip("tomllib")  # Python 3.11

EXAMPLE = Path(__file__).parents[1] / "docs" / "example_package"


@pytest.fixture
def coliags(tmp_path):
    """Runs the command line where the example is installed."""
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    info = tmp_path / "site" / f"{project['name']}-{project['version']}.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Name: {project['name']}\nVersion: {project['version']}\n", encoding="utf-8")
    groups = [
        f"[{group}]\n" + "".join(f"{name} = {value}\n" for name, value in entries.items())
        for group, entries in project["entry-points"].items()
    ]
    (info / "entry_points.txt").write_text("\n".join(groups), encoding="utf-8")
    places = [str(tmp_path / "site"), str(EXAMPLE), str(EXAMPLE.parents[1])]

    def run(*argv):
        command = [sys.executable, "-c", "from coliags_plugin.cli import main; main()", *map(str, argv)]
        env = {**os.environ, "PYTHONPATH": os.pathsep.join(places)}
        return subprocess.run(command, capture_output=True, text=True, check=False, env=env, cwd=tmp_path)

    return run


@pytest.mark.thorough
def test_the_example_trains_and_is_evaluated(coliags, tmp_path):
    write_wall(tmp_path / "wall")
    listed = coliags("list", "methods").stdout
    assert "round-gaussians" in listed and "an example of a method in another package" in listed
    assert "vignette" in coliags("list", "modules").stdout
    small = ("--steps", 30, "--set", "datamanager.points_count=2000", "--set", "schedule.log_every=1")
    done = coliags("train", "round-gaussians", "--data", "wall", "--output", "run", *small)
    assert done.returncode == 0, done.stderr
    assert "module lens: all views have the same vignette" in done.stderr
    rows = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert rows[-1]["loss"] < rows[0]["loss"]
    assert set(rows[0]["terms"]) == {"l1"} and set(rows[-1]["terms"]) == {"l1", "smooth"}
    done = coliags("eval", "run")
    assert done.returncode == 0, done.stderr
    scores = json.loads((tmp_path / "run" / "eval" / "paper" / "metrics.json").read_text())
    assert scores["untrained_views"] == {"lens": "all views have the same vignette"}
    assert scores["psnr"] > 5


@pytest.mark.thorough
def test_the_example_keeps_the_contract(coliags, tmp_path):
    done = coliags("check", "round-gaussians")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "19 passed, 0 failed, 2 skipped" in done.stdout


def test_a_method_whose_file_is_missing_is_named(coliags, tmp_path):
    (info,) = (tmp_path / "site").glob("*.dist-info")
    (info / "entry_points.txt").write_text("[coliags_plugin.methods]\nghost = coliags_round\n", encoding="utf-8")
    done = coliags("list", "methods")
    assert done.returncode == 2
    assert (
        "entry point 'ghost' in coliags_plugin.methods names package coliags_round, which has no ghost.yaml"
        in done.stderr
    )
