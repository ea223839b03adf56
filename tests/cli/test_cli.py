"""The command line as a user meets it: small jobs, bad input of every kind, and files that do not tell places."""

from __future__ import annotations

import csv
import json
import math
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from coliags_plugin import Run, load_run, report, train
from coliags_plugin.cli.texts import depth_commands, train_command
from coliags_plugin.comparison.scenes import find_scenes
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import read_rgb
from coliags_plugin.core.scenes import Frame
from coliags_plugin.core.text_files import without_places
from coliags_plugin.export.splats.formats import write_splats
from coliags_plugin.reporting.colormaps import colorize_error, depth_error, error_limit, hatch
from coliags_plugin.reporting.image_files import read_depth_tiff
from tests.commands import refused, run
from tests.export.splats.clouds import random_cloud
from tests.scenes import SETS, SMALL, write_wall


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_wall(tmp_path_factory.mktemp("data") / "wall", frames=17)


@pytest.fixture(scope="module")
def trained(scene, tmp_path_factory):
    """A short run, evaluated under both protocols."""
    path = tmp_path_factory.mktemp("runs") / "coliags"
    assert run("train", "coliags", "--data", scene, "--output", path, "--steps", 60, *SETS) == 0
    assert run("eval", path) == 0
    assert run("eval", path, "--protocol", "authors-code") == 0
    return path


def test_train_leaves_everything_and_eval_numbers_or_null_with_a_reason(trained):
    names = {path.name for path in trained.iterdir()}
    assert names == {"config.yaml", "provenance.json", "metrics.jsonl", "checkpoints", "eval"}
    assert [path.name for path in (trained / "checkpoints").iterdir()] == ["step-000060"]
    summary = json.loads((trained / "eval/paper/metrics.json").read_text())
    assert summary["protocol"] == {**summary["protocol"], "name": "paper", "version": 1}
    assert summary["psnr"] > 15
    assert 0 < summary["ssim"] < 1
    for name in ("psnr", "ssim", "lpips", "depth_mse", "depth_rmse", "depth_mae", "depth_abs_rel"):
        value = summary[name]
        assert (isinstance(value, float) and math.isfinite(value)) or (value is None and summary["reasons"][name])
    assert summary["depth_mae"] <= summary["depth_rmse"] <= math.sqrt(summary["depth_mse"])  # Jensen, over frames
    assert summary["sets"]["test"]["frames"] == 3
    authors = json.loads((trained / "eval/authors-code/metrics.json").read_text())
    assert authors["protocol"]["name"] == "authors-code" and authors["depth_mse"] != summary["depth_mse"]


def test_eval_metrics_agree_with_its_images(trained):
    """PSNR and depth MSE taken again from the files, the former through 8 bits."""
    folder = trained / "eval/paper"
    with (folder / "per_frame.csv").open() as file:
        row = next(csv.DictReader(file))
    names = [folder / kind / "test" / f"{row['frame']}.png" for kind in ("renders", "truth")]
    rendered, truth = (read_rgb(name).astype(float) / 255 for name in names)
    assert -10 * math.log10(((rendered - truth) ** 2).mean()) == pytest.approx(float(row["psnr"]), abs=0.05)
    depths = [read_depth_tiff(folder / kind / "test" / f"{row['frame']}.tiff") for kind in ("depth", "true_depth")]
    is_known = np.isfinite(depths[1])
    assert ((depths[0] - depths[1])[is_known] ** 2).mean() == pytest.approx(float(row["depth_mse"]), rel=1e-4)


def test_render_without_true_depth_has_no_scale_of_its_errors(trained, tmp_path, monkeypatch):
    monkeypatch.setattr(Frame, "true_depth", None)
    assert run("render", trained, "--no-video", "--output", tmp_path / "out") == 0
    written = {path.name for path in (tmp_path / "out").iterdir()}
    assert written == {"rgb", "depth", "rgb_error", "depth_scale.png", "rgb_error_scale.png"}


