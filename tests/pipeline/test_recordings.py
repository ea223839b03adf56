"""Recordings of a calibrated endoscope: a folder with a video and a calibration file."""

from __future__ import annotations

import logging
import shutil
from dataclasses import replace

import numpy as np
import pytest

import coliags_plugin as cp
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import write_image
from coliags_plugin.engine.data_formats import find_format
from coliags_plugin.geometry.lenses.models import LENSES
from coliags_plugin.pipeline import steps
from coliags_plugin.pipeline.frame_sources import opened_recording
from coliags_plugin.reconstruction.structure.sfm_settings import CameraSettings, SfmSettings, Start, starting_cameras
from tests import commands
from tests.layouts.endomapper import calibration_text
from tests.pipeline.conftest import CAPTURE, TRAINING, Killed
from tests.pipeline.films import HEIGHT, WIDTH, film, write_images

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
