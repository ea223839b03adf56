"""Reconstruction of a video, as a command and as a function, and of recordings of a calibrated endoscope."""

from __future__ import annotations

import errno
import json
import logging
import re
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import coliags_plugin as cp
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import not_writable
from coliags_plugin.core.images import write_image
from coliags_plugin.core.render_output import RenderOutput
from coliags_plugin.core.scene_files import read_unit
from coliags_plugin.engine.data_formats import find_format
from coliags_plugin.export.baking import distillation
from coliags_plugin.geometry.lenses.models import LENSES
from coliags_plugin.geometry.meshes.mesh import TriangleMesh, read_mesh
from coliags_plugin.geometry.poses import colmap
from coliags_plugin.geometry.poses.alignment import align, associate
from coliags_plugin.geometry.poses.trajectory import Trajectory
from coliags_plugin.pipeline import steps, verdict
from coliags_plugin.pipeline.frame_sources import opened_recording
from coliags_plugin.pipeline.reconstruct import forecast
from coliags_plugin.pipeline.settings import ReconstructionSettings
from coliags_plugin.pipeline.steps import identity_of
from coliags_plugin.pipeline.verdict import LIMITS, VERDICTS, judge, measured_geometry
from coliags_plugin.reconstruction.structure.sfm_settings import CameraSettings, SfmSettings, Start, starting_cameras
from coliags_plugin.reporting.video import write_video
from coliags_plugin.results.reading import read_result
from tests import commands
from tests.layouts import calibration_text
from tests.pipeline.conftest import CAPTURE, TRAINING, Killed
from tests.pipeline.films import HEIGHT, WIDTH, film, write_film, write_images
from tests.pipeline.reconstructions import judged
from tests.textured_tube import INTRINSICS, tube_frames, write_tube

_COVERAGE = steps.coverage


def test_stages_of_a_video(calls, video, tmp_path, capsys):
    argv = ("reconstruct", video, "--output", tmp_path / "out", "--steps", 50, "--diameter", 40)
    assert commands.run(*argv) == 0
    assert calls == ["make_frames", *CAPTURE, *TRAINING]
    printed = capsys.readouterr().out
    assert printed.startswith("survey: 15 frames in 1 segment\nframes: 15 of 15 frames, 160 x 120 px")
    assert f"{tmp_path / 'out' / 'frames' / 'images'}: frames of use, PNG" in printed
    page = (tmp_path / "out" / "index.html").read_text()
    assert 'href="frames/images"' in page
    assert "15 of 15 frames, 160 x 120 px" in page
    calls.clear()
    assert commands.run(*argv) == 0
    assert calls == []
    # Of other options, those that no stage that is done depends on are taken.
    message = commands.refused(capsys, *argv[:-3], 60, *argv[-2:])
    assert "stage train was made with steps 50, not 60" in message
    assert commands.run(*argv[:-3], 60, *argv[-2:], "--overwrite") == 0
    assert calls == [*TRAINING]
    write_video(film(range(0, 60, 4)), video, 15.0)
    message = commands.refused(capsys, *argv)
    assert re.search(r"stage survey was made with source.bytes \d+, not \d+", message)


