"""``coliags depth`` as a user meets it: a textured wall with closed-form depth."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import coliags_plugin as cp
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import write_image, write_mask
from coliags_plugin.core.scene_files import write_unit
from coliags_plugin.datamanagers.file_formats import read_gray
from coliags_plugin.datamanagers.fusion import load_points
from coliags_plugin.engine.data_formats import open_scene
from coliags_plugin.reconstruction.depth import estimate
from coliags_plugin.reconstruction.depth.estimate import Estimation, WorkFolder, check_video
from tests import commands
from tests.commands import run
from tests.faults import content
from tests.reconstruction.depth.walls import NORMAL, OFFSET, sideways, wall_depth, wall_frames
from tests.scenes import write_frames

COUNT = 9
OPTIONS = ("--set", "depth.features.highlight_level=256", "--jobs", 2)


@pytest.fixture(scope="module")
def wall(tmp_path_factory):
    return write_frames(tmp_path_factory.mktemp("walls") / "wall", wall_frames(sideways(COUNT)), depth=False)


@pytest.fixture(scope="module")
def estimated(wall, tmp_path_factory):
    """The wall with estimated depth, and what was printed is discarded."""
    out = tmp_path_factory.mktemp("estimates") / "out"
    assert run("depth", wall, "--output", out, *OPTIONS) == 0
    return out


def test_the_function_writes_what_the_command_does(wall, estimated, tmp_path):
    settings = {"depth.features.highlight_level": 256}
    estimate = cp.estimate_depth(wall, tmp_path / "out", jobs=1, settings=settings)
    assert content(tmp_path / "out") == content(estimated)
    assert estimate.summary.startswith(f"{COUNT} frames, ") and estimate.settings == {}
    assert len(cp.load_scene(estimate.folder).train) == 7


def refused(capsys, *argv):
    """Message, in one line, of a command that must fail."""
    return " ".join(commands.refused(capsys, "depth", *argv).split())


def frames_of(folder, *options):
    scene = open_scene(folder, options=["initial_points=none", *options])
    return sorted([*scene.train, *scene.test_sets.get("test", ())], key=lambda frame: frame.index)


def confidence_of(folder, name):
    return read_gray(folder / "confidence" / f"{name}.png", 8, "confidence") / 255.0


def contents(folder):
    return {path.relative_to(folder): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.mark.thorough
def test_the_data_check_trusts_the_estimate(estimated, capsys):
    assert run("check", "data", estimated) == 0
    assert "nothing suspect" in capsys.readouterr().out


def test_a_wall(wall, estimated):
    content = json.loads((estimated / "transforms.json").read_text())
    assert content["ply_file_path"] == "points.ply" and len(content["frames"]) == COUNT
    for frame in content["frames"]:
        assert all((estimated / frame[key]).is_file() for key in ("file_path", "depth_file_path"))
        assert (estimated / frame["confidence_file_path"]).is_file() and "mask_path" not in frame
    assert "train_filenames" not in content
    assert (estimated / "unit.txt").read_text() == "mm\n"
    points = load_points(estimated / "points.ply")
    distance = (points.positions.numpy() @ NORMAL - OFFSET) / np.linalg.norm(NORMAL)
    assert len(points) > 300 and points.colors is not None
    assert np.percentile(np.abs(distance), 95) < 1.5
    errors, sure = [], []
    for frame, true_frame in zip(frames_of(estimated), frames_of(wall), strict=True):
        assert frame.name == true_frame.name
        np.testing.assert_array_equal(frame.image, true_frame.image)
        np.testing.assert_allclose(frame.camera.camera_to_world, true_frame.camera.camera_to_world, atol=1e-5)
        np.testing.assert_allclose(frame.camera.intrinsics_matrix, true_frame.camera.intrinsics_matrix, atol=1e-4)
        assert np.isfinite(frame.depth).all()
        errors.append(np.abs(frame.depth.numpy() / wall_depth(true_frame.camera) - 1.0))
        sure.append(confidence_of(estimated, frame.name))
    error, confidence = np.stack(errors), np.stack(sure)
    assert np.median(error) < 0.01 and np.percentile(error[confidence > 0.8], 90) < 0.03
    assert (confidence > 0.8).mean() > 0.7 and (error[confidence > 0.8] < 0.05).mean() > 0.9


@pytest.mark.parametrize("split", ["every-8th", pytest.param("all-train", marks=pytest.mark.thorough)])
def test_the_depth_of_training_frames_does_not_depend_on_the_images_of_test_frames(wall, estimated, tmp_path, split):
    noise, rng = shutil.copytree(wall, tmp_path / "noise"), np.random.default_rng(0)
    for frame in open_scene(wall).test_sets["test"]:
        write_image(noise / "images" / f"{frame.name}.png", rng.integers(0, 256, frame.image.shape, dtype=np.uint8))
    outs = [estimated if split == "every-8th" else tmp_path / "whole", tmp_path / "out"]
    for source, out in zip((wall, noise), outs, strict=True):
        if not out.exists():
            assert run("depth", source, "--output", out, *OPTIONS, "--set", f"split={split}") == 0
    before, after = map(contents, outs)
    test = {frame.name for frame in open_scene(wall).test_sets["test"]}
    assert len(test) == 2
    training_files = [path for path in before if path.parent.name in ("depth", "confidence") and path.stem not in test]
    assert len(training_files) == 2 * (COUNT - len(test))
    assert all(before[Path("images") / f"{name}.png"] != after[Path("images") / f"{name}.png"] for name in test)
    changed = [
        path for path in [*training_files, Path("points.ply"), Path("transforms.json")] if before[path] != after[path]
    ]
    assert bool(changed) == (split == "all-train")


def test_what_a_split_holds_out_is_recorded_where_depth_was_made_from_it(estimated, tmp_path):
    def used(folder, split):
        return open_scene(folder, options=[f"split={split}"]).provenance.held_out_used

    assert used(estimated, "every-8th") == {} and used(estimated, "all-train") == {}
    assert used(estimated, "endogslam") == {"depth": ["0007_color"]}
    older = shutil.copytree(estimated, tmp_path / "older")
    content = json.loads((older / "transforms.json").read_text())
    del content["depth_estimated_from"]
    (older / "transforms.json").write_text(json.dumps(content))
    assert used(older, "every-8th") == {"depth": None}


def test_a_prior_by_another_and_what_is_printed(wall, tmp_path, capsys):
    out, priors = tmp_path / "out", tmp_path / "priors"
    priors.mkdir()
    for frame in frames_of(wall):
        np.save(priors / f"{frame.name}.npy", 5.0 + 100.0 / wall_depth(frame.camera))
    options = ("--set", "split=endogslam", "--set", "max_frames=6", "--near", 20, "--far", 80)
    assert run("depth", wall, "--output", out, "--prior", priors, *OPTIONS, *options) == 0
    summary, written, command = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"6 frames, \d+ % of the pixels with a confidence of 0.5 or more; \d+ points", summary)
    assert written == f"written: {out}"
    assert command == f"next:    coliags train coliags-plus --data {out} --set datamanager.split=endogslam"
    frames = frames_of(out)
    error = np.stack([np.abs(frame.depth.numpy() / wall_depth(frame.camera) - 1.0) for frame in frames])
    unknown = np.stack([confidence_of(out, frame.name) for frame in frames]) == 0.0
    assert unknown.any() and np.median(error[unknown]) < 0.04


def test_resuming_with_more_threads_gives_the_same_bytes(wall, estimated, tmp_path, monkeypatch, caplog):
    out = tmp_path / "out"
    save, saved = WorkFolder.save, []

    def killed(self, stage, index, arrays):
        if stage == "swept-1" and len(saved) == 20:
            raise KeyboardInterrupt
        save(self, stage, index, arrays)
        saved.append((stage, index))

    monkeypatch.setattr(WorkFolder, "save", killed)
    assert run("depth", wall, "--output", out, *OPTIONS[:2], "--jobs", 1) == 130
    assert not out.exists()
    assert (tmp_path / ".out.work" / "swept-1").is_dir()
    again = []
    monkeypatch.setattr(WorkFolder, "save", lambda *call: (again.append(call[1:3]), save(*call))[1])
    caplog.set_level("INFO")
    before = cv2.getNumThreads()
    cv2.setNumThreads(8)
    try:
        assert run("depth", wall, "--output", out, *OPTIONS[:2], "--jobs", 3) == 0
        assert cv2.getNumThreads() == 8
    finally:
        cv2.setNumThreads(before)
    assert "resuming" in caplog.text
    assert not set(saved) & set(again)
    assert contents(out) == contents(estimated)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_frames_keep_the_sweep_whose_depth_agrees_better(wall, tmp_path, monkeypatch):
    """Here the smaller one, which is the first."""
    saved, save = {}, WorkFolder.save

    def kept(self, stage, index, arrays):
        saved[stage, index] = dict(arrays)
        save(self, stage, index, arrays)

    monkeypatch.setattr(WorkFolder, "save", kept)
    monkeypatch.setattr(estimate, "disagreement", lambda frame, neighbours: float(frame.depth.size))
    assert run("depth", wall, "--output", tmp_path / "out", *OPTIONS) == 0
    for index in range(COUNT):
        first, last, chosen = (saved[stage, index] for stage in ("fused-0", "fused-1", "chosen"))
        for name, tolerance in (("depth", 0.4), ("confidence", 1e-6)):
            resized = cv2.resize(first[name], last[name].shape[::-1])
            assert np.median(np.abs(chosen[name] - resized)) < tolerance
            assert not np.array_equal(chosen[name], last[name])


def test_work_files_of_other_options_are_not_used(wall, tmp_path, monkeypatch, caplog):
    out = tmp_path / "out"

    def killed(self):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Estimation, "run", killed)
        assert run("depth", wall, "--output", out, *OPTIONS) == 130
    options = (*OPTIONS, "--set", "depth.agreement=0.03", "--set", "max_frames=5", "--set", "split=all-train")
    assert run("depth", wall, "--output", out, *options) == 0
    assert "work files of other data or options are removed" in caplog.text
    assert len(frames_of(out)) == 5


def test_unit_mask_and_own_split_are_kept(estimated, tmp_path):
    """The output is a scene like others, which can be estimated again."""
    source = tmp_path / "source"
    frames = frames_of(estimated)
    content = json.loads((estimated / "transforms.json").read_text())
    shutil.copytree(estimated, source)
    mask = np.zeros(frames[0].image.shape[:2], bool)
    mask[26:54, 32:64] = True  # a small part, whose matches count all the same
    for frame, entry in zip(frames, content["frames"], strict=True):
        write_mask(source / "masks" / f"{frame.name}.png", mask)
        entry["mask_path"] = f"masks/{frame.name}.png"
    names = [entry["file_path"] for entry in content["frames"]]
    content |= {"train_filenames": names[1:], "test_filenames": names[:1]}
    (source / "transforms.json").write_text(json.dumps(content))
    write_unit(source, "unknown")
    out = tmp_path / "out"
    assert run("depth", source, "--output", out, *OPTIONS, "--set", "split=own") == 0
    assert (out / "unit.txt").read_text() == "unknown\n"
    scene = open_scene(out, options=["split=own", "initial_points=data"])
    assert [frame.name for frame in scene.test_sets["test"]] == [frames[0].name]
    assert len(scene.points) > 50
    for frame in scene.train:
        np.testing.assert_array_equal(frame.mask, mask)
        assert np.isnan(frame.depth.numpy()[~mask]).all() and np.isfinite(frame.depth.numpy()[mask]).all()
        assert (confidence_of(out, frame.name)[~mask] == 0.0).all()
    assert max((confidence_of(out, frame.name)[mask] > 0.5).mean() for frame in scene.train) > 0.4


def test_bad_options_are_refused(wall, tmp_path, capsys):
    out = ("--output", tmp_path / "out")
    assert "--near without --far" in refused(capsys, wall, *out, "--near", 3)
    assert "0 < near < far" in refused(capsys, wall, *out, "--near", 30, "--far", 20)
    assert "--jobs 0" in refused(capsys, wall, *out, "--jobs", 0)
    assert "Did you mean 'agreement'" in refused(capsys, wall, *out, "--set", "depth.agrement=0.1")
    assert "no such folder" in refused(capsys, wall, *out, "--prior", tmp_path / "none")
    assert "a folder apart from the input" in refused(capsys, wall, "--output", wall / "inside")
    assert not (tmp_path / "out").exists()
    frames = wall_frames(sideways(4))
    frames[1] = dataclasses.replace(frames[1], camera=frames[1].camera.resized(48, 40))
    with pytest.raises(InputError, match="images of 48 x 40 to 96 x 80 pixels"):
        check_video(frames, range(4))


def test_what_gives_no_depth_is_refused(tmp_path, capsys):
    out = ("--output", tmp_path / "out", *OPTIONS)
    few = write_frames(tmp_path / "few", wall_frames(sideways(3)), depth=False)
    assert "3 frames. Expected at least 4" in refused(capsys, few, *out, "--set", "split=all-train")
    still = write_frames(tmp_path / "still", wall_frames(sideways(6, 0.0)), depth=False)
    assert "all 5 cameras are at the same position" in refused(capsys, still, *out)
    turning = sideways(6, 1e-4)
    turning[:, :3, :3] = Rotation.from_euler("y", 3.0 * np.arange(6)[:, None], degrees=True).as_matrix()
    turned = write_frames(tmp_path / "turned", wall_frames(turning), depth=False)
    assert "the depth range is unknown" in refused(capsys, turned, *out)
    assert "no frame has 3 others" in refused(capsys, turned, *out, "--near", 20, "--far", 80)
    assert not (tmp_path / "out").exists()


def noisy(frames, level, seed=0):
    """The frames without what they show, which is camera noise about a level."""
    rng = np.random.default_rng(seed)
    size = frames[0].image.shape

    def noise():
        return torch.from_numpy(np.clip(rng.normal(level, 1.5, size), 0, 255).astype(np.uint8))

    return [frame.with_maps(image=noise()) for frame in frames]


@pytest.mark.parametrize("level", [2, pytest.param(90, marks=pytest.mark.thorough)])
def test_black_or_blurred_frames_give_no_confident_depth(tmp_path, capsys, caplog, level):
    frames = wall_frames(sideways(COUNT))
    nothing = write_frames(tmp_path / "nothing", noisy(frames, level), depth=False)
    assert "the depth range is unknown" in refused(capsys, nothing, "--output", tmp_path / "a", *OPTIONS)
    near_far = ("--near", 20, "--far", 80)
    assert "no surface that 9 frames agree on" in refused(
        capsys, nothing, "--output", tmp_path / "a", *OPTIONS, *near_far
    )
    some = write_frames(tmp_path / "some", [*frames[:4], *noisy(frames[4:5], level), *frames[5:]], depth=False)
    assert run("depth", some, "--output", tmp_path / "b", *OPTIONS, *near_far) == 0
    frames_out = frames_of(tmp_path / "b")
    reason = f"mean weight of their own matches below 0.1: {frames_out[4].name}"
    assert f"1 of 9 frames have depth of confidence 0, {reason}" in caplog.messages
    assert confidence_of(tmp_path / "b", frames_out[4].name).max() == 0.0
    assert np.isfinite(frames_out[4].depth.numpy()).all()
    assert (confidence_of(tmp_path / "b", frames_out[2].name) > 0.8).mean() > 0.5
