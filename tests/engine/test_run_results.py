"""The result of an evaluated run: everything it says is what the run was, and does not depend on interruptions."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from coliags_plugin import __version__
from coliags_plugin.config.method_config import load_method
from coliags_plugin.core import files
from coliags_plugin.core.errors import InputError
from coliags_plugin.engine import trained as trained_module
from coliags_plugin.engine.checkpoints import checkpoint_folder
from coliags_plugin.engine.devices import device_name
from coliags_plugin.engine.evaluator import evaluate
from coliags_plugin.engine.scoring import Scorer
from coliags_plugin.engine.trained import load_trained
from coliags_plugin.results.hashing import code_key, result_key
from coliags_plugin.results.reading import RESULT_FILE, means_summary, per_frame_table, read_result
from tests.engine.test_trainer import kill, make_trainer
from tests.scenes import SMALL, wall_scene

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
    """Trains and loads a run of the scene."""
    patch = pytest.MonkeyPatch()
    patch.setattr(trained_module, "load_scene", lambda config, path: scene)
    folder, count = tmp_path_factory.mktemp("runs"), iter(range(99))

    def make(stop=None, resume_to=None, **options):
        path = folder / str(next(count))
        trainer = make_trainer(path, scene=scene, **{"steps": STEPS, **options})
        trainer.start()
        if stop is not None:
            kill(trainer, stop)
            with pytest.raises(RuntimeError):
                trainer.train()
        else:
            trainer.train()
        if resume_to is not None:
            again = make_trainer(path, scene=scene, **{**options, "steps": resume_to})
            again.resume()
            again.train()
        return load_trained(path, CPU)

    yield make
    patch.undo()


@pytest.fixture(scope="module")
def whole(loaded):
    return loaded()


@pytest.fixture(scope="module")
def result(whole):
    return evaluate(whole, "paper")


def test_it_says_what_the_run_was(result, whole, scene):
    config = load_method("coliags", [*SMALL, f"schedule.steps={STEPS}"]).config.model_dump()
    assert (result.method, result.seed, result.steps) == ("coliags", 0, STEPS)
    assert result.key == result_key(config, "wall-9-True", 0, code_key(), "paper", 1)
    assert result.config["schedule"]["steps"] == STEPS and result.config["field"]["voxel_size"] == 2.0
    assert result.scene.train == tuple(frame.name for frame in scene.train)
    assert (result.scene.name, result.scene.size) == ("wall", (32, 24))
    assert (result.software["package_version"], result.software["code"]) == (__version__, code_key())
    assert result.provenance["training"]["renderer"] == "cpu"
    assert result.provenance["held_out_used"] == means_summary(result)["held_out_used"] == {"points": ["0000"]}


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
def test_refined_poses_add_metrics_and_change_no_other(result, whole):
    other_result = evaluate(whole, "paper", refine_poses=True)
    added = ["psnr_pose_refined", "ssim_pose_refined", "psnr_pose_color_refined", "ssim_pose_color_refined"]
    assert list(other_result.metrics) == [*result.metrics, *added]
    for name, part in result.sets.items():
        refined_part = other_result.sets[name]
        assert {key: refined_part.values[key] for key in part.values} == part.values
        assert refined_part.predictions_sha256 == part.predictions_sha256
        assert all(None not in refined_part.values[key] for key in added)
    assert other_result.metrics["psnr_pose_refined"] == result.metrics["psnr"] and other_result.key != result.key
    assert means_summary(other_result)["psnr_pose_refined"] == other_result.mean("psnr_pose_refined")
    evaluate(whole, "paper")  # as other tests expect it


def test_the_other_files_are_made_of_it(result, whole):
    folder = whole.run.evaluation("paper")
    assert read_result(folder / RESULT_FILE) == result
    assert json.loads((folder / "metrics.json").read_text()) == json.loads(json.dumps(means_summary(result)))
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


def test_a_killed_and_resumed_run_has_the_same_result(loaded, result):
    resumed = loaded(stop=4, resume_to=STEPS, overrides=["schedule.checkpoint_every=3"])
    other_result = evaluate(resumed, "paper")
    assert other_result.sets == result.sets
    assert other_result.metrics_sha256 == result.metrics_sha256


def test_another_model_has_other_predictions_and_the_same_truth(loaded, result):
    other_result = evaluate(loaded(seed=1), "paper")
    assert other_result.key != result.key and other_result.metrics_sha256 != result.metrics_sha256
    for name, part in result.sets.items():
        assert other_result.sets[name].predictions_sha256 != part.predictions_sha256
        assert other_result.sets[name].truth_sha256 == part.truth_sha256


def test_other_truth_has_another_hash(loaded, result, whole, scene):
    frames = scene.test_sets["rotation"]
    everything = [frame.with_maps(seen=torch.ones(24, 32, dtype=torch.bool)) for frame in frames]
    other = replace(whole, scene=replace(scene, test_sets={"rotation": everything}))
    other_result = evaluate(other, "paper").sets["rotation"]
    assert other_result.predictions_sha256 == result.sets["rotation"].predictions_sha256
    assert other_result.truth_sha256 != result.sets["rotation"].truth_sha256


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


def test_a_run_that_other_code_trained_has_a_key_of_its_own(whole, result):
    """Other code all the way, or from the middle on."""
    others = [
        {**whole.provenance, "code": "0123456789abcdef"},
        {**whole.provenance, "code_changes": [{"at_step": 3, "code": "0123456789abcdef"}]},
    ]
    keys = [evaluate(replace(whole, provenance=provenance), "paper").key for provenance in others]
    assert len({*keys, result.key}) == 3


def test_it_says_what_the_run_cost(result, whole):
    cost, last = result.cost, whole.run.log_rows(STEPS)[-1]
    assert cost.device == cost.render_device == device_name(CPU)
    assert cost.threads == cost.render_threads == torch.get_num_threads()
    assert cost.train_seconds == pytest.approx(last["seconds"], abs=0.5) and cost.processor_seconds > 0
    assert cost.peak_memory_mib > 50 and cost.render_fps > 0
    assert 0 < cost.gaussians <= 2 * last["gaussians"]
    folder = checkpoint_folder(whole.run.checkpoints, STEPS)
    assert cost.checkpoint_bytes == sum(path.stat().st_size for path in folder.iterdir())
    assert set(cost.seconds_to_psnr) == {"25", "30", "32", "34", "36", "38", "40"}


def test_a_run_without_a_seed_is_refused(whole):
    text = whole.run.provenance_file.read_text()
    whole.run.provenance_file.write_text(text.replace('"seed"', '"sead"'))
    with pytest.raises(InputError, match="lacks 'seed'"):
        load_trained(whole.run.path, CPU)
    whole.run.provenance_file.write_text(text)


def test_a_disk_that_is_full_leaves_the_earlier_evaluation(whole, result, monkeypatch):
    before = (whole.run.evaluation("paper") / RESULT_FILE).read_bytes()
    rename = files.os.rename

    def full(source, target):
        if target == whole.run.evaluation("paper") and source.name != files._OLD:
            raise OSError(28, "No space left on device")
        rename(source, target)

    monkeypatch.setattr(files.os, "rename", full)
    with pytest.raises(InputError, match="No space left on device"):
        evaluate(whole, "paper")
    assert (whole.run.evaluation("paper") / RESULT_FILE).read_bytes() == before
