"""The learned light: its numbers in results, and views in flattened light."""

from __future__ import annotations

import json

import pytest
import torch

import coliags_plugin
from coliags_plugin.core.errors import InputError
from tests.commands import refused, run
from tests.scenes import write_wall


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run of a few steps on the wall."""
    folder = tmp_path_factory.mktemp("light")
    return coliags_plugin.train(
        "coliags-plus", write_wall(folder / "wall", frames=9), folder / "run", steps=4, device="cpu"
    )


def test_learned_numbers_are_in_the_metrics(trained):
    result = trained.evaluate()
    learned = result.provenance["learned"]
    assert set(learned) == {"field", "exposure", "response"} and len(learned["field"]["distance_exponent"]) == 3
    summary = json.loads((trained.path / "eval" / "paper" / "metrics.json").read_text())
    assert summary["learned"] == learned


def test_gains_at_a_bound_are_said(trained, caplog):
    loaded = coliags_plugin.load_run(trained.path, device="cpu")
    with torch.no_grad():
        loaded.load().model.view_modules["exposure"].log_gain[3] = 90.0
    loaded.evaluate()
    name = loaded.load().scene.train[3].name
    assert f"module 'exposure' is at a bound in 1 frames: {name}" in caplog.text


def test_the_command_writes_flattened_views(trained, capsys):
    run("render", str(trained.path), "--no-video", "--flatten")
    assert not (trained.path / "relit" / "rgb_error").exists()
    assert "distance" in (trained.path / "relit" / "lamp.yaml").read_text()
    with pytest.raises(InputError, match="relit run"):
        trained.flatten().evaluate()
    assert "one of them" in refused(capsys, "render", str(trained.path), "--flatten", "--light", "power=2")
