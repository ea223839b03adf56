"""Long videos: survey, segments, joins, their reconstruction by worker processes, and the export of their sub-maps."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import coliags_plugin as cp
from coliags_plugin.core.errors import InputError, InterruptedRunError
from coliags_plugin.core.files import write_json
from coliags_plugin.engine.data_formats import open_scene
from coliags_plugin.engine.tasks import TaskOutcome
from coliags_plugin.geometry.poses import colmap, tum
from coliags_plugin.pipeline import steps
from coliags_plugin.pipeline.contents import export_atlas, read_contents
from coliags_plugin.pipeline.frame_sources import frame_source
from coliags_plugin.pipeline.joins import PosedFrames, joins
from coliags_plugin.pipeline.settings import FrameSettings
from coliags_plugin.pipeline.stages import Record, StageRecord
from coliags_plugin.pipeline.survey import OVERLAP, Survey, cut, survey_video
from coliags_plugin.reporting.video import write_video
from tests import commands
from tests.faults import largest_file
from tests.pipeline.films import film
from tests.pipeline.reconstructions import JOINS, RATE, SUBMAPS, change_video, similarity, write_atlas


def surveyed(followed, sharpness=1.0):
    followed = np.array(followed, np.float32)
    count = len(followed)
    sharp = np.broadcast_to(np.float32(sharpness), count)
    return Survey(sharp, followed, np.zeros(count, np.float32), (40, 50), None)


def test_a_survey_sees_every_frame_once_and_is_read_back(tmp_path):
    write_video(film([*range(0, 60, 2), *range(0, 60, 2)]), tmp_path / "film.mp4", 15.0)
    survey = survey_video(frame_source(tmp_path / "film.mp4"))
    assert len(survey) == 60 and survey.size == (120, 160)
    assert survey.followed[0] == 0.0
    assert survey.followed[30] < 0.5 * np.median(survey.followed), "the film begins again there"
    assert np.isfinite(survey.motion[1:30]).all() and (survey.sharpness > 0).all()
    survey.write(tmp_path)
    again = Survey.read(tmp_path)
    for name in ("sharpness", "followed", "motion"):
        np.testing.assert_array_equal(getattr(survey, name), getattr(again, name))
    assert again.size == survey.size and (again.mask is None) == (survey.mask is None)


def test_a_video_is_cut_where_nothing_is_seen_for_long_and_where_least_is_followed():
    followed = np.full(1000, 0.8)
    followed[300:350] = 0.0  # contact
    followed[500] = 0.0  # one lost frame is no break
    followed[620] = 0.2
    segments, skipped = cut(surveyed(followed), FrameSettings(segment=500), 12)
    assert [(each.first, each.last) for each in skipped] == [(300, 349)]
    half = OVERLAP // 2
    # The middle half of 350 to 999 has frame 500 in it, where least is followed.
    places = [(each.first, each.last) for each in segments]
    assert places == [(0, 299), (350, 499 + half), (500 - half, 999)] or segments[0].last == 299
    assert segments[1].last - segments[2].first + 1 == OVERLAP
    sharpness = np.full(400, 0.02)
    sharpness[200:260] = 0.002  # a flat wall at the lens, whose noise may be followed
    segments, skipped = cut(surveyed(np.full(400, 0.5), sharpness), FrameSettings(segment=300), 12)
    assert [(each.first, each.last) for each in skipped] == [(200, 259)]
    assert [(each.first, each.last) for each in segments] == [(0, 199), (260, 399)]


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10_000), count=st.integers(20, 3000), longest=st.integers(60, 700), every=st.integers(1, 4))
def test_every_frame_is_in_a_segment_or_left_out_and_none_is_too_long(seed, count, longest, every):
    generator = np.random.default_rng(seed)
    followed = generator.uniform(0.3, 1.0, count)
    for _ in range(generator.integers(0, 6)):
        start = generator.integers(0, count)
        followed[start : start + generator.integers(1, 200)] = 0.0
    segments, skipped = cut(surveyed(followed), FrameSettings(segment=longest, every=every), 12)
    covered = np.zeros(count, int)
    for each in segments:
        covered[each.first : each.last + 1] += 1
        assert each.count <= max(longest, 2 * OVERLAP + OVERLAP) * every
    for each in skipped:
        assert not covered[each.first : each.last + 1].any()
        covered[each.first : each.last + 1] = 1
    assert (covered > 0).all() and covered.max(initial=0) <= 2
    assert all(one.first < other.first and one.last < other.last for one, other in pairwise(segments))


BOTH = ("segment-000", "segment-001")


def posed(count, transform=None, noise=0.0, model="sparse/0", first=0):
    """Cameras on a bent path that look at points 30 away; in a world of its own."""
    generator = np.random.default_rng(7)
    scale, turn, shift = (1.0, Rotation.identity(), np.zeros(3)) if transform is None else transform
    frames = PosedFrames(model, {}, {})
    for index in range(first, first + count):
        name, center = f"frame_{index:06d}", np.array([0.1 * index, 0.02 * index**2 / 10, 0.3 * index])
        rotation = Rotation.from_rotvec([0.02 * index, 0.1, 0.0])
        frames.c2w[name] = np.eye(4)
        frames.c2w[name][:3, :3] = (turn * rotation).as_matrix()
        frames.c2w[name][:3, 3] = scale * turn.apply(center + noise * generator.normal(size=3)) + shift
        frames.depths[name] = scale * 30.0
    return frames


def test_models_of_the_same_frames_are_joined_by_the_similarity_between_them():
    other = (0.4, Rotation.from_rotvec([0.3, -1.0, 2.0]), np.array([5.0, -7.0, 1.0]))
    first, second = posed(20), posed(30, other, first=12)
    (join,) = joins(BOTH, [posed(4, model="sparse/1", first=90), first], [second])
    assert (join.reason, join.frames, join.models) == ("", 8, ("sparse/0", "sparse/0"))
    for name in ("frame_000012", "frame_000019"):
        place = np.array(join.transform) @ second.c2w[name][:, 3]
        np.testing.assert_allclose(place, first.c2w[name][:, 3], atol=1e-9)
    assert join.joined and (join.rotation_deg, join.position) == pytest.approx((0.0, 0.0), abs=1e-5)
    assert "3 frames have a pose on both sides" in joins(BOTH, [posed(15)], [posed(9, other, first=12)])[0].reason
    assert "do not agree" in joins(BOTH, [first], [posed(30, other, 20.0, first=12)])[0].reason
    both = joins(BOTH, [first, posed(9, model="sparse/1", first=31)], [second])
    assert [(one.models, one.frames, one.reason) for one in both] == [
        (("sparse/1", "sparse/0"), 9, ""), (("sparse/0", "sparse/0"), 8, "")
    ]  # fmt: skip
    assert joins(BOTH, [], [second])[0].reason == "no frame has a pose on one side"


@pytest.fixture
def long_video(calls, tmp_path, monkeypatch):
    """Video of 150 frames, cut into segments of at most 60, each posed in three models, with a contact of 40 frames."""
    still = np.zeros((120, 160, 3), np.uint8)
    images = film(range(0, 110))
    write_video([*images[:70], *[still] * 40, *images[70:]], tmp_path / "long.mp4", 15.0)

    def poses(context):
        calls.append(f"{context.out.name}/make_poses")
        write_atlas(context.posed, listed=False)
        return StageRecord("31 of 50 images posed")

    monkeypatch.setattr(steps, "make_poses", poses)
    return tmp_path / "long.mp4"


def segments_of(record):
    return [segment["name"] for segment in record.stages["survey"].figures["segments"]]


OPTIONS = {"frames.segment": 60, "frames.least_motion": 0.0, "frames.least_sharpness": 0.0}
WORDS = [word for name, value in OPTIONS.items() for word in ("--set", f"{name}={value}")]


@pytest.mark.thorough
def test_a_long_video_is_reconstructed_segment_by_segment_and_what_is_done_is_not_done_again(
    long_video, tmp_path, workers, calls
):
    executor = workers()
    record = cp.reconstruct(long_video, tmp_path / "out", settings=OPTIONS)
    contents = read_contents(tmp_path / "out", record)
    names = [segment.span.name for segment in contents.segments]
    plans = [task for task in executor.tasks if task.submap is None]
    assert len(plans) == len(names) >= 3 and executor.tasks[0].submap is None
    cameras = [json.loads(task.settings)["sfm"]["camera"] for task in plans]
    assert cameras[0]["params"] is None and all(camera["params"] is not None for camera in cameras[1:])
    (skipped,) = contents.video.skipped
    assert 70 <= skipped.first <= 72 and 105 <= skipped.last <= 110
    for name, segment in zip(names, contents.video.segments, strict=True):
        frames = json.loads((tmp_path / "out" / name / "frames" / "frames.json").read_text())["kept"]
        assert [frame["frame"] for frame in frames] == list(range(segment.first, segment.last + 1))
        assert record.stages[f"{name}/submap-1/report"].state == "done"
    assert {each.segments for each in contents.joins} == set(pairwise(names))
    assert any("show nothing that can be followed" in each.reason for each in contents.joins)
    assert list(Record.of(tmp_path / "out").stages) == list(record.stages)
    assert [path.relative_to(tmp_path) for path in tmp_path.rglob("reconstruction.json")] == [
        Path("out/reconstruction.json")
    ]
    assert "segment-000" in (tmp_path / "out" / "index.html").read_text(encoding="utf-8")
    before, executor = list(calls), workers()
    cp.reconstruct(long_video, tmp_path / "out", settings=OPTIONS)
    assert executor.tasks == [] and calls == before
    with pytest.raises(InputError, match="Choose another `output`"):
        cp.reconstruct(long_video, tmp_path / "out", settings={**OPTIONS, "frames.segment": 70})
    workers()
    again = cp.reconstruct(long_video, tmp_path / "out", settings={**OPTIONS, "frames.segment": 110}, overwrite=True)
    assert sorted(path.name for path in (tmp_path / "out").glob("segment-*")) == segments_of(again) < names


@pytest.mark.thorough
def test_it_goes_on_after_a_stop_and_a_segment_without_poses_leaves_the_others(
    long_video, tmp_path, workers, monkeypatch
):
    workers(None, KeyboardInterrupt())
    with pytest.raises(InterruptedRunError):
        cp.reconstruct(long_video, tmp_path / "out", settings=OPTIONS)
    make_poses, failing = steps.make_poses, ["segment-001"]

    def poses(context):
        if context.out.name in failing:
            raise InputError("2 of 50 frames have poses")
        return make_poses(context)

    monkeypatch.setattr(steps, "make_poses", poses)
    workers(TaskOutcome("died", "the node died"))
    assert commands.run("reconstruct", long_video, "--output", tmp_path / "out", *WORDS) == 0
    stages = Record.of(tmp_path / "out").stages
    states = [stages[f"{name}/poses"].state for name in segments_of(Record.of(tmp_path / "out"))]
    assert sorted(states)[0] == "done" and len(states) >= 3
    failing[:] = [f"segment-{number:03d}" for number in range(9)]
    workers()
    with pytest.raises(
        InputError,
        match=r"none of 3 segments .* could be reconstructed: .*2 of 50 frames.*none/index.html shows why",
    ):
        cp.reconstruct(long_video, tmp_path / "none", settings=OPTIONS)
    assert len(list((tmp_path / "none").glob("segment-*/frames/frames.json"))) == 3, "the next one is tried"
    page = (tmp_path / "none" / "index.html").read_text(encoding="utf-8")
    assert "no frame of this video has a pose: poses failed: 2 of 50 frames have poses" in page
    assert Record.of(tmp_path / "none").is_done("survey") and Survey.read(tmp_path / "none")


def test_a_video_in_which_nothing_is_followed_has_a_page_that_says_so(tmp_path, workers, capsys):
    write_video([np.zeros((48, 64, 3), np.uint8)] * 60, tmp_path / "dark.mp4", 10.0)
    executor, out = workers(), tmp_path / "out"
    argv = ("reconstruct", tmp_path / "dark.mp4", "--output", out, "--set", "frames.segment=50")
    for _ in range(2):
        message = commands.refused(capsys, *argv)
        assert "no stretch of " in message and f"{out / 'index.html'} shows why" in message
        page = (out / "index.html").read_text(encoding="utf-8")
        assert "no frame of this video has a pose: nothing of the frame before is seen" in page
        assert "No stretch of this video is long enough" in page and 'class="pictures"' not in page
        assert segments_of(Record.of(out)) == [] and len(Survey.read(out)) == 60
        (out / "index.html").unlink()
    assert executor.tasks == []
    assert "shows why" in commands.refused(capsys, *argv, "--set", "least_submap=20"), "nothing is made with others"
    assert "has no sub-map with poses" in commands.refused(
        capsys, "poses", "export", out, "--output", tmp_path / "atlas"
    )


@pytest.mark.thorough
def test_a_full_disk_ends_it_and_it_goes_on_once_there_is_space(long_video, tmp_path, workers, capsys):
    argv = ("reconstruct", long_video, "--output", tmp_path / "out", *WORDS)
    executor = workers()
    with largest_file(20_000):
        message = commands.refused(capsys, *argv)
    assert "/frames: cannot write to" in message and "Free some, or choose another output" in message
    assert len(executor.tasks) == 1, "the other segments are not tried"
    assert not list((tmp_path / "out").glob("segment-*/frames")) and not list((tmp_path / "out").rglob("*.png"))
    assert commands.run(*argv) == 0
    assert (tmp_path / "out" / "segment-002" / "frames" / "frames.json").is_file()


def test_what_the_executor_refuses_is_told_before_the_survey(long_video, tmp_path, workers):
    def refuse(file, inputs):
        raise InputError(f"a node does not see {inputs[0].name}")

    workers().check = refuse
    with pytest.raises(InputError, match=r"does not see long\.mp4"):
        cp.reconstruct(long_video, tmp_path / "out", settings=OPTIONS, jobs=2)
    assert not any((tmp_path / "out").glob("[!.]*"))


def test_every_sub_map_is_exported_with_its_trajectory_and_the_transform_to_the_first_of_those_joined(
    out, short, tmp_path
):
    manifest = export_atlas(out, tmp_path / "export")
    assert json.loads((tmp_path / "export" / "manifest.json").read_text()) == manifest
    assert {entry["name"]: entry["frames"] for entry in manifest["submaps"]} == {
        name: [*folder] for name, folder in SUBMAPS.items()
    }
    assert (manifest["source"], manifest["rate"], manifest["timestamps"]) == (["withdrawal.mp4"], RATE, "s")
    for entry in manifest["submaps"]:
        segment, number = entry["name"].split("/")
        folder = tmp_path / "export" / entry["folder"]
        assert entry["folder"] == f"{segment}-{number}"
        path, model = tum.read(folder / "trajectory.txt"), colmap.read(out / segment / "poses" / "sparse" / number)
        np.testing.assert_array_equal(path.timestamps, np.array(entry["frames"]) / RATE)
        np.testing.assert_allclose(path.camera_to_world, model.camera_to_world, atol=1e-9)
        scene = open_scene(folder / "colmap", "colmap", ["initial_points=none"])
        assert len(scene.video) == len(entry["frames"]) == len(list((folder / "colmap" / "images").iterdir()))
        assert entry["nerfstudio"] == (number != "2") == (folder / "nerfstudio" / "transforms.json").is_file()
    by_name = {entry["name"]: entry for entry in manifest["submaps"]}
    joined = {name for name, entry in by_name.items() if entry["joined_to"] != name}
    assert joined == {"segment-001/0"}
    assert by_name["segment-001/0"]["joined_to"] == "segment-000/2"
    np.testing.assert_allclose(by_name["segment-001/0"]["to_joined"], similarity(1))
    np.testing.assert_array_equal(by_name["segment-000/2"]["to_joined"], np.eye(4))
    assert [entry["reason"] for entry in manifest["joins"]] == [entry["reason"] for entry in JOINS]
    manifest = export_atlas(short, tmp_path / "short-export")
    assert [(entry["name"], entry["folder"], entry["nerfstudio"]) for entry in manifest["submaps"]] == [
        (f"sub-map {number}", f"submap-{number}", number != 2) for number in range(3)
    ]
    assert manifest["joins"] == [] and manifest["size"] == [40, 32]
    assert colmap.read(tmp_path / "short-export" / "submap-1" / "colmap" / "sparse" / "0").names


def test_timestamps_are_frame_numbers_where_the_rate_is_unknown_and_those_of_frames_where_it_varies(out, tmp_path):
    change_video(out, rate=None)
    assert export_atlas(out, tmp_path / "export")["timestamps"] == "frame number"
    assert tum.read(tmp_path / "export" / "segment-001-1" / "trajectory.txt").timestamps.tolist() == [*range(40, 52)]
    times = np.cumsum(np.random.default_rng(0).uniform(0.02, 0.3, 100))
    replace(Survey.read(out), times=times).write(out)
    for entry in export_atlas(out, tmp_path / "export", overwrite=True)["submaps"]:
        path = tum.read(tmp_path / "export" / entry["folder"] / "trajectory.txt")
        np.testing.assert_array_equal(path.timestamps, times[entry["frames"]])


@pytest.mark.parametrize(("link", "other_disk"), [(False, False), (True, False), (True, True)])
def test_linked_images_take_no_space_on_the_same_disk(out, tmp_path, monkeypatch, link, other_disk):
    def refused(*_):
        raise OSError(18, "Invalid cross-device link")

    if other_disk:
        monkeypatch.setattr("os.link", refused)
    export_atlas(out, tmp_path / "export", link=link)
    for file, is_linked in (("images/003.png", link and not other_disk), ("sparse/0/images.bin", False)):
        entry, other = out / "segment-000/poses" / file, tmp_path / "export/segment-000-0/colmap" / file
        assert entry.read_bytes() == other.read_bytes()
        assert entry.samefile(other) is is_linked


def test_what_cannot_be_exported_is_refused(out, tmp_path):
    export = tmp_path / "export"
    export_atlas(out, export)
    with pytest.raises(InputError, match="already exists"):
        export_atlas(out, export)
    with pytest.raises(InputError, match="a folder apart from the input"):
        export_atlas(out, out / "export")
    file = out / "segment-000" / "poses" / "atlas.json"
    content = json.loads(file.read_text())
    content["submaps"][0]["frames"].pop()
    write_json(file, content)
    before = (export / "manifest.json").read_bytes()
    with pytest.raises(InputError, match=r"sparse/0 has 14 frames, .* names 13 of it"):
        export_atlas(out, export, overwrite=True)
    assert (export / "manifest.json").read_bytes() == before
    for segment in ("segment-000", "segment-001"):
        (out / segment / "poses" / "atlas.json").unlink()
    with pytest.raises(InputError, match=r"has no sub-map with poses"):
        export_atlas(out, export, overwrite=True)


def test_the_command_names_the_sub_maps(out, tmp_path, capsys):
    assert commands.run("poses", "export", out, "--output", tmp_path / "export") == 0
    printed = capsys.readouterr().out
    assert "segment-001/0: 14 frames, unit unknown, joined to segment-000/2" in printed
    assert "segment-000/2: 5 frames, unit unknown, no dense depth" in printed