@pytest.mark.parametrize("kind", ["accumulated", "expected", "median"])
def test_render_writes_images_scales_a_video_and_depth_as_numbers(trained, tmp_path, kind):
    out = tmp_path / "out"
    assert run("render", trained, "--depth-kind", kind, "--depth-tiff", "--output", out) == 0
    handle = load_run(trained, device="cpu")
    assert handle.frame_names() == ["0000_color", "0008_color", "0016_color"]
    for name in handle.frame_names():
        view = handle.render(name, depth=f"depth_{kind}")
        np.testing.assert_array_equal(read_depth_tiff(out / "depth_tiff" / f"{name}.tiff"), view.depth)
        picture = read_rgb(out / "depth" / f"{name}.png")
        low = view.alpha < 0.5
        assert (picture[low] == hatch(*low.shape)[low]).all()
    views = [handle.render(name, depth=f"depth_{kind}") for name in handle.frame_names()]
    errors = [depth_error(view.depth, view.true_depth) for view in views]
    for view, error in zip(views, errors, strict=True):
        drawn = colorize_error(error, error_limit(errors))
        np.testing.assert_array_equal(read_rgb(out / "depth_error" / f"{view.name}.png"), drawn)
        assert np.median(read_rgb(out / "rgb_error" / f"{view.name}.png")) > 20, "most errors are black"
    for folder in ("rgb", "depth", "rgb_error", "depth_error"):
        images = sorted((out / folder).iterdir())
        assert [path.stem for path in images] == [*handle.frame_names()]
        assert read_rgb(images[0]).shape == (24, 32, 3)
    assert (out / "trajectory.mp4").stat().st_size > 0
    for scale in ("depth_scale", "rgb_error_scale", "depth_error_scale"):
        assert (out / f"{scale}.png").is_file()


def test_single_frames_are_rendered_without_a_video(trained, tmp_path):
    assert run("render", trained, "--frames", "0003_color", "test", "0008_color", "--output", tmp_path / "out") == 0
    names = [path.stem for path in sorted((tmp_path / "out/rgb").iterdir())]
    assert names == ["0000_color", "0003_color", "0008_color", "0016_color"]
    assert not (tmp_path / "out/trajectory.mp4").exists()


def test_eval_shows_the_expected_depth(trained):
    folder, handle = trained / "eval" / "paper", load_run(trained, device="cpu")
    assert (folder / "depth_pictures" / "scale.png").is_file() and (folder / "errors" / "test_scale.png").is_file()
    record = handle.results["paper"].sets["test"]
    low = []
    for name in handle.frame_names():
        view = handle.render(name)
        low.append(view.alpha < 0.5)
        stored = read_depth_tiff(folder / "expected_depth" / "test" / f"{name}.tiff")
        np.testing.assert_allclose(stored[~low[-1]], (view.depth / view.alpha)[~low[-1]], rtol=1e-6)
        assert np.isnan(stored[low[-1]]).all()
        picture = read_rgb(folder / "depth_pictures" / "test" / f"{name}.png")
        assert (picture[low[-1]] == hatch(*low[-1].shape)[low[-1]]).all()
    assert record.transparent == np.mean(low)
    assert ("have alpha below 0.5" in str(handle.results["paper"])) == (record.transparent > 0.01)


def test_moved_data_are_found_by_option(trained, scene, tmp_path, capsys):
    moved = tmp_path / "elsewhere"
    shutil.copytree(scene, moved)
    assert run("eval", trained, "--data", moved) == 0
    other = write_wall(tmp_path / "other", frames=18)
    assert "not the data" in refused(capsys, "eval", trained, "--data", other)


def test_eval_against_another_scene(trained, scene, tmp_path, capsys):
    copy = Path(shutil.copytree(scene, tmp_path / "true"))
    assert run("eval", trained, "--truth", copy) == 0
    shown = capsys.readouterr().out.splitlines()
    assert shown[-2] == f"written: {trained / 'eval/paper-truth/metrics.json'}"
    assert shown[-1] == f"next:    coliags report {trained} --protocol paper-truth"
    original, against = (
        json.loads((trained / f"eval/{name}/metrics.json").read_text()) for name in ("paper", "paper-truth")
    )
    assert against["psnr"] == original["psnr"] and against["depth_mse"] == original["depth_mse"]
    assert against["scene"] == "true"
    assert run("report", trained, "--protocol", "paper-truth", "--output", tmp_path / "report.html") == 0
    other = write_wall(tmp_path / "other", frames=5)
    assert "has no frame" in refused(capsys, "eval", trained, "--truth", other)


