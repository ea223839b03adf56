"""The example packages of docs/, installed beside this one as far as entry points can tell."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from runpy import run_path

import pytest
import torch

from coliags_plugin.checks.installation import INPUTS, strewn
from coliags_plugin.renderers.torch_renderer import TorchRenderer, TorchRendererSettings
from tests.scenes import write_wall

tomllib = pytest.importorskip("tomllib")  # Python 3.11

EXAMPLE = Path(__file__).parents[1] / "docs" / "example_package"
RENDERER = EXAMPLE.with_name("example_renderer")


@pytest.fixture
def coliags(request, tmp_path):
    """Runs the command line where an example is installed."""
    example = getattr(request, "param", EXAMPLE)
    project = tomllib.loads((example / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    info = tmp_path / "site" / f"{project['name']}-{project['version']}.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Name: {project['name']}\nVersion: {project['version']}\n", encoding="utf-8")
    groups = [
        f"[{group}]\n" + "".join(f"{name} = {value}\n" for name, value in entries.items())
        for group, entries in project["entry-points"].items()
    ]
    (info / "entry_points.txt").write_text("\n".join(groups), encoding="utf-8")
    places = [str(tmp_path / "site"), str(example), str(example.parents[1])]

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
    process = coliags("train", "round-gaussians", "--data", "wall", "--output", "run", *small)
    assert process.returncode == 0, process.stderr
    assert "module lens: all views have the same vignette" in process.stderr
    rows = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert rows[-1]["loss"] < rows[0]["loss"]
    assert set(rows[0]["terms"]) == {"l1"} and set(rows[-1]["terms"]) == {"l1", "smooth"}
    process = coliags("eval", "run")
    assert process.returncode == 0, process.stderr
    scores = json.loads((tmp_path / "run" / "eval" / "paper" / "metrics.json").read_text())
    assert scores["untrained_views"] == {"lens": "all views have the same vignette"}
    assert scores["psnr"] > 5


@pytest.mark.thorough
def test_the_example_keeps_the_contract(coliags, tmp_path):
    process = coliags("check", "method", "round-gaussians")
    assert process.returncode == 0, process.stdout + process.stderr
    assert "19 passed, 0 failed, 2 skipped" in process.stdout


def test_a_method_whose_file_is_missing_is_named(coliags, tmp_path):
    (info,) = (tmp_path / "site").glob("*.dist-info")
    (info / "entry_points.txt").write_text("[coliags_plugin.methods]\nghost = coliags_round\n", encoding="utf-8")
    process = coliags("list", "methods")
    assert process.returncode == 2
    assert (
        "entry point 'ghost' in coliags_plugin.methods names package coliags_round, which has no ghost.yaml"
        in process.stderr
    )


@pytest.mark.parametrize("coliags", [RENDERER], indirect=True)
def test_a_renderer_of_another_package_is_registered(coliags):
    process = coliags("list", "renderers")
    assert process.returncode == 0, process.stderr
    assert "(entry point coliags_gsplat:GsplatRenderer of coliags_gsplat 1.0)" in process.stdout
    renderer = renderer_class()
    assert renderer.obstacle("gaussians3d", torch.device("cpu")) == "runs on cuda, the device is cpu"
    assert "depth_expected" in renderer.outputs_of("gaussians3d") and "surfels" not in renderer.primitives


def renderer_class():
    """The class of the renderer that is not installed."""
    return run_path(str(RENDERER / "coliags_gsplat.py"))["COMPONENTS"]["renderers"]["gsplat"]


@pytest.mark.gpu
@pytest.mark.parametrize("count", [0, 1, 200])
def test_gsplat_gives_the_definition_s_numbers(count):
    """Rounding decides in few pixels, at a threshold; an image without Gaussians is the background, with a graph."""
    gsplat_renderer = renderer_class()
    if not gsplat_renderer.availability().ok:
        pytest.skip(gsplat_renderer.availability().reason)
    gaussians, camera = strewn(200, 96, 64, "gaussians3d")
    of = {name: getattr(gaussians, name)[:count] for name in (*INPUTS, "source_index", "visible_sources")}
    wants, background = ("depth_expected", "normals", "rgb"), (0.3, 0.1, 0.9)
    images, gradients = [], []
    for renderer, device in (
        (gsplat_renderer(gsplat_renderer.Settings(background=background)), "cuda"),
        (TorchRenderer(TorchRendererSettings(alpha_max=0.999, background=background)), "cpu"),
    ):
        moved = {name: values.to(device) for name, values in of.items()}
        leaves = {name: moved[name].requires_grad_() for name in INPUTS}
        output = renderer.draw(replace(gaussians, **moved), camera.to(device), wants)
        sum(output[name].square().sum() for name in wants).backward()
        images.append(torch.cat([output[name].detach().cpu().reshape(64, 96, -1) for name in wants], dim=-1))
        gradients.append([leaf.grad.cpu() for leaf in leaves.values()])
    differences = (images[0] - images[1]).abs().amax(-1)
    assert (differences > 1e-3).float().mean() <= 0.01
    for output, true in zip(*gradients, strict=True):
        assert (output - true).norm() <= 1e-2 * true.norm()
