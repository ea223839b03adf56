"""Lead of ColIAGS over Scaffold-GS under a moving lamp, at a size that a CPU trains in minutes."""

from __future__ import annotations

import json

import pytest

from tests.commands import run

STEPS = 1000


def metrics(folder, method, data):
    assert run("train", method, "--data", data, "--output", folder / method, "--steps", STEPS) == 0
    assert run("eval", folder / method) == 0
    return json.loads((folder / method / "eval/paper/metrics.json").read_text())


@pytest.mark.slow
def test_coliags_beats_scaffold_gs_where_the_lamp_moves(tmp_path):
    """Equal steps, seed and data, both with depth loss: measured +7.4 dB, depth / 1.3, inner depth / 1.9, +9.1 dB."""
    assert not run("phantom", "-o", tmp_path / "strong", "--light", "strong", "--seed", 0, "--size", "169x135")
    ours = metrics(tmp_path, "coliags", tmp_path / "strong")
    rival = metrics(tmp_path, "scaffold-gs-depth", tmp_path / "strong")
    assert ours["psnr"] >= rival["psnr"] + 6.0
    assert ours["ssim"] > rival["ssim"]
    assert ours["depth_mse"] <= rival["depth_mse"] / 1.2
    assert ours["depth_mse_inner"] <= rival["depth_mse_inner"] / 1.5
    # Rotated views show whether the light is modelled or each frame's brightness memorised.
    assert ours["sets"]["rotation"]["psnr_seen"] >= rival["sets"]["rotation"]["psnr_seen"] + 6.0
