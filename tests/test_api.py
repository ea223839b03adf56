"""The Python API: the same results as the command line, light handles, errors as messages, lazy import."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import coliags_plugin as cp
from coliags_plugin.config.yaml_tree import parse_assignments
from coliags_plugin.contracts import Follower, StopTraining
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import read_rgb
from coliags_plugin.core.registry import losses
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.reporting.colormaps import depth_error, depth_limits, depth_scale_text, error_limit
from coliags_plugin.reporting.image_files import read_depth_tiff
from tests.commands import run
from tests.comparison.small import TINY, InlineExecutor
from tests.faults import content
from tests.scenes import SETS, SMALL, wall_scene, write_frames, write_wall

ROOT = Path(__file__).parents[1]
SETTINGS = parse_assignments(SMALL)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_wall(tmp_path_factory.mktemp("data") / "wall", frames=17)


@pytest.fixture(scope="module")
def trained(scene, tmp_path_factory):
    return cp.train("coliags", scene, tmp_path_factory.mktemp("runs") / "run", steps=8, seed=3, settings=SETTINGS)


@pytest.fixture(scope="module")
def result(trained):
    return trained.evaluate()


def test_train_is_the_command(scene, trained, tmp_path):
    assert run("train", "coliags", "--data", scene, "--output", tmp_path / "run", "--steps", 8, "--seed", 3, *SETS) == 0
    states = [handle.load().model.state_dict() for handle in (trained, cp.load_run(tmp_path / "run"))]
    assert states[0].keys() == states[1].keys()
    assert all(torch.equal(states[0][name], states[1][name]) for name in states[0])


def test_training_warns_of_suspect_data(tmp_path, caplog):
    scene = wall_scene()
    ordered = sorted([*scene.train, *scene.test_sets["test"]], key=lambda frame: frame.index)
    for factor, warnings in ((1.0, []), (1 / 3, ["depth and poses are in different units"])):
        frames = [frame.with_maps(depth=factor * frame.depth) for frame in ordered]
        data = write_frames(tmp_path / f"scene-{factor}", frames)
        cp.train("scaffold-gs", data, tmp_path / f"run-{factor}", steps=1, renderer="torch", settings=SETTINGS)
        messages = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
        suspect = [message.removeprefix("suspect: ") for message in messages if message.startswith("suspect: ")]
        assert [message.partition(" (")[0] for message in suspect] == warnings


@pytest.mark.parametrize("how", [{"overwrite": True}, {"resume": True}])
def test_a_run_that_is_being_trained_is_left_alone(scene, trained, tmp_path, how):
    mine = tmp_path / "run"
    shutil.copytree(trained.path, mine)
    with RunFolder(mine).owned():
        before = content(mine)
        with pytest.raises(InputError, match=rf"is in use by process {os.getpid()} on .* since 20\d\d-"):
            cp.train("coliags", scene, mine, steps=8, seed=3, settings=SETTINGS, **how)
        assert content(mine) == before
    assert cp.train("coliags", scene, mine, steps=8, seed=3, settings=SETTINGS, **how).step == 8


def test_a_run_says_what_it_is(trained):
    assert (trained.method, trained.scene_name, trained.seed, trained.step) == ("coliags", "wall", 3, 8)
    assert repr(trained) == f"coliags on wall, seed 3, step 8 of 8: {trained.path}"
    assert trained.config.field.settings.voxel_size == 2.0
    assert repr(trained.load().scene) == "Scene wall: frames 14 train, 3 test; 2000 points"
    assert len(repr(trained.load())) < 500


def test_its_log_is_arrays_with_nan_where_a_row_has_no_number(trained, tmp_path):
    history = trained.history
    np.testing.assert_array_equal(history["step"], np.arange(1, 9))
    assert {"loss", "psnr", "seconds", "terms.l1"} <= history.keys() and np.isfinite(history["psnr"]).all()
    shutil.copytree(trained.path, tmp_path / "run")
    log, run = tmp_path / "run/metrics.jsonl", cp.load_run(tmp_path / "run")
    row = {"step": 1, "psnr": 20.0, "seconds": 0.5}
    rows = [{**row, "terms": {"l1": 0.5}, "ok": True, "name": "x"}, {**row, "terms": {"l1": 0.25}, "grown": 3}]
    log.write_text("".join(json.dumps(each) + "\n" for each in rows))
    assert run.history.keys() == {*row, "terms.l1", "grown"}
    np.testing.assert_array_equal(run.history["terms.l1"], [0.5, 0.25])
    np.testing.assert_array_equal(run.history["grown"], [np.nan, 3.0])
    log.unlink()
    assert run.history == {}


def test_an_evaluation_is_a_result(trained, result):
    summary = json.loads((trained.path / "eval/paper/metrics.json").read_text(encoding="utf-8"))
    assert result.mean("psnr") == summary["psnr"] > 10.0
    assert cp.load_run(trained.path).results == {"paper": result}


def test_a_held_out_frame_is_rendered_as_evaluated(trained, result):
    names = trained.frame_names()
    assert names == list(result.sets["test"].frames)
    view = trained.render(names[1])
    evaluation = trained.path / "eval/paper"
    np.testing.assert_array_equal(view.rgb, read_rgb(evaluation / f"renders/test/{names[1]}.png"))
    np.testing.assert_array_equal(view.true_rgb, read_rgb(evaluation / f"truth/test/{names[1]}.png"))
    np.testing.assert_array_equal(view.depth, read_depth_tiff(evaluation / f"depth/test/{names[1]}.tiff"))
    np.testing.assert_array_equal(view.true_depth, read_depth_tiff(evaluation / f"true_depth/test/{names[1]}.tiff"))
    assert view.rgb.dtype == np.uint8 and view.alpha.shape == view.depth.shape == (24, 32)


def test_a_view_shows_truth_and_rendering(trained):
    view = trained.render("0000_color", depth="depth_expected", outputs=["normals"])
    assert view.outputs["normals"].shape == (24, 32, 3)
    scale = depth_scale_text(depth_limits([view.depth, view.true_depth]), "mm")
    captions = ["truth", "rendered", f"true depth, {scale}", f"depth, {scale}"]
    end = error_limit([depth_error(view.depth, view.true_depth)])
    assert list(view.images()) == [*captions, f"depth error, 0 to {end:g} mm, by square roots"]
    assert view._repr_html_().count("data:image/png;base64,") == 5
    camera = replace(view.camera, width=16)
    free = trained.render(camera)
    assert free.name == "" and free.rgb.shape == (24, 16, 3)
    assert free.true_rgb is None and len(free.images()) == 2


def test_training_resumes(scene, trained, tmp_path):
    before = trained.load().step
    cut = cp.train("coliags", scene, tmp_path / "run", steps=4, settings=SETTINGS)
    assert cut.load().step == 4
    on = cp.train("coliags", scene, tmp_path / "run", steps=6, resume=True)
    assert (before, on.step, cut.load().step) == (8, 6, 6)


class Watch(Follower):
    """Notes what it gets, and ends training at a step."""

    def __init__(self, last):
        self.last, self.rows, self.steps = last, [], []

    def logged(self, row):
        self.rows.append(row)

    def stepped(self, step):
        self.steps.append(step)
        if step == self.last:
            raise StopTraining("as far as wanted")


def test_a_follower_gets_rows_and_steps_and_ends_a_run_that_is_saved(scene, trained, tmp_path):
    watch = Watch(last=4)
    run = cp.train("coliags", scene, tmp_path / "run", steps=8, seed=3, settings=SETTINGS, followers=[watch])
    assert watch.steps == [1, 2, 3, 4] == [row["step"] for row in watch.rows]
    for name in ("loss", "psnr"):
        np.testing.assert_array_equal([row[name] for row in watch.rows], trained.history[name][:4])
        np.testing.assert_array_equal(run.history[name], trained.history[name][:4])
    assert run.step == run.evaluate().steps == 4
    on = cp.train("coliags", scene, run.path, resume=True, followers=[rest := Watch(last=None)])
    assert rest.steps == [5, 6, 7, 8] and on.step == 8


def test_a_method_is_trained_from_a_mapping(scene, trained, tmp_path):
    mapping = {"name": "mine", "base": "coliags", "field": {"voxel_size": 2.0}, "losses": {"depth": None}}
    settings = {key: value for key, value in SETTINGS.items() if key != "field.voxel_size"}
    run = cp.train(mapping, scene, tmp_path / "run", steps=2, settings=settings)
    assert (run.method, repr(run).partition(" on ")[0]) == ("mine", "mine")
    expected = trained.config.model_dump()
    del expected["losses"]["depth"]
    expected["description"] = ""
    assert run.config.model_dump() == {**expected, "schedule": {**expected["schedule"], "steps": 2}}
    assert cp.train(mapping, scene, run.path, steps=3, resume=True).step == 3
    with pytest.raises(InputError, match="mapping: loses: unknown key"):
        cp.train({"base": "coliags", "loses": {}}, scene, tmp_path / "other")


def test_a_scene_is_checked(scene, tmp_path):
    check = cp.check_data(scene, tmp_path / "check.html", settings={"frame_step": 2})
    assert not check.findings and check.facts["depth"]["median"] > 10.0
    assert repr(check) == str(check) and str(check).endswith("nothing suspect")
    assert "nothing suspect" in (tmp_path / "check.html").read_text()


def test_estimates_that_cannot_be_begun_are_refused(scene, tmp_path):
    with pytest.raises(InputError, match="`near` without `far`"):
        cp.estimate_depth(scene, tmp_path / "new", near=12)
    with pytest.raises(InputError, match="`jobs=0`"):
        cp.estimate_depth(scene, tmp_path / "new", jobs=0)
    with pytest.raises(InputError, match="a folder apart from the input"):
        cp.estimate_poses(scene, scene / "poses")
    with pytest.raises(InputError, match=r"-2 mm by `diameter` or `distance`\. Expected one length above 0"):
        cp.estimate_poses(scene / "images", tmp_path / "new", distance=["a", "b", -2])
    assert not (tmp_path / "new").exists()


def test_scenes_are_made_and_read(tmp_path):
    tiny = {"mesh_spacing": 3.0, "texture_spacing": 1.0, "interreflection": 0.0}
    folder = cp.make_phantom(tmp_path / "p", seed=1, frames=9, width=32, height=26, rotation_views=0, **tiny)
    assert folder == tmp_path / "p"
    scene = cp.load_scene(folder, settings={"frame_step": 2})
    assert [frame.index for frame in scene.train] == [2, 4, 6, 8]
    with pytest.raises(InputError, match="unknown key 'frame_stpe'"):
        cp.load_scene(folder, settings={"frame_stpe": 2})
    with pytest.raises(InputError, match=r"unknown key 'sede'.*Did you mean 'seed'"):
        cp.make_phantom(tmp_path / "q", sede=1)


def test_errors_say_what_to_do(scene, trained, tmp_path):
    with pytest.raises(InputError, match="already exists"):
        cp.train("coliags", scene, trained.path)
    with pytest.raises(InputError, match="one of them"):
        cp.train("coliags", scene, trained.path, resume=True, overwrite=True)
    with pytest.raises(InputError, match="values by key path"):
        cp.train("coliags", scene, tmp_path / "r", settings=["schedule.steps=3"])
    with pytest.raises(InputError, match="not a run folder"):
        cp.load_run(tmp_path)
    with pytest.raises(InputError, match="no folder"):
        cp.load_scene(tmp_path / "gone")
    with pytest.raises(InputError, match=r"no frame '0000_colro'.*Did you mean '0000_color'"):
        trained.render("0000_colro")
    with pytest.raises(InputError, match="no kind of depth 'depth'"):
        trained.render("0000_color", depth="depth")
    with pytest.raises(InputError, match="albedo"):
        trained.render("0000_color", outputs=["albedo"])
    with pytest.raises(AttributeError, match="no attribute 'trian'"):
        _ = cp.trian


def test_a_notebook_shows_an_error_as_one_message():
    from IPython.core.interactiveshell import InteractiveShell

    shell = InteractiveShell()
    shown = []
    shell._showtraceback = lambda kind, error, lines: shown.extend(lines)
    shell.run_cell("import coliags_plugin as cp\ncp.load_run('gone')")
    (line,) = shown
    assert line.startswith("InputError: gone is not a run folder. Expected")


@pytest.mark.thorough
def test_examples_of_the_page_run(tmp_path, monkeypatch):
    """Examples in the order of the page, each with a few steps of a small model."""
    write_wall(tmp_path / "SCENE", frames=17)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("coliags_plugin.comparison.compare.make_executor", lambda options: InlineExecutor())

    def quick(function):
        def call(*args, settings=None, **options):
            return function(*args, **{**options, "steps": 2, "settings": {**SETTINGS, **(settings or {})}})

        return call

    for name in ("train", "open_training", "compare"):
        monkeypatch.setattr(cp, name, quick(getattr(cp, name)), raising=False)
    for registered in ("_targets", "_sources"):
        monkeypatch.setattr(losses, registered, dict(vars(losses)[registered]))
    names, text = {}, (ROOT / "docs/api.md").read_text(encoding="utf-8")
    for block in re.findall(r"^```python\n(.*?)^```$", text, re.DOTALL | re.MULTILINE):
        exec(block, names)
    runs = {path.parent.name for path in tmp_path.glob("*/config.yaml")}
    assert runs == {"RUN", "COARSE", "PATIENT", "OWN", "ROBUST"}
    assert (cp.load_run("OWN").step, cp.load_run("ROBUST").method) == (2, "robust")


def test_a_handle_needs_no_torch(trained, result):
    code = (
        "import sys, coliags_plugin as cp\n"
        f"run = cp.load_run({str(trained.path)!r})\n"
        "print(run, run.history['psnr'][-1], run.results['paper'])\n"
        "assert 'torch' not in sys.modules"
    )
    process = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True)
    assert process.returncode == 0, process.stderr
    assert process.stdout.startswith(repr(trained)) and str(result) in process.stdout


# Comparisons: the command's, by settings instead of texts, as tables


TINY_SETTINGS = parse_assignments(TINY)
WITHOUT_DEPTH = ("without depth", "coliags", {"losses.depth": None})


@pytest.fixture
def inline(monkeypatch):
    """Runs in this process; the titles of those that were trained."""
    executor = InlineExecutor()
    monkeypatch.setattr("coliags_plugin.comparison.compare.make_executor", lambda options: executor)
    return executor


@pytest.fixture(scope="module")
def compared(wall, tmp_path_factory):
    folder = tmp_path_factory.mktemp("compared") / "comparison"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("coliags_plugin.comparison.compare.make_executor", lambda options: InlineExecutor())
        return cp.compare(["coliags", cp.variant(*WITHOUT_DEPTH)], wall, folder, steps=3, settings=TINY_SETTINGS)


def test_a_table_of_methods_and_their_runs(compared):
    table = compared.table()
    assert [row["method"] for row in table.rows] == ["coliags", "without depth"]
    means = {result.method: result.mean("psnr") for result in compared.results}
    assert {row["method"]: row["psnr"] for row in table.rows} == means
    assert "psnr (dB)" in str(table) and "1 of 1" in str(table) and not table.notes
    assert repr(compared) == f"2 of 2 cells done: {compared.folder}"
    assert compared._repr_html_() == table._repr_html_()
    assert list(compared.table(["depth_mae"]).rows[0]) == ["method", "done", "depth_mae"]
    with pytest.raises(InputError, match=r"no metric 'psrn'.*Did you mean 'psnr'"):
        compared.table(["psrn"])
    losses = {result.method: set(result.config["losses"]) for result in compared.results}
    assert losses["coliags"] - losses["without depth"] == {"depth"}
    assert list(compared.runs) == [("wall", "coliags", 0), ("wall", "without depth", 0)]
    loaded = cp.load_run(compared.runs["wall", "without depth", 0])
    assert (loaded.method, loaded.step) == ("without depth", 3)
    assert loaded.results["paper"] == compared.results[1]
    assert loaded.render(loaded.frame_names()[0]).rgb.shape == (24, 32, 3)


def test_the_command_goes_on_with_what_a_notebook_began(wall, compared, inline, capsys):
    sets = [part for text in TINY for part in ("--set", text)]
    argv = ("compare", "coliags", "--scenes", wall, "--output", compared.folder, "--steps", 3, *sets)
    assert run(*argv) == 0
    assert inline.tasks == []
    assert "coliags  1 of 1" in capsys.readouterr().out


def test_what_fails_is_in_the_table(wall, tmp_path, inline, monkeypatch):
    monkeypatch.chdir(tmp_path)
    settings = {**TINY_SETTINGS, "datamanager.split": "all-train"}
    comparison = cp.compare("coliags", str(wall), steps=3, settings=settings)
    assert [path.name for path in tmp_path.iterdir()] == ["comparison"]
    assert comparison.table().rows == [
        {"method": "coliags", "done": "0 of 1", "psnr": None, "ssim": None, "depth_mse": None}
    ]
    (note,) = comparison.table().notes
    assert note.startswith("failed: wall-all-train coliags seed 0: ") and "no test frames" in note
    assert "0 of 1 cells done, 1 failed" in repr(comparison)


def test_variants_of_a_file_are_compared_with_methods(wall, tmp_path, inline):
    text = "description: d\nbase: coliags\nvariants: {full: null, plain: [losses.depth=null]}\n"
    (tmp_path / "mine.yaml").write_text(text)
    methods = ["scaffold-gs", str(tmp_path / "mine.yaml")]
    comparison = cp.compare(methods, wall, tmp_path / "new", steps=3, settings=TINY_SETTINGS)
    assert [result.method for result in comparison.results] == ["scaffold-gs", "full", "plain"]


def test_a_report_of_a_comparison_is_the_commands(compared, tmp_path):
    ours, theirs = tmp_path / "ours.html", tmp_path / "theirs.html"
    files = cp.report(compared, ours, formats=["markdown", "csv"], title="Depth").files
    names = ("--format", "markdown", "csv", "--title", "Depth")
    assert run("report", compared.folder, "--output", theirs, *names) == 0
    assert [file.suffix for file in files] == [".md", ".csv"]
    for file in files:
        assert file.read_text() == theirs.with_suffix(file.suffix).read_text()
        assert "without depth" in file.read_text()
    with pytest.raises(InputError, match=r"no format 'latx'.*Did you mean 'latex'"):
        cp.report(compared, formats="latx")
