"""A film, an atlas, and stages of a reconstruction that only tell that they were run."""

from __future__ import annotations

import shutil

import pytest

from coliags_plugin.pipeline import reconstruct, steps
from coliags_plugin.pipeline.reconstruct import StageTask
from coliags_plugin.pipeline.stages import StageRecord
from coliags_plugin.reporting.video import write_video
from tests.pipeline.films import film
from tests.pipeline.reconstructions import write_atlas, write_long, write_short
from tests.task_list import TaskList

CAPTURE = ("make_poses", "check_data", "estimate_depth")
TRAINING = ("train", "evaluate", "mesh", "judge_geometry", "coverage", "show", "report")


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


@pytest.fixture
def atlas(tmp_path):
    return write_atlas(tmp_path / "atlas")


@pytest.fixture(scope="session")
def folders(tmp_path_factory):
    """The folders of :mod:`tests.pipeline.reconstructions`, not to be changed."""
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
