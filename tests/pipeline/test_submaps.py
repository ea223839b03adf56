"""Reconstructions of videos that are posed in several models."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

import coliags_plugin as cp
from coliags_plugin.core.errors import InputError, NotFiniteError
from coliags_plugin.core.files import write_json
from coliags_plugin.core.images import write_image
from coliags_plugin.datamanagers.colmap import ATLAS_FILE, read_atlas
from coliags_plugin.engine.data_formats import UNKNOWN_MEDIAN_DEPTH
from coliags_plugin.geometry.poses import colmap
from coliags_plugin.phantom.layouts.built_in import SeenPoints, add_points
from coliags_plugin.pipeline import steps
from coliags_plugin.pipeline.settings import ReconstructionSettings
from coliags_plugin.pipeline.stages import Record, StageRecord
from coliags_plugin.pipeline.steps import StageContext, Submap, find_submaps
from coliags_plugin.reconstruction.structure.sfm import Atlas, Reconstruction
from tests import commands
from tests.pipeline.conftest import COUNTS, TRAINING, Killed, write_atlas
from tests.reconstruction.seen_points import frame_model
from tests.textured_tube import tube_frames

SUBMAP = ("check_data", "estimate_depth", *TRAINING)


def context_of(scene, out, **settings):
    return StageContext(out, scene, ReconstructionSettings(**settings), None, "colmap", torch.device("cpu"))


def positions(frames):
    return np.stack([frame.camera.center.numpy() for frame in frames])


def test_models_with_enough_frames_are_sub_maps_and_the_largest_always(atlas):
    assert find_submaps(atlas, 12) == [Submap(0, "sparse/0", 14), Submap(1, "sparse/1", 12)]
    assert [submap.number for submap in find_submaps(atlas, 4)] == [0, 1, 2]
    assert [submap.number for submap in find_submaps(atlas, 100)] == [0]
    for number in (1, 2):
        shutil.rmtree(atlas / "sparse" / str(number))
    assert find_submaps(atlas, 4) == [Submap()]  # nothing to choose from, and no option for it


def test_each_sub_map_has_its_own_frames_and_unit(atlas, tmp_path, caplog):
    for number, context in enumerate(context_of(atlas, tmp_path / "out", least_submap=5).submaps()):
        scene = context.open_posed()
        assert len(scene.video) == COUNTS[number]
        assert not scene.is_metric
        np.testing.assert_allclose(positions(scene.video), positions(tube_frames(COUNTS[number], 1.0)), 1e-4)
        assert context.folder == tmp_path / "out" / ("" if number == 0 else f"submap-{number}")
    assert "no pose" not in caplog.text  # the atlas says it
    scene = write_atlas(tmp_path / "scene", units=("mm", "unknown", "unknown"))
    scenes = [context.open_posed() for context in context_of(scene, tmp_path / "out").submaps()]
    assert [context.is_metric for context in scenes] == [True, False]
    assert float(scenes[0].video[1].camera.camera_to_world[2, 3]) == pytest.approx(1.0, abs=1e-6)
    write_json(scene / ATLAS_FILE, {"frames": 3})
    with pytest.raises(InputError, match=r"atlas.json: frames: .*valid list"):
        read_atlas(scene)


def test_all_are_reconstructed_and_a_kill_between_them_resumes(calls, atlas, tmp_path, monkeypatch):
    with monkeypatch.context() as patched, pytest.raises(Killed):
        mesh = steps.mesh

        def killed(context):
            if context.submap.number == 1:
                raise Killed
            return mesh(context)

        patched.setattr(steps, "mesh", killed)
        cp.reconstruct(atlas, tmp_path / "out")
    assert calls == [*SUBMAP, "submap-1/check_data", "submap-1/estimate_depth", "submap-1/train", "submap-1/evaluate"]
    calls.clear()
    record = cp.reconstruct(atlas, tmp_path / "out")
    assert calls == ["submap-1/mesh", "submap-1/coverage", "submap-1/show", "submap-1/report"]
    assert record.stages["submap-1/mesh"].files == {"submap-1/mesh": "a file"}
    assert record.stages["train"].options["steps"] == 2000
    assert record.stages["submap-1/train"].options["steps"] == 500
    calls.clear()
    cp.reconstruct(atlas, tmp_path / "out", settings={"least_submap": 5})
    assert calls == [f"submap-2/{name}" for name in SUBMAP]
    with pytest.raises(InputError, match="stage train was made with steps 2000, not 4000"):
        cp.reconstruct(atlas, tmp_path / "out", settings={"steps": 4000})
    calls.clear()
    cp.reconstruct(atlas, tmp_path / "out", settings={"steps": 4000}, overwrite=True)  # depth stands
    assert calls == [*TRAINING, *(f"submap-1/{name}" for name in TRAINING)]


def test_sub_maps_are_known_once_the_poses_are(calls, video, tmp_path, monkeypatch):
    make_poses = steps.make_poses

    def poses(context):
        shutil.rmtree(context.posed, ignore_errors=True)
        write_atlas(context.posed, COUNTS if context.settings.diameter is None else COUNTS[:1])
        return make_poses(context)

    monkeypatch.setattr(steps, "make_poses", poses)
    cp.reconstruct(video, tmp_path / "out")
    assert calls == ["make_frames", "make_poses", *SUBMAP, *(f"submap-1/{name}" for name in SUBMAP)]
    (tmp_path / "out" / "submap-1").mkdir()
    (tmp_path / "out" / "submap-1" / "run").mkdir()
    calls.clear()
    with pytest.raises(InputError, match="stage poses was made with diameter None, not 40"):
        cp.reconstruct(video, tmp_path / "out", settings={"diameter": 40.0})
    record = cp.reconstruct(video, tmp_path / "out", settings={"diameter": 40.0}, overwrite=True)
    assert calls == ["make_poses", *SUBMAP]
    assert not any(name.startswith("submap-1") for name in record.stages)
    assert not (tmp_path / "out" / "submap-1").exists()


@pytest.mark.parametrize(
    ("error", "options"),
    [
        (InputError("no surface that frames agree on"), ()),
        (NotFiniteError("loss is nan"), ()),
        pytest.param(InputError("no surface that frames agree on"), ("--jobs", 1), marks=pytest.mark.thorough),
    ],
)
def test_a_sub_map_that_fails_does_not_end_the_others(
    calls, atlas, tmp_path, monkeypatch, caplog, error, options, capsys, workers
):
    workers()
    failing = [1]
    estimate = steps.estimate_depth

    def fails(context):
        if context.submap.number in failing:
            raise error
        return estimate(context)

    monkeypatch.setattr(steps, "estimate_depth", fails)
    argv = ("reconstruct", atlas, "--output", tmp_path / "out", "--set", "least_submap=5", *options)
    assert commands.run(*argv) == 0
    assert calls == [*SUBMAP, "submap-1/check_data", *(f"submap-2/{name}" for name in SUBMAP)]
    stages = Record.of(tmp_path / "out").stages
    assert stages["submap-1/depth"].state == "failed"
    assert stages["submap-1/depth"].summary.startswith(str(error).rstrip("."))
    assert options or "the others go on" in caplog.text
    shutil.rmtree(tmp_path / "out")
    failing[:] = [0]
    calls.clear()
    assert commands.run(*argv) == error.exit_status
    assert str(error).rstrip(".") in capsys.readouterr().err
    assert calls == ["check_data", *(f"submap-{number}/{name}" for number in (1, 2) for name in SUBMAP)]
    failing.clear()
    calls.clear()
    assert commands.run(*argv) == 0
    assert calls == [name for name in SUBMAP if name != "check_data"]


def test_a_failure_is_recorded_without_its_place(calls, atlas, tmp_path, monkeypatch):
    def fails(context):
        raise InputError(f"{context.out / 'depth'} is empty")

    monkeypatch.setattr(steps, "mesh", fails)
    with pytest.raises(InputError):
        cp.reconstruct(atlas, tmp_path / "out")
    for file in ("reconstruction.json", "index.html"):
        text = (tmp_path / "out" / file).read_text(encoding="utf-8")
        assert "depth is empty" in text and str(tmp_path) not in text


def test_warnings_and_figures_are_kept(calls, atlas, tmp_path, monkeypatch, caplog):
    outcome = StageRecord("1 suspect finding", {}, ["suspect: the camera jumps. Check it"], {"frames": 14})
    monkeypatch.setattr(steps, "check_data", lambda context: outcome)
    cp.reconstruct(atlas, tmp_path / "out")
    assert "submap-1/check: suspect: the camera jumps. Check it" in caplog.text
    content = json.loads((tmp_path / "out" / "reconstruction.json").read_text())["stages"]
    assert content["check"]["warnings"] == list(outcome.warnings)
    assert content["check"]["figures"] == {"frames": 14}


def test_each_model_is_scaled_by_the_diameter_or_else_to_its_median_depth(tmp_path, monkeypatch):
    """Beside the path of the first lies a wall, beside that of the second too little; the third is too small."""
    out = tmp_path / "out"
    images = [out / "frames" / "images" / f"{index}.png" for index in range(14)]
    for image in images:
        write_image(image, np.zeros((32, 40, 3), np.uint8))
    angles = np.linspace(0.0, 6.0, 40)
    wall = np.stack([5.0 * np.cos(angles), 5.0 * np.sin(angles), np.linspace(1.0, 4.0, 40)], axis=1)

    def model(first, count, points):
        poses = np.tile(np.eye(4), (count, 1, 1))
        poses[:, 2, 3] = np.arange(count)
        frames = [
            replace(frame, camera=replace(frame.camera, camera_to_world=torch.from_numpy(pose)))
            for frame, pose in zip(tube_frames(count, 1.0, (40, 32)), poses, strict=True)
        ]
        registered = range(first, first + count)
        posed = frame_model(frames, [images[index].name for index in registered])
        seen_points = [SeenPoints(np.ones((len(points), 2)), np.arange(len(points))) for _ in range(count)]
        add_points(posed, seen_points, points, np.zeros((len(points), 3), np.uint8))
        return Reconstruction(tuple(images), tuple(registered), poses, tuple(path.name for path in images), posed)

    models = (model(0, 6, wall), model(6, 5, wall[:2] + np.array([0.0, 0.0, 9.0])), model(11, 3, wall[:2]))
    atlas_found = Atlas(tuple(images), models, {})
    monkeypatch.setattr("coliags_plugin.reconstruction.structure.sfm.reconstruct", lambda *arguments: atlas_found)
    settings = ReconstructionSettings(diameter=40.0, least_submap=4)
    context = StageContext(out, tmp_path / "film", settings, None, None, torch.device("cpu"))
    assert "unit mm, by a diameter of 40 mm" in steps.make_poses(context).summary
    atlas = read_atlas(context.posed)
    assert [stretch.unit for stretch in atlas.submaps] == ["mm", "unknown", "unknown"]
    ways = [
        float(np.diff(colmap.read(context.posed / "sparse" / str(number)).camera_to_world[:, 2, 3]).mean())
        for number in range(3)
    ]
    np.testing.assert_allclose(ways, [4.0, UNKNOWN_MEDIAN_DEPTH / models[1].median_depth, 1.0], rtol=1e-6)
    assert [inside.open_posed().is_metric for inside in context.submaps()] == [True, False]
