"""Evaluation: results say what the run was, whatever interrupted it; truth beside the scene; scores of views."""

from __future__ import annotations

import json
from dataclasses import replace
from unittest import mock

import numpy as np
import pytest
import torch

from coliags_plugin import __version__
from coliags_plugin.config.method_config import load_method
from coliags_plugin.contracts import Comparison
from coliags_plugin.core import registry
from coliags_plugin.core.errors import InputError, UnavailableError
from coliags_plugin.core.provenance import Provenance, SplitRecord
from coliags_plugin.core.scenes import SparseDepth
from coliags_plugin.engine import trained as trained_module
from coliags_plugin.engine.checkpoints import checkpoint_folder
from coliags_plugin.engine.devices import device_name
from coliags_plugin.engine.evaluator import evaluate, match_truth
from coliags_plugin.engine.scoring import EvaluatedSet, Scorer
from coliags_plugin.engine.trained import load_trained
from coliags_plugin.metrics.pixels import PSNR
from coliags_plugin.metrics.protocols import PaperProtocol
from coliags_plugin.results.hashing import code_key, result_key
from coliags_plugin.results.reading import RESULT_FILE, per_frame_table, read_result
from tests.engine.test_trainer import kill, make_trainer
from tests.scenes import SMALL, plain_frame, wall_scene

CPU = torch.device("cpu")
STEPS = 6


@pytest.fixture(scope="module")
def scene():
    """A scene with a second test set, whose frames have seen masks, and points from a test frame's image."""
    wall = wall_scene()
    left = torch.zeros(24, 32, dtype=torch.bool)
    left[:, :16] = True
    turned = [replace(frame.with_maps(seen=left), name=f"turned-{frame.name}") for frame in wall.test_sets["test"]]
    provenance = wall.provenance.model_copy(update={"held_out_used": {"points": ["0000"]}})
    return replace(wall, test_sets={**wall.test_sets, "rotation": turned}, provenance=provenance)


@pytest.fixture(scope="module")
def loaded(scene, tmp_path_factory):
    """Trains and loads a run, of the scene if of no other."""
    patch = pytest.MonkeyPatch()
    folder, count = tmp_path_factory.mktemp("runs"), iter(range(99))

    def make(stop=None, resume_to=None, **options):
        path = folder / str(next(count))
        options = {"scene": scene, "steps": STEPS, **options}
        trainer = make_trainer(path, **options)
        trainer.start()
        if stop is not None:
            kill(trainer, stop)
            with pytest.raises(RuntimeError):
                trainer.train()
        else:
            trainer.train()
        if resume_to is not None:
            again = make_trainer(path, **{**options, "steps": resume_to})
            again.resume()
            again.train()
        patch.setattr(trained_module, "load_scene", lambda config, path: options["scene"])
        return load_trained(path, CPU)

    yield make
    patch.undo()


@pytest.fixture(scope="module")
def whole(loaded):
    return loaded()


@pytest.fixture(scope="module")
def result(whole):
    return evaluate(whole, "paper")


def test_it_says_what_the_run_was_and_cost(result, whole, scene):
    config = load_method("coliags", [*SMALL, f"schedule.steps={STEPS}"]).config.model_dump()
    assert (result.method, result.seed, result.steps) == ("coliags", 0, STEPS)
    assert result.key == result_key(config, "wall-9-True", 0, code_key(), "paper", 1)
    assert result.config["schedule"]["steps"] == STEPS and result.config["field"]["voxel_size"] == 2.0
    assert result.scene.train == tuple(frame.name for frame in scene.train)
    assert (result.scene.name, result.scene.size) == ("wall", (32, 24))
    assert (result.software["package_version"], result.software["code"]) == (__version__, code_key())
    assert result.provenance["training"]["renderer"] == "cpu"
    assert result.provenance["held_out_used"] == result.summary()["held_out_used"] == {"points": ["0000"]}
    cost, last = result.cost, whole.run.log_rows(STEPS)[-1]
    assert cost.device == cost.render_device == device_name(CPU)
    assert cost.threads == cost.render_threads == torch.get_num_threads()
    assert cost.train_seconds == pytest.approx(last["seconds"], abs=0.5) and cost.processor_seconds > 0
    assert cost.peak_memory_mib > 50 and cost.render_fps > 0
    assert 0 < cost.gaussians <= 2 * last["gaussians"]
    folder = checkpoint_folder(whole.run.checkpoints, STEPS)
    assert cost.checkpoint_bytes == sum(path.stat().st_size for path in folder.iterdir())
    assert set(cost.seconds_to_psnr) == {"25", "30", "32", "34", "36", "38", "40"}


def test_its_values_are_those_of_the_metrics(result, whole, scene):
    scorer = Scorer("paper")
    for name, frames in scene.test_sets.items():
        part = result.sets[name]
        assert part.frames == tuple(frame.name for frame in frames)
        for index, frame in enumerate(frames):
            scores = scorer.score(scorer.compare(whole.model, frame, CPU))
            assert scores.values == {
                metric: part.values[metric][index]
                for metric in scorer.metrics | scorer.optional_metrics
                if metric in part.values and part.values[metric][index] is not None
            }
        assert list(part.values)[: len(scorer.metrics)] == list(scorer.metrics)


