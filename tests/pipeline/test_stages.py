"""Stages that are done once, in order; those of sub-maps too, by one process and by worker processes."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
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
from coliags_plugin.engine.tasks import ExecutionOptions, TaskOutcome
from coliags_plugin.geometry.poses import colmap
from coliags_plugin.phantom.layouts import SeenPoints, add_points
from coliags_plugin.pipeline import stages, steps
from coliags_plugin.pipeline.reconstruct import StageJob, StageJobs
from coliags_plugin.pipeline.settings import ReconstructionSettings
from coliags_plugin.pipeline.stages import (
    LOCK_FILE,
    PAGE_FILE,
    RECORD_FILE,
    Record,
    Stage,
    StageRecord,
    check_options,
    run_stages,
)
from coliags_plugin.pipeline.steps import StageContext, Submap, find_submaps
from coliags_plugin.reconstruction.structure.sfm import Atlas, Reconstruction
from tests import commands
from tests.comparison.small import lock_holder, until
from tests.pipeline.conftest import TRAINING, Killed
from tests.pipeline.reconstructions import COUNTS, write_atlas
from tests.reconstruction.seen_points import frame_model
from tests.textured_tube import tube_frames


@pytest.fixture(autouse=True)
def outputs(monkeypatch):
    for name in ("first", "second", "third"):
        monkeypatch.setitem(stages.OUTPUTS, name, (f"{name}.txt",))


class Workshop:
    """Three stages that write a file each, and a list of what was done."""

    def __init__(self, folder, kill=None, fail=None):
        self.folder, self.kill, self.fail, self.done = folder, kill, fail, []

    def stages(self, **options):
        return [
            Stage(name, lambda name=name: self.work(name), {"value": options.get(name, 0)})
            for name in ("first", "second", "third")
        ]

    def work(self, name):
        if name == self.fail:
            raise InputError("nothing to see", "something", "Look elsewhere")
        (self.folder / f"{name}.txt").write_text(name)
        if name == self.kill:
            raise Killed
        self.done.append(name)
        return StageRecord(f"{name} is there", {f"{name}.txt": "a file"})

    def run(self, overwrite=False, **options):
        self.done = []
        record, stages = Record.of(self.folder), self.stages(**options)
        check_options(stages, record, overwrite)
        run_stages(stages, record)
        return self.done


def test_an_option_that_the_version_of_a_record_did_not_have_is_none(tmp_path):
    shop = Workshop(tmp_path)
    shop.run()
    record, (first, *_) = Record.of(tmp_path), shop.stages()
    check_options([replace(first, options={"value": 0, "new": None})], record, overwrite=False)
    with pytest.raises(InputError, match="made with new None, not 2"):
        check_options([replace(first, options={"value": 0, "new": 2})], record, overwrite=False)


@pytest.mark.parametrize("name", ["first", "second", "third"])
def test_a_killed_run_goes_on(tmp_path, name):
    with pytest.raises(Killed):
        Workshop(tmp_path, kill=name).run()
    with pytest.raises(InputError, match=f"stage {name} was made with value 0, not 1"):
        Workshop(tmp_path).run(**{name: 1})
    order = ["first", "second", "third"]
    assert Workshop(tmp_path).run() == order[order.index(name) :]


def test_other_options_are_refused_or_repeat_what_depends_on_them(tmp_path):
    shop = Workshop(tmp_path)
    assert shop.run() == ["first", "second", "third"]
    content = json.loads((tmp_path / RECORD_FILE).read_text())
    assert (content["format"], list(content["stages"])) == (2, ["first", "second", "third"])
    second = Record.of(tmp_path).stages["second"]
    assert (second.state, second.summary, second.files) == ("done", "second is there", {"second.txt": "a file"})
    with pytest.raises(InputError, match=r"stage second was made with value 0, not 5.*`overwrite=True` to repeat"):
        shop.run(second=5)
    assert shop.run() == []
    (tmp_path / "third.txt").write_text("old")
    assert shop.run(overwrite=True, second=5) == ["second", "third"]
    assert (tmp_path / "third.txt").read_text() == "third"
    assert shop.run(second=5) == []


def test_a_stage_that_failed_can_be_tried_with_other_options(tmp_path):
    with pytest.raises(InputError) as refused:
        Workshop(tmp_path, fail="third").run()
    assert str(refused.value) == (
        "stage third: nothing to see. Expected something. Look elsewhere. "
        "first, second stand: the same command goes on from there."
    )
    assert Record.of(tmp_path).stages["third"].state == "failed"
    assert Workshop(tmp_path).run(third=1) == ["third"]


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("thesis.tex", "", "already exists and is no reconstruction"),
        (RECORD_FILE, '{"format": 2, "stages": 3}', r"cannot read .*reconstruction.json"),
        (RECORD_FILE, '{"format": 1, "version": "0.0.1", "stages": {}}', r"is of version 0\.0\.1 .*Choose another"),
    ],
)
def test_folders_of_something_else_or_of_other_versions_are_refused(tmp_path, file, content, message):
    (tmp_path / file).write_text(content)
    with pytest.raises(InputError, match=message):
        Record.of(tmp_path)


def test_several_processes_change_one_record_which_is_in_order(tmp_path):
    record = Record(tmp_path, {"survey": StageRecord()})
    record.write()
    names = ["segment-001/frames", "segment-000/submap-1/train", "segment-000/train"]
    workers = {name: Record.of(tmp_path) for name in names}
    for name, worker in workers.items():
        worker.put(name, StageRecord(files={name: "a file"}))
    assert record.refresh() and list(record.stages) == ["survey", *names[:0:-1], names[0]]
    workers[names[0]].forget(names[1:2])
    assert list(Record.of(tmp_path).stages) == ["survey", names[2], names[0]]
    assert [path.name for path in tmp_path.iterdir()] == [RECORD_FILE]
    assert list(record.within("segment-000")) == ["train", "submap-1/train"]


def test_what_a_kill_leaves_before_the_record_is_no_hindrance(tmp_path):
    (tmp_path / LOCK_FILE).write_text("")
    (tmp_path / f".{RECORD_FILE}.1234567890-0123abcd.partial").mkdir()
    Record.of(tmp_path).write()
    assert Record.of(tmp_path).stages == {}
    assert sorted(path.name for path in tmp_path.iterdir()) == [LOCK_FILE, RECORD_FILE]


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
    assert calls == [f"submap-1/{name}" for name in TRAINING[2:]]
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
        write_atlas(context.posed, COUNTS if context.settings.diameter is None else COUNTS[:1], listed=False)
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


def test_failures_are_recorded_without_their_place_and_warnings_and_figures_kept(
    calls, atlas, tmp_path, monkeypatch, caplog
):
    def fails(context):
        raise InputError(f"{context.out / 'depth'} is empty")

    outcome = StageRecord("1 suspect finding", {}, ["suspect: the camera jumps. Check it"], {"frames": 14})
    monkeypatch.setattr(steps, "check_data", lambda context: outcome)
    monkeypatch.setattr(steps, "mesh", fails)
    with pytest.raises(InputError):
        cp.reconstruct(atlas, tmp_path / "out")
    for file in ("reconstruction.json", "index.html"):
        text = (tmp_path / "out" / file).read_text(encoding="utf-8")
        assert "depth is empty" in text and str(tmp_path) not in text
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


def told(folder):
    """All that the record says but times."""
    return {name: replace(stage, seconds=0.0) for name, stage in Record.of(folder).stages.items()}


def parts(executor):
    return [task.submap for task in executor.tasks]


@pytest.mark.thorough
def test_a_video_by_workers_is_what_one_process_makes(video, tmp_path, workers, calls, monkeypatch):
    make_poses = steps.make_poses

    def poses(context):
        write_atlas(context.posed, listed=False)
        return make_poses(context)

    monkeypatch.setattr(steps, "make_poses", poses)
    cp.reconstruct(video, tmp_path / "alone")
    alone = list(calls)
    calls.clear()
    executor = workers()
    record = cp.reconstruct(video, tmp_path / "out", jobs=2)
    assert parts(executor) == [None, 0, 1] and calls == alone
    assert told(tmp_path / "out") == told(tmp_path / "alone") and list(record.stages) == list(told(tmp_path / "alone"))
    assert (tmp_path / "out" / PAGE_FILE).is_file()
    cp.reconstruct(video, tmp_path / "out")
    assert calls == alone, "what is done is not done again"


def test_a_sub_map_whose_worker_dies_three_times_has_failed_and_the_others_go_on(calls, atlas, tmp_path, workers):
    died = TaskOutcome("died", "the process was ended by SIGKILL")
    executor = workers(None, died, died, died)
    record = cp.reconstruct(atlas, tmp_path / "out", jobs=1)
    assert parts(executor) == [0, 1, 1, 1]
    assert {stage.state for name, stage in record.stages.items() if "/" not in name} == {"done"}
    workers(died, died, died)
    with pytest.raises(InputError, match="SIGKILL, 3 times"):
        cp.reconstruct(atlas, tmp_path / "again", jobs=1)


def test_the_stage_that_a_worker_is_at_is_told(tmp_path):
    submap, device = Submap(3), torch.device("cpu")
    context = StageContext(tmp_path, tmp_path, ReconstructionSettings(), None, None, device, submap=submap)
    job = StageJob(StageJobs(Record(tmp_path), [], False, None, ExecutionOptions()), context, 30)
    assert (job.doing, job.progress()) == (f"{tmp_path.name}, sub-map 3", 0)
    worker = Record.of(tmp_path)
    for name in ("check", "depth"):
        worker.put(f"submap-3/{name}", StageRecord())
    worker.put("submap-3/train", StageRecord(state="begun"))
    assert (job.doing, job.progress()) == (f"{tmp_path.name}, sub-map 3 train", 6)


@pytest.mark.thorough
def test_workers_are_processes_and_one_that_is_killed_is_replaced(atlas, tmp_path):
    """Real stages: the check of the data is done, and depth cannot be, as its one point says nothing."""
    code = "from coliags_plugin.cli import main; main()"
    argv = ["reconstruct", str(atlas), "--output", str(tmp_path / "out"), "--jobs", "2"]
    with (tmp_path / "told.txt").open("w") as messages:
        driver = subprocess.Popen([sys.executable, "-c", code, *argv], stderr=messages, stdout=messages)
    os.kill(until("worker", lambda: lock_holder(tmp_path / "out", ".lock-*")), signal.SIGKILL)
    driver.wait()
    text = (tmp_path / "told.txt").read_text()
    assert "SIGKILL" in text and "trying again" in text
    stages = Record.of(tmp_path / "out").stages
    assert {stages[name].state for name in ("check", "submap-1/check")} == {"done"}
    assert (tmp_path / "out" / "logs" / "0.log").is_file() and (tmp_path / "out" / "logs" / "1.log").is_file()
