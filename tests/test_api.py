"""The Python API: the same results as the command line, errors instead of exit statuses, lazy import."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest
import torch

import coliags_plugin
from coliags_plugin.core.errors import InputError
from coliags_plugin.engine.trained import TrainedRun
from tests.commands import run
from tests.scenes import SMALL, write_wall


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_wall(tmp_path_factory.mktemp("data") / "wall", frames=17)


@pytest.fixture(scope="module")
def trained(scene, tmp_path_factory):
    output = tmp_path_factory.mktemp("runs") / "run"
    assert coliags_plugin.train("coliags", scene, output, overrides=[*SMALL, "schedule.steps=8"], seed=3) == output
    return output


def test_train_is_the_command(scene, trained, tmp_path):
    sets = [part for override in SMALL for part in ("--set", override)]
    assert run("train", "coliags", "--data", scene, "--output", tmp_path / "run", "--steps", 8, "--seed", 3, *sets) == 0
    ours, theirs = (coliags_plugin.load_run(path) for path in (trained, tmp_path / "run"))
    assert isinstance(ours, TrainedRun) and ours.step == theirs.step == 8
    states = ours.model.state_dict(), theirs.model.state_dict()
    assert states[0].keys() == states[1].keys()
    assert all(torch.equal(states[0][name], states[1][name]) for name in states[0])


def test_a_loaded_run_renders_and_is_evaluated(scene, trained):
    loaded = coliags_plugin.load_run(trained)
    frame = coliags_plugin.load_scene(scene, options=["frame_step=4"]).train[0]
    image = loaded.model.render(frame.camera).rgb
    assert image.shape == frame.rgb.shape and image.max() > 0.1
    summary = coliags_plugin.evaluate(loaded)
    assert summary == coliags_plugin.evaluate(trained, "paper")
    assert summary == json.loads((trained / "eval/paper/metrics.json").read_text(encoding="utf-8"))


def test_training_resumes(scene, trained):
    overrides = ["schedule.steps=10"]
    assert coliags_plugin.train("coliags", scene, trained, overrides=overrides, resume=True) == trained
    assert coliags_plugin.load_run(trained).step == 10


def test_errors_say_what_to_do(scene, trained, tmp_path):
    with pytest.raises(InputError, match="already exists"):
        coliags_plugin.train("coliags", scene, trained)
    with pytest.raises(InputError, match="not a run folder"):
        coliags_plugin.load_run(tmp_path)
    with pytest.raises(InputError, match="no folder"):
        coliags_plugin.load_scene(tmp_path / "gone")
    with pytest.raises(AttributeError, match="no attribute 'trian'"):
        _ = coliags_plugin.trian


def test_importing_the_package_imports_no_torch():
    code = "import sys, coliags_plugin; sys.exit('torch' in sys.modules or 'numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