def test_default_run_folder_and_resume_of_the_newest(scene, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run("train", "ablations/depth", "--data", scene, "--steps", 1, "--json", *SETS) == 0
    summary = json.loads(capsys.readouterr().out)
    printed = Path(summary["written"][0])
    assert summary["step"] == 1 and summary["next"] == [f"coliags eval {printed}"]
    assert printed.parts[:3] == ("runs", "wall", "depth")
    assert run("train", "ablations/depth", "--data", scene, "--steps", 2, "--resume", *SETS) == 0
    assert (printed / "checkpoints" / "step-000002").is_dir()


def test_list_and_config_and_the_installation_and_a_dry_run_of_an_ablation(scene, tmp_path, capsys):
    argv = ("compare", "embedding-sizes", "3dgs", "--scenes", scene, "--output", tmp_path / "new", "--dry-run")
    assert run(*argv) == 0
    planned = capsys.readouterr().out
    assert "wall 5-5 seed 0" in planned and "wall 3dgs seed 0" in planned and not any(tmp_path.iterdir())
    assert run("list", "methods") == 0
    assert "scaffold-gs-depth" in capsys.readouterr().out
    assert run("list") == 0
    assert "renderers:" in capsys.readouterr().out
    assert run("config", "coliags") == 0
    assert re.search(r"frequencies: 10  # coliags.yaml:\d+: Frequencies of gamma", capsys.readouterr().out)
    assert run("check", "installation") == 0
    assert "would use cpu" in capsys.readouterr().out


def test_a_kind_and_a_component_are_described(capsys):
    assert run("list", "losses") == 0
    assert re.search(r"^l1 +Mean absolute difference over valid pixels", capsys.readouterr().out, re.MULTILINE)
    assert run("list", "appearance_heads", "imia") == 0
    printed = capsys.readouterr().out
    assert printed.startswith("imia (built in): Improved Appearance Modeling")
    assert (
        "\nbias_init    one of scene_distances, pytorch  scene_distances  Initial biases of hidden units.\n" in printed
    )
    assert printed.endswith("\ncolor_mlp        {lr: 0.008, final_lr: 5.0e-05}\n")
    assert run("list", "losses", "depth-huber", "--json") == 0
    described = json.loads(capsys.readouterr().out)
    weight, delta = described["options"][0], described["options"][-1]
    assert (weight["name"], weight["type"], "default" in weight) == ("weight", "number", False)
    assert (delta["name"], delta["type"], delta["default"]) == ("delta", "number, > 0", 0.2)
    assert "no loss 'depth-hubr'" in refused(capsys, "list", "losses", "depth-hubr")
    assert "no kind of components 'methods'" in refused(capsys, "list", "methods", "coliags")


# Bad input


@pytest.mark.parametrize(
    ("command", "part"),
    [
        ("train coliags --data GONE --output NEW", "GONE"),
        ("train colliags --data SCENE", "Did you mean 'coliags'"),
        ("train coliags --data SCENE --output NEW --set field.geometry_head.frequences=3", "frequencies"),
        ("train coliags --data SCENE --output NEW --set schedule.steps=many", "'many'"),
        ("train coliags --data SCENE --output NEW --set nonsense", "key.path=value"),
        ("train coliags --data SCENE --output NEW --set renderer.name=cuda-magic", "cuda-magic"),
        ("train coliags --data SCENE --renderer magic", "no renderer 'magic'"),
        ("train coliags --data SCENE --resume", "no run under"),
        ("train coliags --data . --output GONE --resume", "not a run folder"),
        ("train coliags --data SCENE --output RUN", "already exists"),
        ("train scaffold-gs-depth --data SCENE --output RUN --resume", "run of method 'coliags'"),
        ("eval .", "not a run folder"),
        ("eval RUN --protocol papper", "Did you mean 'paper'"),
        ("render .", "not a run folder"),
        ("render RUN --frames rotation", "Expected train, test, all, or the name of a frame such as 0001_color"),
        ("render RUN --frames test 0002_colour", "Did you mean '0002_color'"),
        ("compare paper-row --scenes SCENE", "Did you mean 'paper-rows'"),
        ("list renderer", "Did you mean 'renderers'"),
    ],
)
def test_what_is_refused(capsys, scene, trained, tmp_path, monkeypatch, command, part):
    monkeypatch.chdir(tmp_path)
    words = [{"SCENE": scene, "RUN": trained}.get(word, word) for word in command.split()]
    assert part in refused(capsys, *words)
    assert not any(tmp_path.iterdir())


def test_damaged_provenance_is_named_and_can_be_replaced(capsys, scene, trained, tmp_path):
    copy = shutil.copytree(trained, tmp_path / "copy")
    for content in ("{}", "{"):
        (copy / "provenance.json").write_text(content)
        assert "provenance.json" in refused(capsys, "eval", copy)
    assert run("train", "coliags", "--data", scene, "--output", copy, "--steps", 1, *SETS, "--overwrite") == 0
    assert len((copy / "metrics.jsonl").read_text().splitlines()) == 1 and not (copy / "eval").exists()


def test_what_train_and_phantom_cannot_make(capsys, scene, tmp_path):
    (tmp_path / "file").write_text("x")
    argv = ("train", "coliags", "--data", scene, "--output", tmp_path / "file" / "run", "--steps", 1, *SETS)
    assert "cannot write" in refused(capsys, *argv)
    assert "cannot write" in refused(capsys, "phantom", "-o", tmp_path / "file" / "phantom", "--frames", 9)
    options = ("--size big", "--size 0x0", "--frames 3", "--set light_offset=[1,2]", "--set roughnes=0.3", "--set a")
    for words in options:
        refused(capsys, "phantom", "-o", tmp_path / "p", *words.split())
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize(
    ("layout", "commands"), [("colmap", depth_commands(Path("colon"))), ("c3vd", [train_command(Path("colon"))])]
)
def test_a_phantom_without_depth_leads_to_it(monkeypatch, capsys, layout, commands):
    monkeypatch.setattr("coliags_plugin.api.scenes.make_phantom", lambda output, **options: output)
    assert run("phantom", "-o", "colon", "--layout", layout) == 0
    assert capsys.readouterr().out.splitlines() == ["written: colon", *(f"next:    {each}" for each in commands)]


# Processes


def test_help_and_the_package_import_nothing_heavy():
    code = "import sys, coliags_plugin; sys.argv = ['coliags', '--help']\nfrom coliags_plugin.cli import main\n"
    code += "try: main()\nexcept SystemExit: print('\\n' + ' '.join(sys.modules))"
    command = [sys.executable, "-c", code]
    shown = subprocess.run(command, check=False, capture_output=True, text=True, timeout=120)
    assert "Gaussian splatting for colonoscopy" in shown.stdout
    loaded = {name.partition(".")[0] for name in shown.stdout.splitlines()[-1].split()}
    heavy = {"torch", "numpy", "scipy", "cv2", "open3d", "pycolmap", "kornia", "skimage"}
    assert not loaded & (heavy | {"viser", "nerfstudio"})


@pytest.mark.thorough
def test_ctrl_c_saves_and_exits_cleanly(scene, tmp_path):
    argv = ["train", "coliags", "--data", scene, "--output", tmp_path / "run", "--steps", 100_000, *SETS]
    command = [sys.executable, "-c", "from coliags_plugin.cli import main; main()", *map(str, argv)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    log = tmp_path / "run" / "metrics.jsonl"
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline and not (log.is_file() and log.read_text().count("\n") >= 3):
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, message = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "go on with" in message
    assert "Traceback" not in message
    steps = [path.name for path in (tmp_path / "run" / "checkpoints").iterdir()]
    assert len(steps) == 1
    assert int(steps[0].split("-")[1]) == len(log.read_text().splitlines())


# Written files do not say where the data were


@pytest.fixture
def janes(tmp_path):
    return write_wall(tmp_path / "Jane Doe" / "scene")


def telling(folder, *secrets):
    """Files that hold one of some texts; locks, which name the process, are not passed on."""
    files = [path for path in folder.rglob("*") if path.is_file() and not path.name.startswith(".")]
    assert files
    return [path for path in files for secret in secrets if secret.encode() in path.read_bytes()]


def test_of_a_run_its_evaluation_and_a_report(tmp_path, janes):
    out = tmp_path / "out"
    options = ("--steps", 2, "--renderer", "torch", *SETS)
    assert run("train", "scaffold-gs", "--data", janes, "--output", out / "run", *options) == 0
    assert json.loads((out / "run/provenance.json").read_text())["scene"]["path"] == "../../Jane Doe/scene"
    (tmp_path / "elsewhere").mkdir()
    for name in ("out", "Jane Doe"):
        (tmp_path / name).rename(tmp_path / "elsewhere" / name)
    out = tmp_path / "elsewhere/out"
    assert run("eval", out / "run") == 0, "run and scene were moved together"
    assert run("report", out / "run", "--output", out / "report", "--format", "all") == 0
    assert not telling(out, str(tmp_path))
    assert telling(out, "Jane Doe") == [out / "run/provenance.json"]


def test_of_an_imported_run(tmp_path, janes):
    write_splats(tmp_path / "Jane Doe/cloud.ply", random_cloud(20, degree=0), "ply")
    out = tmp_path / "out/run"
    assert run("import", tmp_path / "Jane Doe/cloud.ply", "--data", janes, "--output", out) == 0
    assert json.loads((out / "provenance.json").read_text())["imported"]["file"] == "cloud.ply"
    assert not telling(out, str(tmp_path))


def test_home_folder(tmp_path, janes, monkeypatch, capsys):
    """``~`` in words of the command line, the Python API, settings, method configs and benchmark files."""
    monkeypatch.setenv("HOME", str(tmp_path))
    home = "~/Jane Doe"
    shutil.copy(write_wall(tmp_path / "pointed", depth=False) / "points3D.ply", tmp_path / "Jane Doe/points.ply")
    (tmp_path / "base.yaml").write_text("base: scaffold-gs\n")
    (tmp_path / "own.yaml").write_text("base: ~/base.yaml\n")
    points = ("initial_points=file", "points_file=~/Jane Doe/points.ply")
    assert run("check", "data", f"{home}/scene", "--html=~/page.html", "--set", points[0], "--set", points[1]) in (0, 1)
    assert (tmp_path / "page.html").is_file() and "points.ply" in capsys.readouterr().out
    trained = train("~/own.yaml", f"{home}/scene", output="~/run", steps=1, renderer="torch", settings=SMALL)
    assert trained.path == tmp_path / "run" == Run("~/run").path and (tmp_path / "run/config.yaml").is_file()
    with pytest.raises(InputError, match=str(tmp_path / "run")):
        report("~/run")  # was not evaluated
    (tmp_path / "bench.yaml").write_text("description: One scene\nscenes:\n  wall: {folder: ~/Jane Doe/scene}\n")
    assert [str(source.path) for source in find_scenes(["~/bench.yaml"], None)] == [str(janes)]
    refused(capsys, "check", "data", "~nobody-of-this-name/scene")


def test_of_checks(tmp_path, janes, capsys):
    out = tmp_path / "out"
    assert run("check", "data", janes, "--html", out / "check.html", "--json") in (0, 1)
    printed = json.loads(capsys.readouterr().out)
    summary = json.dumps({key: value for key, value in printed.items() if key not in ("written", "next")})
    assert "Jane Doe" not in summary and str(tmp_path) not in summary
    assert not telling(out, "Jane Doe", str(tmp_path))


def test_of_messages(tmp_path):
    places = (tmp_path / "out", tmp_path / "Jane Doe/video.mp4")
    text = (
        f"{places[1]}: no frame of mm/s, {places[0]}/depth is empty; {tmp_path / 'Jane Doe'}/video.mp4.xml is not there"
    )
    assert without_places(text, places) == "video.mp4: no frame of mm/s, out/depth is empty; video.mp4.xml is not there"
