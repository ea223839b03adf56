"""The learned light: its curves and numbers beside a phantom's, and views in flattened light."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest
import torch

import coliags_plugin
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scenes import PointCloud
from coliags_plugin.engine.light_map import TrueLight, find_true_light, light_map
from tests.commands import refused, run
from tests.scenes import write_wall

LIGHT = {
    "lamp": {"offset": [0.0, 0.0, -3.0], "axis": [0.0, 0.0, 1.0], "spread_law": "cosine", "spread": 1.5},
    "vignetting": 0.5,
    "gamma": 2.0,
    "shoulder_knee": 0.64,
}


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run of a few steps on the wall with the truth of a phantom beside it."""
    folder = tmp_path_factory.mktemp("light")
    scene = write_wall(folder / "wall", frames=9)
    (scene / "truth").mkdir()
    (scene / "truth" / "light.json").write_text(json.dumps(LIGHT))
    rows = [f"{frame},{math.exp(0.1 * frame)},1.0,1.0" for frame in range(9)]
    (scene / "truth" / "gain.csv").write_text("\n".join(["frame,gain_r,gain_g,gain_b", *rows]) + "\n")
    made = coliags_plugin.train("coliags-plus", scene, folder / "run", steps=4, device="cpu")
    coliags_plugin.train("coliags", scene, folder / "paper", steps=2, device="cpu")
    return made


def test_the_true_law_is_encoded_inverse_square_with_spread_and_vignetting():
    law = TrueLight((0.0, 0.0, -3.0), (0.0, 0.0, 1.0), "cosine", 1.5, 0.5, 2.0, 0.7, {})
    points = torch.tensor([[0.0, 0.0, 7.0], [0.0, 0.0, 17.0], [0.0, 3.0, 6.0]], dtype=torch.float64)
    near, far, aside = law.attenuation(points).tolist()
    assert near / far == pytest.approx(2.0) and law.distance_exponent == -1.0
    psi, theta = 9 / math.sqrt(90), 6 / math.sqrt(45)
    assert aside == pytest.approx(math.sqrt(psi**1.5 * theta**0.5 / 90))
    flat = TrueLight((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), "exponential", 2.0, 0.0, 1.0, 0.7, {})
    one, other = flat.attenuation(torch.tensor([[0.0, 0.0, 5.0], [4.0, 0.0, 3.0]], dtype=torch.float64)).tolist()
    assert other / one == pytest.approx(math.exp(-2.0 * 0.4))


def test_curves_and_numbers_beside_the_truth(trained):
    found = light_map(trained.load())
    curves = {name: torch.tensor(values, dtype=torch.float64) for name, values in found["curves"].items()}
    distances, colors = curves["distances"], curves["colors"]
    assert found["truth"]["lamp_offset"] == [0.0, 0.0, -3.0]
    assert found["truth"]["distance_exponent"] == -1.0
    expected = (distances + 3.0).reciprocal() * (found["reference_distance"] + 3.0)
    torch.testing.assert_close(curves["true_by_distance"], expected, rtol=1e-4, atol=0.0)
    assert curves["by_distance"].shape == curves["by_angle"].shape == (len(distances), 3)
    truth = torch.tensor([0.05 * time for time in found["times"]], dtype=torch.float64)
    torch.testing.assert_close(curves["true_gains"][:, 0].log(), truth - truth.mean())
    errors = (curves["gains"].log() - curves["true_gains"].log()).square().mean(0).sqrt()
    assert found["gain_error_rms"] == pytest.approx(errors.tolist())
    low = colors <= 0.5
    torch.testing.assert_close(curves["response"][low], colors[low])
    assert float((curves["response"] - colors)[~low].abs().max()) > 0
    expected = torch.where(colors < 0.8, colors, (1 - 0.36 * ((0.64 - colors**2) / 0.36).exp()).sqrt())
    torch.testing.assert_close(curves["true_response"], expected)


def test_reports_show_the_light_of_runs_that_learn_it(trained, tmp_path):
    trained.evaluate()
    file = trained.path / "eval" / "paper" / "light.json"
    record = json.loads(file.read_text())
    paper = coliags_plugin.load_run(trained.path.parent / "paper", device="cpu")
    paper.evaluate()
    assert not (paper.path / "eval" / "paper" / "light.json").exists()
    run("report", str(trained.path), str(paper.path), "--output", str(tmp_path / "report.html"))
    text = (tmp_path / "report.html").read_text()
    assert text.count("Camera response") == text.count("Attenuation over distance") == 1 and "Learned light" in text
    rms = ", ".join(f"{value:.1%}" for value in record["gain_error_rms"])
    assert f"<dd>{rms}</dd>" in text and "(true: 0, 0, -3)" in text
    run("report", str(paper.path), "--output", str(tmp_path / "other.html"))
    assert "Learned light" not in (tmp_path / "other.html").read_text()


def test_without_points_in_view_there_is_no_record(trained):
    loaded = trained.load()
    assert light_map(loaded) is not None
    blind = replace(loaded.scene, points=PointCloud(torch.zeros(0, 3, dtype=torch.float64)))
    assert light_map(replace(loaded, scene=blind)) is None


def test_a_damaged_record_of_light_is_named(trained, tmp_path, capsys):
    trained.evaluate()
    file = trained.path / "eval" / "paper" / "light.json"
    whole = file.read_text()
    for damaged in ("{", "{}", json.dumps(json.loads(whole) | {"curves": {"by_distance": 3}})):
        file.write_text(damaged)
        assert "light.json" in refused(capsys, "report", str(trained.path), "--output", str(tmp_path / "report.html"))
    file.write_text(whole)


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
    trained.evaluate()


def test_the_command_writes_the_light_and_flattened_views(trained, capsys):
    run("render", str(trained.path), "--no-video", "--light-map")
    folder = trained.path / "renders"
    assert "true: 0, 0, -3" in (folder / "light.html").read_text()
    assert json.loads((folder / "light.json").read_text())["truth"]["distance_exponent"] == -1.0
    run("render", str(trained.path), "--no-video", "--flatten")
    assert not (trained.path / "relit" / "rgb_error").exists()
    assert "distance" in (trained.path / "relit" / "lamp.yaml").read_text()
    with pytest.raises(InputError, match="relit run"):
        trained.flatten().evaluate()


def test_what_cannot_be_shown_is_refused(trained, capsys, tmp_path):
    paper = trained.path.parent / "paper"
    assert "learned no law" in refused(capsys, "render", str(paper), "--no-video", "--light-map", "--output", "x")
    assert "one of them" in refused(capsys, "render", str(paper), "--flatten", "--light", "power=2")
    (tmp_path / "truth").mkdir()
    assert find_true_light(tmp_path) is None
    (tmp_path / "truth" / "light.json").write_text("{}")
    with pytest.raises(InputError, match=r"light\.json"):
        find_true_light(tmp_path)
    # Several lamps, or a response that is no power law, are not what the page can show.
    (tmp_path / "truth" / "light.json").write_text(json.dumps({**LIGHT, "s_curve": 0.3}))
    assert find_true_light(tmp_path) is None
