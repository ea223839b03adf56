"""The loss on gains that do not change steadily."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from coliags_plugin.contracts import Schedule, TrainingStep
from coliags_plugin.core.errors import InputError
from coliags_plugin.losses.regularization import SmoothGainLoss
from coliags_plugin.modules.gain import FrameGain
from tests.scenes import wall_scene


def term(values, frames=9, **options):
    module = FrameGain.from_scene(wall_scene(frames), FrameGain.Settings(**options), torch.Generator())
    with torch.no_grad():
        module.log_gain.copy_(values)
    model = SimpleNamespace(view_modules={"exposure": module}, field=None)
    loss = SmoothGainLoss(SmoothGainLoss.Settings(weight=1.0))
    loss.check(model)
    return loss(TrainingStep(None, None, model, 1, Schedule(1, 1)))


def test_steady_changes_cost_nothing_and_others_their_squared_change_of_slope():
    steady = 0.05 * torch.arange(1.0, 8.0)[:, None]
    assert term(steady).item() == pytest.approx(0.0, abs=1e-12)
    bent = steady + torch.tensor([0, 0, 0, 0.1, 0, 0, 0])[:, None]  # changes of slope .1, -.2, .1 of five
    assert term(bent).item() == pytest.approx((0.01 + 0.04 + 0.01) / 5, rel=1e-5)
    assert term(bent.expand(-1, 3), channels=3).item() == pytest.approx((0.01 + 0.04 + 0.01) / 5, rel=1e-5)


def test_slopes_are_per_frame_of_the_video():
    """Frame 8 of ten is held out: a straight line over the gap costs nothing."""
    times = torch.tensor([float(frame.index) for frame in wall_scene(11).train])
    assert term(0.1 * times[:, None], frames=11).item() == pytest.approx(0.0, abs=1e-10)


def test_few_frames_have_no_slope_to_change():
    value = term(torch.tensor([[0.3]]), frames=2)
    assert value.item() == 0.0 and value.requires_grad


def test_other_methods_are_refused():
    loss = SmoothGainLoss(SmoothGainLoss.Settings(weight=1.0, module="exposur"))
    module = FrameGain.from_scene(wall_scene(), FrameGain.Settings(), torch.Generator())
    with pytest.raises(InputError, match="module 'exposur'"):
        loss.check(SimpleNamespace(view_modules={"exposure": module}, field=None))
    with pytest.raises(InputError, match="a module 'gain'"):
        loss.check(SimpleNamespace(view_modules={}, field=None))
