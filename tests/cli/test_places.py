"""Written files do not say where the data were."""

from __future__ import annotations

import json
import shutil

import pytest

from coliags_plugin import Run, report, train
from coliags_plugin.comparison.scenes import find_scenes
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.text_files import without_places
from coliags_plugin.export.splats.formats import write_splats
from tests.commands import refused, run
from tests.export.splats.clouds import random_cloud
from tests.scenes import SMALL, write_wall


@pytest.fixture
def scene(tmp_path):
    return write_wall(tmp_path / "Jane Doe" / "scene")


def telling(folder, *secrets):
    """Files that hold one of some texts; locks, which name the process, are not passed on."""
    files = [path for path in folder.rglob("*") if path.is_file() and not path.name.startswith(".")]
    assert files
    return [path for path in files for secret in secrets if secret.encode() in path.read_bytes()]


def test_of_a_run_its_evaluation_and_a_report(tmp_path, scene):
    small = [word for override in SMALL for word in ("--set", override)]
    out = tmp_path / "out"
    options = ("--steps", 2, "--renderer", "torch", *small)
    assert run("train", "scaffold-gs", "--data", scene, "--output", out / "run", *options) == 0
    assert json.loads((out / "run/provenance.json").read_text())["scene"]["path"] == "../../Jane Doe/scene"
    (tmp_path / "elsewhere").mkdir()
    for name in ("out", "Jane Doe"):
        (tmp_path / name).rename(tmp_path / "elsewhere" / name)
    out = tmp_path / "elsewhere/out"
    assert run("eval", out / "run") == 0, "run and scene were moved together"
    assert run("report", out / "run", "--output", out / "report", "--format", "all") == 0
    assert not telling(out, str(tmp_path))
    assert telling(out, "Jane Doe") == [out / "run/provenance.json"]


def test_of_an_imported_run(tmp_path, scene):
    write_splats(tmp_path / "Jane Doe/cloud.ply", random_cloud(20, degree=0), "ply")
    out = tmp_path / "out/run"
    assert run("import", tmp_path / "Jane Doe/cloud.ply", "--data", scene, "--output", out) == 0
    assert json.loads((out / "provenance.json").read_text())["imported"]["file"] == "cloud.ply"
    assert not telling(out, str(tmp_path))


def test_home_folder(tmp_path, scene, monkeypatch, capsys):
    """``~`` in words of the command line, the Python API, settings, method configs and benchmark files."""
    monkeypatch.setenv("HOME", str(tmp_path))
    home = "~/Jane Doe"
    shutil.copy(write_wall(tmp_path / "pointed", depth=False) / "points3D.ply", tmp_path / "Jane Doe/points.ply")
    (tmp_path / "base.yaml").write_text("base: scaffold-gs\n")
    (tmp_path / "own.yaml").write_text("base: ~/base.yaml\n")
    points = ("initial_points=file", "points_file=~/Jane Doe/points.ply")
    assert run("data", "check", f"{home}/scene", "--html=~/page.html", "--set", points[0], "--set", points[1]) in (0, 1)
    assert (tmp_path / "page.html").is_file() and "points.ply" in capsys.readouterr().out
    trained = train("~/own.yaml", f"{home}/scene", output="~/run", steps=1, renderer="torch", settings=SMALL)
    assert trained.path == tmp_path / "run" == Run("~/run").path and (tmp_path / "run/config.yaml").is_file()
    with pytest.raises(InputError, match=str(tmp_path / "run")):
        report("~/run")  # was not evaluated
    (tmp_path / "bench.yaml").write_text("description: One scene\nscenes:\n  wall: {folder: ~/Jane Doe/scene}\n")
    assert [str(source.path) for source in find_scenes(["~/bench.yaml"])] == [str(scene)]
    refused(capsys, "data", "check", "~nobody-of-this-name/scene")


def test_of_checks(tmp_path, scene, capsys):
    out = tmp_path / "out"
    assert run("data", "check", scene, "--html", out / "check.html", "--json") in (0, 1)
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