def test_metrics_over_seen_pixels_belong_to_frames_with_a_mask(result):
    assert "psnr_seen" not in result.sets["test"].values
    over_seen, everywhere = (result.sets["rotation"].values[name] for name in ("psnr_seen", "psnr"))
    assert all(value is not None for value in over_seen) and over_seen != everywhere
    assert list(result.metrics)[-5:] == [
        "psnr_seen", "psnr_gain_fitted_seen", "ssim_seen", "depth_mse_seen", "depth_median_error_seen",
    ]  # fmt: skip
    for suffix in ("", "_seen"):
        fitted, plain = (result.sets["rotation"].values[name + suffix] for name in ("psnr_gain_fitted", "psnr"))
        assert all(fitted_value >= other for fitted_value, other in zip(fitted, plain, strict=True))
    assert result.metrics["depth_mse_seen"] == result.metrics["depth_mse"]


@pytest.mark.thorough
def test_refined_poses_add_metrics_and_change_no_other(result, loaded):
    other_result = evaluate(loaded(), "paper", refine_poses=True)
    added = ["psnr_pose_refined", "ssim_pose_refined", "psnr_pose_color_refined", "ssim_pose_color_refined"]
    assert list(other_result.metrics) == [*result.metrics, *added]
    for name, part in result.sets.items():
        refined_part = other_result.sets[name]
        assert {key: refined_part.values[key] for key in part.values} == part.values
        assert refined_part.predictions_sha256 == part.predictions_sha256
        assert all(None not in refined_part.values[key] for key in added)
    assert other_result.metrics["psnr_pose_refined"] == result.metrics["psnr"] and other_result.key != result.key
    assert other_result.summary()["psnr_pose_refined"] == other_result.mean("psnr_pose_refined")


def test_the_other_files_are_made_of_it(result, whole):
    folder = whole.run.evaluation("paper")
    assert read_result(folder / RESULT_FILE) == result
    assert json.loads((folder / "metrics.json").read_text()) == json.loads(json.dumps(result.summary()))
    assert (folder / "per_frame.csv").read_text() == per_frame_table(result)


def test_profiles_and_metrics_agree(result):
    """The pixels of all bins together have the mean squared errors of the metrics, all frames having as many."""
    for part in result.sets.values():
        for profile in part.profiles.values():
            pixels = np.array(profile.pixels)
            assert pixels.sum() == 24 * 32 * len(part.frames)
            depth = sum(count * (mse or 0.0) for count, mse in zip(pixels, profile.depth_mse, strict=True))
            assert depth / pixels.sum() == pytest.approx(part.mean("depth_mse"), rel=1e-6)
            colour = sum(count * (mse or 0.0) for count, mse in zip(pixels, profile.rgb_mse, strict=True))
            means = [10 ** (-psnr / 10) for psnr in part.values["psnr"]]
            assert colour / pixels.sum() == pytest.approx(np.mean(means), rel=1e-6)


def test_hashes_and_keys_change_with_model_truth_and_code(loaded, result, scene):
    same = loaded()
    other_model = evaluate(loaded(seed=1), "paper")
    assert other_model.metrics_sha256 != result.metrics_sha256
    for name, part in result.sets.items():
        assert other_model.sets[name].predictions_sha256 != part.predictions_sha256
        assert other_model.sets[name].truth_sha256 == part.truth_sha256
    seen = torch.ones(24, 32, dtype=torch.bool)
    everything = [frame.with_maps(seen=seen) for frame in scene.test_sets["rotation"]]
    other = evaluate(replace(same, scene=replace(scene, test_sets={"rotation": everything})), "paper")
    assert other.sets["rotation"].predictions_sha256 == result.sets["rotation"].predictions_sha256
    assert other.sets["rotation"].truth_sha256 != result.sets["rotation"].truth_sha256
    code = {"code": "0123456789abcdef"}  # all the way, or from the middle on
    provenances = [same.provenance | change for change in (code, {"code_changes": [{"at_step": 3, **code}]})]
    keys = [evaluate(replace(same, provenance=provenance), "paper").key for provenance in provenances]
    assert len({*keys, result.key, other_model.key}) == 4


@pytest.mark.thorough
def test_runs_that_did_not_go_as_configured_have_keys_of_their_own(loaded, result):
    """Stopped half-way, or with a schedule that was changed on the way: neither is a run of so many steps."""
    half = loaded(stop=4, overrides=["schedule.checkpoint_every=3"])
    straight = loaded(overrides=["schedule.checkpoint_every=3"])
    jumped = loaded(steps=3, resume_to=STEPS, overrides=["schedule.checkpoint_every=3"])
    logged = loaded(stop=4, resume_to=STEPS, overrides=["schedule.checkpoint_every=3"])
    keys = [evaluate(run, "paper").key for run in (half, straight, jumped, logged)]
    assert half.step == 3
    assert len(set(keys[:3])) == 3 and keys[3] == keys[1]


