"""The claim the package stands on, at the size a CPU trains in minutes."""

from __future__ import annotations

import json

import pytest

from coliags_plugin.cli import main

STEPS = 1000


def run(*argv):
    with pytest.raises(SystemExit) as stopped:
        main([str(arg) for arg in argv])
    assert stopped.value.code == 0


def figures(folder, method, data):
    run("train", method, "--data", data, "--output", folder / method, "--steps", STEPS)
    run("eval", folder / method)
    return json.loads((folder / method / "eval/paper/metrics.json").read_text())


@pytest.mark.slow
def test_coliags_beats_scaffold_gs_where_the_lamp_moves(tmp_path):
    """Equal steps, seed and data, both with depth loss: measured +5.8 dB, depth / 1.4, inner depth / 2.9, +5 dB."""
    run("phantom", tmp_path / "strong", "--light", "strong", "--seed", 0, "--size", "169x135")
    ours = figures(tmp_path, "coliags", tmp_path / "strong")
    rival = figures(tmp_path, "scaffold-gs-depth", tmp_path / "strong")
    assert ours["psnr"] >= rival["psnr"] + 5.0
    assert ours["ssim"] > rival["ssim"]
    assert ours["depth_mse"] <= rival["depth_mse"] / 1.2
    assert ours["depth_mse_inner"] <= rival["depth_mse_inner"] / 2.0
    # Where the camera turns beyond its path the lamp's law has to hold, not a memory of each frame.
    assert ours["sets"]["rotation"]["psnr_seen"] >= rival["sets"]["rotation"]["psnr_seen"] + 3.0
