"""The memory that training takes on a device: predicted, counted, refused and run out of."""

import logging
from dataclasses import replace
from importlib.util import find_spec

import pytest
import torch

from coliags_plugin.config.method_config import load_method
from coliags_plugin.core.errors import DeviceMemoryError, InputError
from coliags_plugin.core.scenes import PointCloud
from coliags_plugin.engine.memory import ERROR, check_memory, forecast
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.engine.trainer import Trainer
from tests.live_storages import LiveStorages
from tests.pretended_cuda import CUDA, PretendedCuda
from tests.scenes import SMALL, wall_scene

CPU = torch.device("cpu")
#: Those whose memory docs/rendering.md tells.
METHODS = ("3dgs", "2dgs", "coliags")


def make_trainer(path, method="3dgs", device=CPU, overrides=(), scene=None):
    steps = ["schedule.steps=3", "schedule.written_for=3"]
    own = SMALL if load_method(method).config.field.name == "anchors" else ()
    return Trainer(
        load_method(method, [*steps, *own, *overrides]), scene or wall_scene(), "wall", RunFolder(path), 0, device
    )


def parameters_of(trainer):
    return sum(value.nbytes for group in trainer.model.parameter_groups().values() for value in group)


def test_storages_are_counted_until_they_are_freed():
    with LiveStorages() as live:
        first = torch.zeros(1000)
        second = first + 1.0
        first.view(10, 100).mul_(2.0)  # the same storage
        assert live.peak == 8000
        del first
        third = torch.zeros(500, requires_grad=True)
        (third.exp() * 2.0).sum().backward()
    assert 8000 + 2000 <= live.peak <= 8000 + 4 * 2000 + 100 and len(second) == 1000


@pytest.mark.thorough
@pytest.mark.skipif(find_spec("triton") is None, reason="triton is not installed")
@pytest.mark.parametrize("method", METHODS)
def test_the_prediction_is_what_a_step_takes(method, tmp_path):
    """Storages of a second step, in triton's interpreter; a step before it has made Adam's moments."""
    whole = wall_scene()
    scene = whole if method == "coliags" else replace(whole, points=PointCloud(whole.points.positions[::4]))
    with PretendedCuda():
        trainer = make_trainer(tmp_path, method, CUDA, scene=scene)
        trainer.take_step()
        needed = forecast(trainer.model, trainer.wants, trainer.scene.train)
        with LiveStorages() as live:
            trainer.take_step()
    states = [state for adam in trainer.optimizers.adam.values() for state in adam.state.values()]
    moments = sum(value.nbytes for state in states for value in state.values() if value.ndim)
    assert moments == 2 * parameters_of(trainer)
    assert needed.total == pytest.approx(live.peak + moments + parameters_of(trainer), rel=ERROR)


def test_what_a_forecast_counts(tmp_path):
    trainer = make_trainer(tmp_path)
    needed = forecast(trainer.model, trainer.wants, trainer.scene.train)
    parameters = parameters_of(trainer)
    assert needed.elements == trainer.model.field.element_count >= needed.drawn > 0
    assert 3 * parameters <= needed.trained <= 3 * parameters + 1000 and needed.gradients == parameters
    assert needed.of_pixels < needed.gradients  # when those are there, it is freed
    assert needed.total == needed.trained + needed.gradients + needed.of_gaussians > needed.least > needed.trained
    twice = needed.with_more(needed.elements)
    assert (twice.elements, twice.drawn, twice.trained) == (2 * needed.elements, 2 * needed.drawn, 2 * needed.trained)
    assert twice.of_pixels == needed.of_pixels
    larger = forecast(trainer.model, trainer.wants, wall_scene(width=64, height=48).train)
    assert larger.of_pixels == 4 * needed.of_pixels > larger.gradients
    assert larger.total == larger.trained + larger.of_pixels + larger.of_gaussians


def test_a_radiance_field_is_what_it_trains(tmp_path):
    trainer = make_trainer(tmp_path, "reim-nerf-small")
    needed = forecast(trainer.model, trainer.wants, trainer.scene.train)
    assert needed.total == needed.trained + needed.gradients > 4 * parameters_of(trainer) > 0
    assert needed.of_gaussians == needed.of_pixels == 0


@pytest.mark.parametrize(("method", "least"), [("coliags", 1), ("3dgs", None), ("reim-nerf-small", 0)])
def test_the_most_that_growth_can_add(method, least, tmp_path):
    strategy = make_trainer(tmp_path, method, overrides=["schedule.steps=30000", "schedule.written_for=30000"]).strategy
    assert strategy.most_added(500) == (least and len(strategy.events))
    assert strategy.most_added(5000) == (least and 10 * len(strategy.events))


def test_a_run_that_does_not_fit_is_refused_before_it_starts(tmp_path, monkeypatch, caplog):
    needed = forecast((trainer := make_trainer(tmp_path)).model, trainer.wants, trainer.scene.train)
    with PretendedCuda():
        monkeypatch.setattr(torch.cuda, "mem_get_info", lambda *_: (int(needed.least) - 1, 2**34))
        with pytest.raises(InputError, match=r"takes about .* GiB: .* cuda:0 has .* GiB free.*points_count"):
            make_trainer(tmp_path / "run", device=CUDA, overrides=["renderer=torch"])
        monkeypatch.setattr(torch.cuda, "mem_get_info", lambda *_: (int(needed.least) + 1, 2**34))
        with caplog.at_level(logging.INFO):
            make_trainer(tmp_path / "run", device=CUDA, overrides=["renderer=torch"])
    assert f"about {needed}" in caplog.text and "each further million elements take" in caplog.text
    assert not (tmp_path / "run").exists()


def test_growth_that_may_not_fit_is_warned_of(monkeypatch, tmp_path, caplog):
    trainer = make_trainer(tmp_path)
    needed = forecast(trainer.model, trainer.wants, trainer.scene.train)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda *_: (2 * needed.total, 2**34))
    check_memory(needed, needed.elements // 2, CUDA)
    assert "growth may need more" not in caplog.text
    check_memory(needed, 2 * needed.elements, CUDA)
    assert f"growth may need more: about {needed.with_more(2 * needed.elements)}" in caplog.text


def test_frames_stay_on_the_cpu_where_they_would_fill_the_device(monkeypatch, tmp_path):
    scene = wall_scene(width=64, height=48)
    with PretendedCuda():
        assert make_trainer(tmp_path, device=CUDA, scene=scene).frames[0].image.is_cuda
        needed = forecast((trainer := make_trainer(tmp_path, scene=scene)).model, trainer.wants, scene.train)
        monkeypatch.setattr(torch.cuda, "mem_get_info", lambda *_: (needed.total + 10_000, 2**34))
        assert not make_trainer(tmp_path, device=CUDA, scene=scene).frames[0].image.is_cuda


def test_memory_that_runs_out_is_told(tmp_path, monkeypatch):
    trainer = make_trainer(tmp_path / "run")
    trainer.start()

    def too_much(*args, **kwargs):
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.\nMore")

    monkeypatch.setattr(trainer.model, "render_stages", too_much)
    with pytest.raises(DeviceMemoryError, match=r"step 1, .* elements: .* ran out \(CUDA out.*whole.*points_count"):
        trainer.train()
