"""Scenes of unknown unit are trained at a size at which constants in mm mean something, and results have their own."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from coliags_plugin.config.options import ExportOptions, ImportOptions, TrainOptions
from coliags_plugin.core.images import read_rgb
from coliags_plugin.core.provenance import Provenance
from coliags_plugin.core.scenes import PointCloud
from coliags_plugin.engine import trained as trained_module
from coliags_plugin.engine import trainer as trainer_module
from coliags_plugin.engine.data_formats import UNKNOWN_MEDIAN_DEPTH, training_scale
from coliags_plugin.engine.evaluator import evaluate
from coliags_plugin.engine.held_light import flatten
from coliags_plugin.engine.rendering import render_view
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.engine.trained import load_trained
from coliags_plugin.engine.trainer import open_training
from coliags_plugin.export.baking import exporting
from coliags_plugin.export.baking.exporting import export_run, import_run
from coliags_plugin.export.splats.formats import read_splats, write_splats
from coliags_plugin.reporting.image_files import read_depth_tiff
from coliags_plugin.surface.meshing.fusion import fuse_run
from coliags_plugin.surface.meshing.views import MeshSettings
from tests.comparison.small import TINY
from tests.scenes import wall_scene

CPU = torch.device("cpu")
DEPTHS = ("rgb", "alpha", "depth_accumulated", "depth_expected", "inverse_depth_accumulated")


def with_unit(scene, unit):
    return replace(scene, provenance=Provenance(fingerprint="wall", dataset="c3vd", unit=unit))


@pytest.fixture(scope="module")
def small():
    """The wall in a unit of its own: 64 times as small."""
    return with_unit(wall_scene().scaled(1 / 64), "unknown")


@pytest.fixture(scope="module")
def factor(small):
    return training_scale(small)


def trained_on(scene, path, resumed=False):
    """A short run, loaded."""
    patch = pytest.MonkeyPatch()
    for module in (trainer_module, trained_module):
        patch.setattr(module, "load_scene", lambda config, _: scene.with_near_plane(config.near_plane))
    try:
        options = TrainOptions("coliags-plus", path, steps=6, settings=(*TINY, "datamanager.name=c3vd"))
        for if_exists in ("refuse", "continue") if resumed else ("refuse",):
            with open_training(options, RunFolder(path / "run"), CPU, if_exists) as trainer:
                trainer.train()
        return load_trained(path / "run", CPU)
    finally:
        patch.undo()


@pytest.fixture(scope="module")
def runs(small, factor, tmp_path_factory):
    """Runs on the small wall of unknown unit, and on the same wall in mm at the size at which the former is trained."""
    folder = tmp_path_factory.mktemp("runs")
    scenes = {"own": small, "mm": with_unit(small.scaled(factor), "mm")}
    return [trained_on(scene, folder / name, resumed=name == "own") for name, scene in scenes.items()]


def test_the_median_depth_in_view_becomes_that_of_a_colon(small, factor):
    assert float(small.scaled(factor).depths_in_view().median()) == pytest.approx(UNKNOWN_MEDIAN_DEPTH)
    assert training_scale(with_unit(small, "mm")) == 1.0
    assert training_scale(small.scaled(0.6 * factor)) == training_scale(small.scaled(1.9 * factor)) == 1.0
    assert training_scale(small.scaled(3.0 * factor)) == pytest.approx(1 / 3)
    assert training_scale(replace(small, points=PointCloud(torch.zeros(0, 3)))) == 1.0


@pytest.mark.thorough
def test_a_scene_of_unknown_unit_trains_like_the_same_in_mm(runs, factor):
    unscaled, mm = runs
    assert unscaled.provenance["scene"]["provenance"]["training_scale"] == unscaled.model.scale == factor
    assert mm.model.scale == 1.0 and unscaled.step == mm.step == 6
    for first, other in zip(unscaled.model.parameters(), mm.model.parameters(), strict=True):
        assert torch.equal(first, other)


def test_views_have_depths_in_their_own_unit(runs, factor):
    unscaled, mm = runs
    for first, other in zip(unscaled.scene.video, mm.scene.video, strict=True):
        view, at_scale = render_view(unscaled, first, DEPTHS), render_view(mm, other, DEPTHS)
        torch.testing.assert_close(view.rgb, at_scale.rgb, atol=1e-4, rtol=1e-4)
        torch.testing.assert_close(factor * view["depth_expected"], at_scale["depth_expected"], rtol=1e-3, atol=1e-3)
        inverse = view["inverse_depth_accumulated"] / factor
        torch.testing.assert_close(inverse, at_scale["inverse_depth_accumulated"], rtol=1e-3, atol=1e-4)
        torch.testing.assert_close(factor * view.camera.center, at_scale.camera.center, rtol=1e-4, atol=1e-4)
    flat, flat_mm = flatten(unscaled), flatten(mm)
    assert factor * flat.held.distance == pytest.approx(flat_mm.held.distance, rel=1e-3)
    first, other = (render_view(run, run.scene.train[0], DEPTHS[:3]) for run in (flat, flat_mm))
    torch.testing.assert_close(first.rgb, other.rgb, atol=1e-3, rtol=1e-3)
    torch.testing.assert_close(factor * first["depth_accumulated"], other["depth_accumulated"], rtol=1e-3, atol=1e-3)


def test_evaluations_are_in_its_own_unit(runs, factor):
    results = [evaluate(run, "paper") for run in runs]
    assert results[0].metrics["depth_median_error"].unit == "units"
    assert results[0].mean("psnr") == pytest.approx(results[1].mean("psnr"), abs=0.01)
    depths = [read_depth_tiff(next((run.run.evaluations / "paper/expected_depth/test").iterdir())) for run in runs]
    np.testing.assert_allclose(factor * depths[0], depths[1], rtol=1e-3)
    edges, edges_mm = (result.sets["test"].profiles["distance"].edges for result in results)
    np.testing.assert_allclose(factor * np.array(edges), edges_mm)
    pixels, pixels_mm = (sum(result.sets["test"].profiles["distance"].pixels) for result in results)
    assert 0 < pixels == pytest.approx(pixels_mm, rel=0.01)
    errors = [read_rgb(next((run.run.evaluations / "paper/errors/test").iterdir())) for run in runs]
    assert np.abs(errors[0].astype(int) - errors[1]).mean() < 1.0 and errors[1].std() > 5.0
    learned, learned_mm = (run.model.learned for run in runs)
    for name, numbers in learned["field"].items():  # of the model, at the size it was trained at
        np.testing.assert_allclose(numbers, learned_mm["field"][name], rtol=1e-4, atol=1e-6)


def test_meshes_and_gaussians_are_in_its_own_world(runs, factor, small, tmp_path, monkeypatch):
    meshes = [fuse_run(run, MeshSettings(min_views=1, min_alpha=0.5, voxel_pixels=1.0)).mesh for run in runs]
    bounds = [np.stack([mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)]) for mesh in meshes]
    np.testing.assert_allclose(factor * bounds[0], bounds[1], atol=1.0)
    assert factor**2 * meshes[0].areas.sum() == pytest.approx(meshes[1].areas.sum(), rel=0.05)
    files = [export_run(run, ExportOptions(tmp_path / f"{n}.ply", seconds=0.0))[0] for n, run in enumerate(runs)]
    clouds = [read_splats(file.file) for file in files]
    np.testing.assert_allclose(factor * clouds[0].means, clouds[1].means, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(factor * clouds[0].scales, clouds[1].scales, rtol=1e-2)
    records = [json.loads(file.record_file.read_text()) for file in files]
    assert [record["unit"] for record in records] == ["units", "mm"]
    shown, shown_mm = (record["measured"]["test"]["recorded"] for record in records)
    assert shown["psnr"] == pytest.approx(shown_mm["psnr"], abs=0.05)
    assert factor**2 * shown["depth_mse"] == pytest.approx(shown_mm["depth_mse"], rel=0.02)
    # Imported at any length, as much of it lies beyond the near plane.
    for length in (1.0, 1e-3):
        file, folder, scene = tmp_path / "small.ply", RunFolder(tmp_path / f"imported {length}"), small.scaled(length)
        write_splats(file, clouds[0].scaled(length), "ply")
        for module in (exporting, trained_module):
            monkeypatch.setattr(module, "load_scene", lambda config, _, s=scene: s.with_near_plane(config.near_plane))
        import_run(ImportOptions(file, tmp_path, data_format="c3vd"), folder, CPU)
        again = load_trained(folder.path, CPU)
        assert again.model.scale == pytest.approx(factor / length)
        psnr = evaluate(again, "paper").mean("psnr")
        assert psnr == pytest.approx(shown["psnr"], abs=0.01)
