"""A film, an atlas, and stages of a reconstruction that only tell that they were run."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from coliags_plugin.core.files import write_json
from coliags_plugin.core.images import write_image
from coliags_plugin.core.scene_files import write_unit
from coliags_plugin.datamanagers.colmap import ATLAS_FILE
from coliags_plugin.geometry.poses.colmap import write_reconstruction
from coliags_plugin.phantom.layouts import SeenPoints, add_points
from coliags_plugin.pipeline import reconstruct, steps
from coliags_plugin.pipeline.reconstruct import StageTask
from coliags_plugin.pipeline.stages import StageRecord
from coliags_plugin.reporting.video import write_video
from tests.pipeline.films import film
from tests.reconstruction.seen_points import frame_model
from tests.task_list import TaskList
from tests.textured_tube import tube_frames

CAPTURE = ("make_poses", "check_data", "estimate_depth")
TRAINING = ("train", "evaluate", "mesh", "coverage", "show", "report")


#: Frames of the models, along the video; the last is too small.
COUNTS = (14, 12, 5)


class Killed(BaseException):
    """Ends a process wherever it is."""


@pytest.fixture
def calls(monkeypatch):
    """Names of the stages that were run, behind the folder of the sub-map; all but the first, quick one are faked."""
    names: list[str] = []

    def faked(name):
        def work(context):
            names.append("/".join(filter(None, (context.submap and context.submap.folder, name))))
            return StageRecord(f"{name} done", {name: "a file"})

        return work

    write = steps.make_frames
    monkeypatch.setattr(steps, "make_frames", lambda context: (names.append("make_frames"), write(context))[1])
    for function in (*CAPTURE, *TRAINING):
        monkeypatch.setattr(steps, function, faked(function))
    return names


@pytest.fixture
def video(tmp_path):
    write_video(film(range(0, 120, 8)), tmp_path / "film.mp4", 15.0)
    return tmp_path / "film.mp4"


def write_atlas(folder, counts=COUNTS, units=("unknown", "unknown", "unknown"), listed=True):
    """A scene of several models, each with a point before every camera, and the ``atlas.json`` that lists them."""
    (folder / "images").mkdir(parents=True)
    start, submaps, names = 0, [], []
    for number, count in enumerate(counts):
        frames = tube_frames(count, 1.0, (40, 32))
        own = [f"{start + index:03d}.png" for index in range(count)]
        for frame, name in zip(frames, own, strict=True):
            write_image(folder / "images" / name, frame.image.numpy())
        model = frame_model(frames, own)
        poses = np.stack([frame.camera.camera_to_world.numpy() for frame in frames])
        points = poses[:, :3, 3] + 2.0 * (number + 1) * poses[:, :3, 2]
        seen = [SeenPoints(np.array([[20.0, 16.0]]), np.array([index])) for index in range(count)]
        add_points(model, seen, points, np.zeros((count, 3), np.uint8))
        write_reconstruction(folder / f"sparse/{number}", model)
        stretch = {"model": f"sparse/{number}", "unit": units[number], "frames": [*range(start, start + count)]}
        submaps.append(stretch)
        names += own
        start += count
    write_unit(folder, units[0])
    if listed:
        lost = [{"frame": start, "reason": "blurred"}]
        write_json(folder / ATLAS_FILE, {"frames": [*names, "lost.png"], "submaps": submaps, "joins": [], "lost": lost})
    return folder


@pytest.fixture
def atlas(tmp_path):
    return write_atlas(tmp_path / "atlas")


@pytest.fixture(scope="session")
def folders(tmp_path_factory):
    """The folders of :mod:`tests.pipeline.reconstructions`, not to be changed."""
    from tests.pipeline.reconstructions import write_long, write_short  # which uses this module

    folder = tmp_path_factory.mktemp("folders")
    return {"long": write_long(folder / "long"), "short": write_short(folder / "short")}


@pytest.fixture
def out(folders, tmp_path):
    """A copy of the long video's."""
    return shutil.copytree(folders["long"], tmp_path / "out")


@pytest.fixture
def short(folders, tmp_path):
    """A copy of the short video's."""
    return shutil.copytree(folders["short"], tmp_path / "short")


class Workers(TaskList):
    """Work as the processes do, in this one; the first tasks end in some other way instead."""

    def __init__(self, *endings):
        super().__init__()
        self.endings = list(endings)

    def outcome(self, task):
        assert StageTask.from_json(task.to_json()) == task
        ending = self.endings.pop(0) if self.endings else None
        if isinstance(ending, BaseException):
            raise ending
        return ending or task.attempt()


@pytest.fixture
def workers(monkeypatch):
    def use(*endings):
        executor = Workers(*endings)
        monkeypatch.setattr(reconstruct, "make_executor", lambda options: executor)
        return executor

    return use
