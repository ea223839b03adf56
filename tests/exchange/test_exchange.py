"""Runs to files of Gaussians and back."""

from __future__ import annotations

import json

import numpy as np
import pytest

import coliags_plugin as cp
from coliags_plugin.config.assignments import parse_assignments
from coliags_plugin.exchange import refinement
from coliags_plugin.splats.files import read_splats
from tests.scenes import SMALL, write_wall

EXPLICIT = parse_assignments([SMALL[0], SMALL[2]])


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_wall(tmp_path_factory.mktemp("data") / "wall")


@pytest.fixture(scope="module")
def runs(scene, tmp_path_factory):
    """Runs by method, trained for a few steps when first asked for."""
    folder, made = tmp_path_factory.mktemp("runs"), {}

    def trained(method, steps=3):
        if method not in made:
            settings = parse_assignments(SMALL) if method in ("coliags", "scaffold-gs") else EXPLICIT
            made[method] = cp.train(method, scene, folder / method, steps=steps, settings=settings)
        return made[method]

    return trained


@pytest.fixture
def few_steps(monkeypatch):
    monkeypatch.setattr(refinement, "STEPS", 4)


def test_an_imported_export_renders_what_the_run_renders(runs, scene, tmp_path):
    trained = runs("3dgs")
    exported = trained.export(tmp_path / "wall.ply")
    again = cp.import_splats(exported.file, scene, tmp_path / "imported")
    assert again.method == "3dgs" and again.step == 0
    name = trained.frame_names()[0]
    ours, theirs = trained.render(name), again.render(name)
    assert np.abs(ours.rgb.astype(int) - theirs.rgb).max() <= 1
    np.testing.assert_allclose(theirs.depth, ours.depth, atol=1e-3)
    record = json.loads((tmp_path / "wall.ply.json").read_text())
    assert record["baking"] is None and record["unit"] == "mm" and record["run"]["method"] == "3dgs"
    assert record["gaussians"] == len(read_splats(exported.file))
    assert abs(record["cost"]["test"]["cost"]["psnr"]) < 1e-3
    psnr = trained.evaluate().mean("psnr")
    assert record["cost"]["test"]["run"]["psnr"] == pytest.approx(psnr, abs=1e-6)
    assert again.evaluate().mean("psnr") == pytest.approx(psnr, abs=1e-3)
    assert again.load().provenance["imported"]["gaussians"] == record["gaussians"]