def test_so_many_frames_a_second_are_used(calls, tmp_path, capsys):
    video = tmp_path / "film.mp4"
    write_video(film(range(0, 120, 3)), video, 60.0)
    argv = ("reconstruct", video, "--output", tmp_path / "out", "--frames-per-second")
    assert commands.run(*argv, 30, "--to", 0.5) == 0
    record = json.loads((tmp_path / "out" / "reconstruction.json").read_text())["stages"]["frames"]
    assert record["options"]["frames"]["every"] == 2 and record["options"]["frames"]["last"] == 30
    assert record["summary"].startswith("16 of 31 frames")
    times = [*range(0, 400, 20), *range(2000, 6000, 200)]
    write_film(film(range(0, 120, 3)), tmp_path / "variable.mp4", times=times)
    variable = ("reconstruct", tmp_path / "variable.mp4", "--output", tmp_path / "variable", "--frames-per-second")
    assert commands.run(*variable, 10, "--from", 0.2, "--to", "0:04") == 0
    frames_used = [
        frame["frame"] for frame in json.loads((tmp_path / "variable/frames/frames.json").read_text())["kept"]
    ]
    assert [frame // 5 for frame in frames_used[:2]] == [2, 3] and frames_used[2:] == list(range(20, 31))
    images = write_images(tmp_path / "images", film(range(0, 60, 6)))
    assert "Expected one of them" in commands.refused(capsys, *argv, 30, "--every", 2)
    assert "a number between 0 and" in commands.refused(capsys, *argv, 0)
    message = commands.refused(capsys, "reconstruct", images, "--output", tmp_path / "no", "--frames-per-second", 5)
    assert "does not tell how many frames a second" in message and "--every N" in message


def test_hidden_files_make_no_other_video(tmp_path):
    before = identity_of(write_images(tmp_path / "images", film(range(2))))
    (tmp_path / "images/.DS_Store").write_bytes(b"view of the folder")
    assert identity_of(tmp_path / "images") == before


def test_a_scene_with_poses_needs_neither_frames_nor_poses(calls, video, tmp_path):
    scene = write_tube(tmp_path / "tube", 6, 3.0)
    cp.reconstruct(scene, tmp_path / "out")
    with_depth = any(path.name.startswith("depth") for path in scene.iterdir())
    assert calls == ["check_data", *([] if with_depth else ["estimate_depth"]), *TRAINING]
    with pytest.raises(InputError, match=r"stage check was made with source\.name tube, not None"):
        cp.reconstruct(video, tmp_path / "out")
    with pytest.raises(InputError, match=r"tube has poses, and settings of diameter, frames are given"):
        cp.reconstruct(scene, tmp_path / "other", settings={"diameter": 40.0, "frames.every": 2})


def test_coverage_is_left_out_where_it_cannot_be_measured_but_not_where_it_cannot_be_written(
    calls, tmp_path, monkeypatch, caplog
):
    scene = write_tube(tmp_path / "tube", 6, 3.0)
    monkeypatch.setattr(steps, "coverage", _COVERAGE)
    monkeypatch.setattr(steps, "read_mesh", lambda path: None)

    def failing(error):
        def measure_scene(*args, **options):
            raise error

        monkeypatch.setattr(steps, "measure_scene", measure_scene)

    full = not_writable(tmp_path, OSError(errno.ENOSPC, "No space left on device"))
    failing(full)
    with pytest.raises(InputError, match=r"stage coverage: .*No space left"):
        cp.reconstruct(scene, tmp_path / "out")
    assert json.loads((tmp_path / "out" / "reconstruction.json").read_text())["stages"]["coverage"]["state"] == "failed"
    failing(InputError("too few triangles"))
    cp.reconstruct(scene, tmp_path / "out")
    assert "no coverage: too few triangles" in caplog.text


@pytest.mark.parametrize("name", LIMITS)
def test_every_figure_can_give_each_verdict(name):
    limit = LIMITS[name]
    beyond = 1.01 * limit.not_usable if limit.not_usable > limit.doubtful else 0.99 * limit.not_usable
    between = 0.5 * (limit.doubtful + limit.not_usable)
    good = limit.doubtful + (limit.doubtful - limit.not_usable)
    for value, word in zip((max(good, 0.0), between, beyond), VERDICTS, strict=True):
        judged_word, reasons = judge({name: value})
        assert judged_word == word and len(reasons) == (word != "usable")
    assert judge({name: limit.doubtful})[0] == "doubtful" and judge({name: limit.not_usable})[0] == "not usable"


def test_the_worst_figure_gives_the_verdict_and_reasons_come_in_its_order():
    good = {"frames": 99, "gap": 0.5, "confident": 0.8, "contradicted": 0.0, "largest_part": 1.0, "psnr": 1.0}
    assert judge(good) == judge({}) == ("usable", [])
    gap, parts = (
        "held-out views are 6.0 dB worse than training views",
        "the largest piece of the mesh has 20 % of its area",
    )
    assert judge({**good, "gap": 6.0}) == ("doubtful", [gap])
    assert judge({**good, "gap": 6.0, "largest_part": 0.2}) == ("not usable", [parts, gap])


@pytest.mark.parametrize(("factors", "expected"), [((1.0, 1.0), 0.0), ((1.0, 1.04), 0.0), ((1.0, 1.06), 1.0)])
def test_views_of_one_wall_agree_and_those_of_walls_apart_do_not(monkeypatch, factors, expected):
    """A tube whose depth every other view sees as larger by a factor; pieces of three and one unit of area."""
    frames = tube_frames(8, 2.0)
    depths = {frame.name: frame.depth * factors[index % 2] for index, frame in enumerate(frames)}
    monkeypatch.setattr(
        verdict,
        "render_view",
        lambda trained, frame, wants: RenderOutput(
            torch.zeros(*frame.depth.shape, 3),
            torch.ones_like(frame.depth),
            frame.camera,
            {"depth_accumulated": depths[frame.name]},
        ),
    )
    corners = np.array([[0, 0, 0], [6, 0, 0], [0, 1, 0], [9, 9, 9], [9, 11, 9], [9, 9, 10]], np.float32)
    mesh = TriangleMesh(corners, np.arange(6).reshape(2, 3))
    figures = measured_geometry(SimpleNamespace(scene=SimpleNamespace(train=frames)), mesh)
    assert (figures["parts"], figures["largest_part"]) == (2, 0.75)
    assert figures["covered"] == 0.0
    # Others of the same factor do not contradict, and the ends of the tube are out of each other's sight.
    assert 0.45 * expected <= figures["contradicted"] <= 0.65 * expected


def test_the_coverage_of_what_is_not_usable_is_not_measured(calls, tmp_path, monkeypatch):
    monkeypatch.setattr(steps, "coverage", _COVERAGE)
    monkeypatch.setattr(steps, "judge_geometry", lambda context: judged("not usable", "only 5 frames"))
    record = cp.reconstruct(write_tube(tmp_path / "tube", 6, 3.0), tmp_path / "out")
    assert record.stages["coverage"].summary == "left out: the geometry is not usable"
    assert not record.stages["coverage"].figures and record.stages["verdict"].figures["verdict"] == "not usable"
    assert "not usable: only 5 frames" in (tmp_path / "out" / "index.html").read_text()


def test_bad_input_leaves_nothing(tmp_path, capsys):
    (tmp_path / "noise.mp4").write_bytes(b"no video" * 100)
    folder = write_images(tmp_path / "film", film(range(0, 60, 6)))
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").touch()
    out = tmp_path / "out"
    for argv, message in (
        ((tmp_path / "noise.mp4", "--output", out), "cannot be opened as a video by FFmpeg"),
        ((folder, "--output", folder), "Expected a folder apart from the input"),
        ((folder, "--output", folder / "out"), "Expected a folder apart from the input"),
        ((folder, "--output", tmp_path / "full"), "already exists and is no reconstruction"),
        ((folder, "--output", out, "--mask", tmp_path / "no.png"), "no file"),
        ((folder, "--output", out, "--mask", folder), "is a folder. Expected an image, black where"),
        ((folder, "--output", out, "--diameter", 0), "diameter"),
        ((folder, "--output", out, "--set", "frames.evry=2"), "Did you mean 'every'?"),
        ((folder, "--output", out, "--size", "big"), "--size big"),
        ((folder, "--output", out, "--method", "coliagz"), "coliagz"),
    ):
        assert message in commands.refused(capsys, "reconstruct", *argv)
        assert not out.exists()


@pytest.mark.thorough
def test_a_tube_is_reconstructed_from_its_frames(tmp_path, monkeypatch):
    """All stages on ten small frames; a few steps of training, so that only the path is exact."""
    monkeypatch.setattr(distillation, "STEPS", 3)
    frames = tube_frames(10, 2.0)
    folder = write_images(tmp_path / "film", [frame.image.numpy() for frame in frames])
    settings = {
        "sfm.camera.model": "PINHOLE",
        "sfm.camera.params": INTRINSICS,
        "steps": 20,
    }
    record = cp.reconstruct(folder, tmp_path / "out", settings=settings)
    assert {stage.state for stage in record.stages.values()} == {"done"}
    assert read_unit(tmp_path / "out" / "poses") == "unknown"
    estimate = colmap.read(tmp_path / "out" / "poses" / "sparse" / "0")
    truth = Trajectory(np.stack([frame.camera.camera_to_world.numpy() for frame in frames]))
    assert align(estimate, truth, associate(estimate, truth, "index"), with_scale=True).ate.rmse < 0.1
    assert len(read_mesh(tmp_path / "out" / "run" / "mesh" / "mesh.ply")) > 100
    for stage in record.stages.values():
        for path in stage.files:
            assert (tmp_path / "out" / path).exists()
    assert (tmp_path / "out" / "report.html").stat().st_size > 10_000
    figures, result = record.stages["evaluate"].figures, read_result(tmp_path / "out/run/eval/paper/result.json")
    assert len(result.sets["test"].frames) == 1 and "4" in result.sets["test"].frames[0]
    assert figures["held_out"] == 1 and figures["psnr_training"] > 10.0 and figures["psnr_pose_refined"] > 10.0
    page = (tmp_path / "out" / "index.html").read_text(encoding="utf-8")
    assert "10 of 10 used (100 %)" in page and f"{figures['psnr']:.2f}" in page
    pictures = set(re.findall(r'src="(data:image[^"]+)"', page))
    assert len(pictures) == 10 + 4 + 1 + 4 * 3  # time line; one view and hatch; four frames, their depth and light
    assert page.count("<iframe") == 1 and 'src="index_files' not in page


class Frames:
    """A source of as many frames as it says."""

    def __init__(self, expected):
        self.expected = expected

    def __iter__(self):
        yield "frame_000000", np.zeros((384, 384, 3), np.uint8)


def test_the_clip_that_it_was_measured_on():
    """247 frames: 2,400 s of processor time and 487 MB."""
    frames, seconds, size = forecast(Frames(247), ReconstructionSettings())
    assert frames == 247 and seconds == pytest.approx(2400.0, rel=0.2) and size == pytest.approx(487e6, rel=0.3)


#: C3VD's, for whole frames of the film's aspect ratio.
LENS = replace(LENSES["fisheye"], height=1012)


@pytest.fixture
def recording(video):
    folder = video.parent / "Seq_001"
    folder.mkdir()
    shutil.move(video, folder / "Seq_001.MOV")
    (folder / "endoscope.xml").write_text(calibration_text(LENS))
    (folder / "Seq_001.json").write_text("{}")
    return folder


def test_the_video_is_found_and_its_camera_scaled_to_the_frames(recording, caplog):
    write_image(recording / "thumbnail.png", film([0])[0])
    with caplog.at_level(logging.WARNING):
        source, settings = opened_recording(recording, SfmSettings(seed=3))
    assert caplog.records == []
    assert source == recording / "Seq_001.MOV"
    assert settings.seed == 3
    camera = settings.camera
    assert camera.model == "OPENCV_FISHEYE"
    (started,) = starting_cameras(camera, [], [(WIDTH, HEIGHT)], Start(camera.model, 1.0))
    assert (started.width, started.height) == (WIDTH, HEIGHT)
    points = np.random.default_rng(0).uniform((-0.8, -0.6, 1.0), (0.8, 0.6, 1.0), (50, 3))
    np.testing.assert_allclose(
        started.img_from_cam(points), LENS.project(points) * (WIDTH / 1350, HEIGHT / 1012), atol=1e-6
    )


@pytest.mark.parametrize("kind", ["video", "images"])
def test_a_calibration_file_is_named_as_the_camera(recording, tmp_path, kind):
    source = recording / "Seq_001.MOV" if kind == "video" else write_images(tmp_path / "frames", film(range(3)))
    named = CameraSettings(model=str(recording / "endoscope.xml"))
    assert opened_recording(source, SfmSettings()) == (source, SfmSettings())
    source_found, settings = opened_recording(source, SfmSettings(camera=named))
    assert source_found == source
    assert settings == opened_recording(recording, SfmSettings())[1]
    other = SfmSettings(camera=CameraSettings(model="PINHOLE", params=(9.0, 9.0, 8.0, 8.0)))
    assert opened_recording(recording, other)[1] == other
    with pytest.raises(InputError, match=r"`params`, and `camera=.*endoscope\.xml"):
        opened_recording(source, SfmSettings(camera=named.model_copy(update={"params": (1.0,)})))
    with pytest.raises(InputError, match=r"cannot read .*gone\.xml"):
        opened_recording(source, SfmSettings(camera=CameraSettings(model="gone.xml")))


def test_without_calibration_images_beside_a_video_are_the_frames_or_its_camera_is_estimated(recording, caplog):
    (recording / "endoscope.xml").unlink()
    with caplog.at_level(logging.WARNING):
        assert opened_recording(recording, SfmSettings()) == (recording / "Seq_001.MOV", SfmSettings())
    assert "Seq_001 has no calibration file: its camera is estimated" in caplog.text
    write_images(recording, film(range(3)))
    assert opened_recording(recording, SfmSettings()) == (recording, SfmSettings())


def test_what_does_not_fit_is_refused(recording):
    file = recording / "endoscope.xml"
    file.write_text(calibration_text(LENSES["fisheye"]).replace("1080", "1350"))
    with pytest.raises(InputError, match=r"endoscope\.xml, and images of 160 x 120. Expected the whole frame, 1350 x"):
        opened_recording(recording, SfmSettings())
    file.write_text(calibration_text(LENS)[:-20])
    with pytest.raises(InputError, match=r"endoscope\.xml is not XML"):
        opened_recording(recording, SfmSettings())
    with pytest.raises(InputError, match=r"the video Seq_001\.MOV, and no scene.* coliags reconstruct \S*Seq_001 "):
        find_format(recording)


def test_it_is_reconstructed_with_its_camera(calls, recording, tmp_path, monkeypatch):
    seen = []
    fake = steps.make_poses
    monkeypatch.setattr(steps, "make_poses", lambda context: (seen.append(context.settings), fake(context))[1])
    cp.reconstruct(recording, tmp_path / "out")
    assert calls == ["make_frames", *CAPTURE, *TRAINING]
    assert seen[0].sfm == opened_recording(recording, SfmSettings())[1]
    assert str(tmp_path) not in (tmp_path / "out" / "reconstruction.json").read_text()
    # The camera is known by its numbers: the same file elsewhere is the same, another one is not.
    (recording / "endoscope.xml").rename(tmp_path / "other.xml")
    settings = {"sfm.camera.model": str(tmp_path / "other.xml")}
    calls.clear()
    cp.reconstruct(recording, tmp_path / "out", settings=settings)
    assert calls == []
    (tmp_path / "other.xml").write_text(calibration_text(LENS).replace("767.38", "777.38"))
    with pytest.raises(InputError, match=r"stage poses was made with sfm\.camera\.params"):
        cp.reconstruct(recording, tmp_path / "out", settings=settings)


def test_poses_are_estimated_with_its_camera(recording, tmp_path, monkeypatch):
    from coliags_plugin.reconstruction.structure import sfm

    def stop(images, settings, masks, progress):
        raise Killed(images, settings)

    monkeypatch.setattr(sfm, "reconstruct", stop)
    with pytest.raises(Killed) as stopped:
        commands.run("poses", "sfm", recording, "--output", tmp_path / "out", "--set", "exhaustive_up_to=9")
    images, settings = stopped.value.args
    assert len(images) == 15 and settings.exhaustive_up_to == 9
    assert settings.camera == opened_recording(recording, SfmSettings())[1].camera
