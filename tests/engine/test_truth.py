"""Evaluation of a run on estimated depth against the scene with the true depth."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.provenance import Provenance, SplitRecord
from coliags_plugin.core.scenes import SparseDepth
from coliags_plugin.engine import trained as trained_module
from coliags_plugin.engine.evaluator import evaluate
from coliags_plugin.engine.trained import load_trained
from coliags_plugin.engine.truth import match_truth
from tests.engine.test_trainer import make_trainer
from tests.scenes import wall_scene

CPU = torch.device("cpu")


def changed(scene, change, **values):
    sets = {name: [change(frame) for frame in frames] for name, frames in scene.test_sets.items()}
    return replace(scene, train=[change(frame) for frame in scene.train], test_sets=sets, **values)


@pytest.fixture(scope="module")
def true():
    """A scene with views beyond the path, whose seen masks are of this scene's split."""
    wall = wall_scene()
    mask = torch.zeros(24, 32, dtype=torch.bool)
    mask[:, :16] = True
    turned = [replace(frame.with_maps(seen=mask), name=f"turned-{frame.name}") for frame in wall.test_sets["test"]]
    provenance = Provenance(fingerprint="true", split=SplitRecord(name="every-8th"))
    return replace(wall, name="phantom", test_sets={**wall.test_sets, "rotation": turned}, provenance=provenance)


@pytest.fixture(scope="module")
def estimated(true):
    def change(frame):
        confidence = torch.full_like(frame.depth, 0.5)
        points = SparseDepth(torch.tensor([[5.5, 5.5], [20.0, 12.0]]), torch.tensor([20.0, 20.0]))
        estimate = frame.with_maps(depth=1.03 * frame.depth, depth_confidence=confidence, seen=None)
        return replace(estimate, sparse_depth=points)

    sets = {"test": true.test_sets["test"]}
    split = SplitRecord(name="own")
    provenance = Provenance(fingerprint="estimated", split=split, unit="unknown", dataset="nerfstudio")
    return changed(replace(true, test_sets=sets), change, name="estimate", provenance=provenance)


def renamed(scene):
    return changed(scene, lambda frame: replace(frame, name=f"frame_{frame.index:05d}"))


@pytest.fixture(scope="module")
def trained(estimated, tmp_path_factory):
    patch = pytest.MonkeyPatch()
    patch.setattr(trained_module, "load_scene", lambda config, path: estimated)
    path = tmp_path_factory.mktemp("runs") / "run"
    trainer = make_trainer(path, scene=estimated, steps=4, method="coliags-estimated-depth")
    trainer.start()
    trainer.train()
    yield load_trained(path, CPU)
    patch.undo()


def test_frames_are_matched_by_name(true, estimated):
    truth = match_truth(estimated, true)
    assert truth.matched_by == "name"
    assert [frame.name for frame in truth.scene.train] == [frame.name for frame in true.train]
    assert truth.scene.test_sets["test"] == true.test_sets["test"]
    assert truth.scene.test_sets["rotation"] == true.test_sets["rotation"]
    assert truth.scene.provenance.split_name == "every-8th"


def test_or_by_index_where_names_differ(true, estimated):
    truth = match_truth(renamed(estimated), true)
    assert truth.matched_by == "index"
    assert [frame.name for frame in truth.scene.test_sets["test"]] == [f.name for f in true.test_sets["test"]]


def test_of_another_split_the_seen_masks_do_not_hold(true, estimated):
    moved = [*estimated.train[1:], *estimated.test_sets["test"]]
    own_scene = replace(estimated, train=moved, test_sets={"test": estimated.train[:1]})
    truth = match_truth(own_scene, true)
    assert truth.scene.provenance.split_name == "own"
    assert [frame.name for frame in truth.scene.test_sets["test"]] == [estimated.train[0].name]
    assert all(frame.seen is None for frames in truth.scene.test_sets.values() for frame in frames)


def test_other_frames_and_other_worlds_are_refused(true, estimated):
    with pytest.raises(InputError, match=r"no frame 'frame_0000\d', and 8 frames for the 9 of scene 'estimate'"):
        match_truth(renamed(estimated), replace(true, train=true.train[1:]))

    def scaled(frame):
        matrix = frame.camera.camera_to_world.clone()
        matrix[:3, 3] *= 1.5
        return replace(frame, camera=replace(frame.camera, camera_to_world=matrix))

    with pytest.raises(InputError, match=r"units away from its place in scene 'phantom'.*same poses"):
        match_truth(changed(estimated, scaled), true)


def test_on_its_own_scene_depth_metrics_have_a_reason(trained):
    result = evaluate(trained, "paper")
    assert result.scene.name == "estimate"
    assert result.mean("depth_mse") is None and result.mean("psnr") is not None
    assert result.sets["test"].reasons["depth_mse"] == "estimated depth is no truth"
    assert result.metrics["depth_mse"].unit == "units^2" and result.metrics["sparse_depth_median"].unit == "%"
    assert result.mean("sparse_depth_median") <= result.mean("sparse_depth_p90")
    text = str(result)
    assert "\ndepth_mse" not in text.split("not shown", maxsplit=1)[0] and "estimated depth is no truth" in text
    assert result.evaluation_name == "paper"


def test_against_the_truth_they_are_measured(trained, true):
    result, own_result = evaluate(trained, "paper", true), evaluate(trained, "paper")
    assert result.evaluation_name == "paper-truth" and own_result.evaluation_name == "paper"
    assert result.key != own_result.key
    assert result.title.startswith("coliags-estimated-depth on phantom (trained on estimate), seed 0")
    assert result.scene.name == "phantom" and result.scene.fingerprint == "true" and result.scene.split == "every-8th"
    assert result.mean("psnr") == own_result.mean("psnr")
    assert all(result.mean("depth_mse", name) is not None for name in ("test", "rotation"))
    assert result.mean("psnr_seen", "rotation") is not None
    assert result.metrics["depth_mse"].unit == "mm^2" and "sparse_depth_median" not in result.metrics
    assert result.provenance["truth"]["matched_by"] == "name"
    assert result.provenance["truth"]["trained_on"]["fingerprint"] == "estimated"
    assert (trained.run.evaluations / "paper-truth" / "depth" / "rotation").is_dir()
