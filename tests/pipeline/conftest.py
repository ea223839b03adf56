"""A film, and stages of a reconstruction that only tell that they were run."""

from __future__ import annotations

import pytest

from coliags_plugin.outputs.video import write_video
from coliags_plugin.pipeline import capture_stages, training_stages
from coliags_plugin.pipeline.stages import StageOutcome
from tests.pipeline.films import film

CAPTURE, TRAINING = ("make_poses", "check_data", "estimate_depth"), ("train", "evaluate", "mesh", "coverage", "report")


class Killed(BaseException):
    """Ends a process wherever it is."""


@pytest.fixture
def done(monkeypatch):
    """Names of the stages that were run, behind the folder of the sub-map; all but the first, quick one are faked."""
    names: list[str] = []

    def faked(name):
        def work(context):
            names.append("/".join(filter(None, (context.submap.folder, name))))
            return StageOutcome(f"{name} done", {name: "a file"})

        return work

    write = capture_stages.make_frames
    monkeypatch.setattr(capture_stages, "make_frames", lambda context: (names.append("make_frames"), write(context))[1])
    for module, functions in ((capture_stages, CAPTURE), (training_stages, TRAINING)):
        for function in functions:
            monkeypatch.setattr(module, function, faked(function))
    return names


@pytest.fixture
def video(tmp_path):
    write_video(film(range(0, 120, 8)), tmp_path / "film.mp4", 15.0)
    return tmp_path / "film.mp4"