def test_a_run_without_a_seed_is_refused(whole):
    text = whole.run.provenance_file.read_text()
    whole.run.provenance_file.write_text(text.replace('"seed"', '"sead"'))
    with pytest.raises(InputError, match="lacks 'seed'"):
        load_trained(whole.run.path, CPU)
    whole.run.provenance_file.write_text(text)


# Of a run on estimated depth, against the scene with the true depth


def changed(scene, change, **values):
    sets = {name: [change(frame) for frame in frames] for name, frames in scene.test_sets.items()}
    return replace(scene, train=[change(frame) for frame in scene.train], test_sets=sets, **values)


@pytest.fixture(scope="module")
def true(scene):
    """The scene, whose seen masks are of its split."""
    provenance = Provenance(fingerprint="true", split=SplitRecord(name="every-8th"))
    return replace(scene, name="phantom", provenance=provenance)


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
def trained(loaded, estimated):
    return loaded(scene=estimated, steps=4, method="coliags-plus")


def test_frames_are_matched_by_name_or_by_index_where_names_differ(true, estimated):
    truth = match_truth(estimated, true)
    assert truth.matched_by == "name"
    assert [frame.name for frame in truth.scene.train] == [frame.name for frame in true.train]
    assert truth.scene.test_sets["test"] == true.test_sets["test"]
    assert truth.scene.test_sets["rotation"] == true.test_sets["rotation"]
    assert truth.scene.provenance.split_name == "every-8th"
    renumbered = match_truth(renamed(estimated), true)
    assert renumbered.matched_by == "index" and renumbered.scene.test_sets["test"] == true.test_sets["test"]


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

    with pytest.raises(InputError, match=r"units away from its place in scene 'phantom'.*same poses"):
        match_truth(estimated.scaled(1.5), true)


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
    assert result.title.startswith("coliags-plus on phantom (trained on estimate), seed 0")
    assert result.scene.name == "phantom" and result.scene.fingerprint == "true" and result.scene.split == "every-8th"
    assert result.mean("psnr") == own_result.mean("psnr")
    assert all(result.mean("depth_mse", name) is not None for name in ("test", "rotation"))
    assert result.mean("psnr_seen", "rotation") is not None
    assert result.metrics["depth_mse"].unit == "mm^2" and "sparse_depth_median" not in result.metrics
    assert result.provenance["truth"]["matched_by"] == "name"
    assert result.provenance["truth"]["trained_on"]["fingerprint"] == "estimated"
    assert (trained.run.evaluations / "paper-truth" / "depth" / "rotation").is_dir()


# Single views, and protocols


def comparison(error=0.1):
    truth = torch.full((16, 16, 3), 0.5)
    return Comparison(truth + error, truth, torch.ones(16, 16, dtype=torch.bool))


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        (float("nan"), "the metric is nan"),
        (float("-inf"), "the metric is -inf"),
        (UnavailableError("no weights"), "no weights"),
    ],
)
def test_a_metric_that_cannot_be_had_has_a_reason(value, reason, monkeypatch):
    monkeypatch.setattr(PSNR, "__call__", mock.Mock(side_effect=[value]))
    scores = Scorer("paper", only=("psnr", "ssim")).score(comparison())
    assert scores.reasons == {"psnr": reason} and set(scores.values) == {"ssim"}


def test_views_that_show_nothing_within_their_masks_are_counted():
    left_half, nothing = torch.zeros(16, 16, dtype=torch.bool), torch.zeros(16, 16)
    left_half[:, :8] = True
    views = [(None, nothing), (left_half, (~left_half).float()), (left_half, left_half.float())]
    views += [(~left_half & left_half, nothing), (None, nothing + 1)]
    evaluated = EvaluatedSet("mm", Scorer("paper", only=("psnr",)))
    for index, (mask, alpha) in enumerate(views):
        frame = plain_frame(torch.zeros(16, 16, 3, dtype=torch.uint8), mask=mask)
        evaluated.add(replace(frame, name=f"{index}"), comparison(), alpha)
    record = evaluated.record()
    assert record.blank == 2 and record.transparency_warning.startswith("2 of 5 views show nothing")


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (
            {"name": "mine", "metrics": {"sharpness": ("sharpnes", {})}},
            "protocol 'mine', metric 'sharpness': no metric 'sharpnes'",
        ),
        (
            {"name": "mine", "metrics": {"psnr": ("psnr", {"peek": 1.0})}},
            "protocol 'mine', metric 'psnr': option of 'psnr' peek",
        ),
        ({}, "protocol 'mine' from entry point x:Y has the name 'paper'"),
    ],
)
def test_a_protocol_that_is_not_valid_is_named(values, message, monkeypatch):
    monkeypatch.setitem(registry.protocols._targets, "mine", type("Mine", (PaperProtocol,), values))
    monkeypatch.setitem(registry.protocols._sources, "mine", "entry point x:Y")
    with pytest.raises(InputError, match=message):
        Scorer("mine")
