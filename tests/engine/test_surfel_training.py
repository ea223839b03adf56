"""Short runs of 2dgs: every loss counts, surfels grow and are pruned, and resuming is exact to the bit."""

from __future__ import annotations

import pytest
import torch

from coliags_plugin.config.method_config import load_method
from coliags_plugin.core.errors import InterruptedRunError
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.engine.trainer import Trainer
from tests.engine.test_trainer import _stop_after, assert_same, final_state, log_rows, without_clock
from tests.scenes import wall_scene

STEPS = 14
#: Growth and both regularization losses within so few steps.
EARLY = (
    "renderer=torch",
    "schedule.log_every=1",
    f"schedule.steps={STEPS}",
    f"schedule.written_for={STEPS}",
    "losses.distortion.from_step=3",
    "losses.normals.from_step=5",
    "strategy.densify_from=1",
    "strategy.until=12",
    "strategy.every=4",
    "strategy.reset_every=9",
    "strategy.gradient_threshold=1e-4",
    "strategy.min_opacity=0.09",
)


def make_trainer(path):
    return Trainer(load_method("2dgs", EARLY), wall_scene(), "wall", RunFolder(path), 0, torch.device("cpu"))


@pytest.mark.thorough
def test_a_run_counts_all_losses_changes_rows_and_resumes_to_the_bit(tmp_path):
    whole = make_trainer(tmp_path / "whole")
    whole.start()
    whole.train()
    rows = log_rows(whole)
    assert set(rows[2]["terms"]) == {"l1", "d-ssim"}
    assert set(rows[3]["terms"]) == {"l1", "d-ssim", "distortion"}
    assert set(rows[5]["terms"]) == {"l1", "d-ssim", "distortion", "normals"}
    assert 0 < rows[-1]["terms"]["normals"] < 2 and rows[-1]["terms"]["distortion"] > 0
    assert sum(row.get("grown", 0) for row in rows) > 0 and sum(row.get("pruned", 0) for row in rows) > 0
    assert rows[8]["loss"] < rows[0]["loss"]  # the last before opacities are reset
    state = final_state(whole)
    assert state.tensors["field/scales"].shape[1] == 2

    cut = make_trainer(tmp_path / "cut")
    cut.start()
    _stop_after(cut, 6)
    with pytest.raises(InterruptedRunError):
        cut.train()
    resumed = make_trainer(tmp_path / "cut")
    resumed.resume()
    resumed.train()
    assert_same(state, final_state(resumed))
    assert without_clock(rows) == without_clock(log_rows(resumed))
