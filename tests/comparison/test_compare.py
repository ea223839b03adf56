"""Comparisons in this process: plans, what is done and kept, and failures, which nothing else suffers from."""

from __future__ import annotations

import errno
import json
import logging
import re
import shutil
from datetime import datetime, timezone
from pathlib import Path

import pytest

from coliags_plugin.comparison.compare import plan_cells
from coliags_plugin.comparison.folder import ComparisonFolder
from coliags_plugin.comparison.named_files import Variant
from coliags_plugin.comparison.plan import make_cells, read_plan
from coliags_plugin.comparison.scenes import SceneSource
from coliags_plugin.config.options import CompareOptions
from coliags_plugin.core import registry
from coliags_plugin.core.errors import InputError, InterruptedRunError
from coliags_plugin.core.registry import REGISTRIES, Registry, register
from coliags_plugin.datamanagers.c3vd import C3VDDataManager
from coliags_plugin.engine.evaluator import evaluate
from coliags_plugin.engine.tasks import TaskOutcome
from coliags_plugin.engine.trainer import Trainer
from coliags_plugin.losses.target import L1Loss
from coliags_plugin.phantom.settings import PhantomSettings
from coliags_plugin.results.reading import NewerResultError, read_result
from tests.commands import run
from tests.comparison.small import TINY, InlineExecutor, compare_inline, hashes
from tests.scenes import write_wall


@pytest.fixture(scope="module")
def bare(tmp_path_factory):
    """A scene without depth."""
    return write_wall(tmp_path_factory.mktemp("data") / "bare", depth=False)


@pytest.fixture(scope="module")
def compared(wall, tmp_path_factory):
    """A comparison that is done; copied by tests that change it."""
    folder = tmp_path_factory.mktemp("compared") / "comparison"
    comparison = compare_inline(["coliags", "scaffold-gs"], [wall], folder)
    assert not comparison.failures
    return folder


@pytest.fixture
def folder(compared, tmp_path):
    shutil.copytree(compared, tmp_path / "comparison")
    return tmp_path / "comparison"


def again(wall, folder, methods=("coliags", "scaffold-gs"), **options):
    """Compare in the same folder; the comparison, and the titles of what was run."""
    executor = InlineExecutor()
    comparison = compare_inline(list(methods), [wall], folder, executor, **options)
    return comparison, [task.title for task in executor.tasks]


# What is done


def test_a_comparison_leaves_runs_results_and_a_plan(compared):
    plan = json.loads((compared / "plan.json").read_text())
    assert (plan["steps"], plan["overrides"]) == (3, list(TINY))
    assert [(cell["scene"], cell["method"]) for cell in plan["cells"]] == [("wall", "coliags"), ("wall", "scaffold-gs")]
    for cell in plan["cells"]:
        result = read_result(compared / cell["result"])
        assert (result.method, result.key, result.steps) == (cell["method"], cell["key"], 3)
        assert (compared / cell["run"] / "eval" / "paper" / "result.json").is_file()
        assert len(list((compared / cell["run"] / "checkpoints").iterdir())) == 1
    assert not (compared / "failures").exists()
    assert str(compared) not in (compared / "plan.json").read_text()


@pytest.mark.parametrize(("lost", "count"), [(("runs", "plan.json"), 0), (("results",), 2)])
def test_what_is_done_is_not_run_again(wall, folder, monkeypatch, lost, count):
    before = hashes(folder)
    for path in (folder / name for name in lost):
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    monkeypatch.setattr(Trainer, "train", None)
    comparison, ran = again(wall, folder)
    assert not comparison.failures and len(ran) == count and hashes(folder) == before
    assert [result.method for result in comparison.results] == ["coliags", "scaffold-gs"]


def test_components_that_workers_do_not_see_are_refused_before_anything_runs(wall, tmp_path, monkeypatch):
    losses = Registry("losses", registry._BUILT_INS[("losses", "loss")], "loss")
    monkeypatch.setitem(REGISTRIES, "losses", losses)
    register("losses", "ours", L1Loss)
    with pytest.raises(InputError, match=r"method 'ours' uses 'ours' of losses, .* COLIAGS_PLUGIN_PATH"):
        compare_inline([Variant("ours", "coliags", ("losses.l1={name: ours, weight: 1.0}",))], [wall], tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_views_that_show_nothing_are_told(wall, folder, caplog):
    (path,) = (folder / "results" / "wall" / "coliags").iterdir()
    path.write_text(path.read_text().replace('"blank": 0', '"blank": 1'))
    again(wall, folder)
    (warning,) = (record.getMessage() for record in caplog.records if record.levelname == "WARNING")
    assert warning.startswith("wall coliags seed 0, set test: 1 of 2 views show nothing")


def test_a_scene_is_checked_once_before_the_first_run(wall, tmp_path):
    checked = []

    class Watching(InlineExecutor):
        def start(self, task):
            assert [scene.name for scene in checked] == ["wall"]
            super().start(task)

    for _ in range(2):
        methods = ["scaffold-gs", "scaffold-gs-distance"]
        compare_inline(methods, [wall], tmp_path / "new", Watching(), check_data=checked.append)
    assert len(checked) == 1


def test_a_comparison_is_extended(wall, folder):
    _, ran = again(wall, folder, ["scaffold-gs", "coliags"], seeds=2)
    assert ran == ["wall scaffold-gs seed 1", "wall coliags seed 1"]
    _, ran = again(wall, folder, ["scaffold-gs"], splits=["block"])
    assert ran == ["wall-block scaffold-gs seed 0"]
    cells = read_plan(folder).cells
    assert len(cells) == len({cell.key for cell in cells}) == 5
    assert read_result(folder / cells[-1].result).scene.split == "block"


def test_a_method_that_has_changed_is_another_run(wall, folder, tmp_path, caplog):
    mine = tmp_path / "mine.yaml"
    mine.write_text("base: scaffold-gs\n")
    comparison, ran = again(wall, folder, [str(mine)])
    assert ran == [] and comparison.results[0].provenance["same_as"] == "scaffold-gs"
    mine.write_text("base: scaffold-gs\nlosses: {l1: {weight: 0.7}}\n")
    _, ran = again(wall, folder, [str(mine)])
    assert ran == ["wall mine seed 0"] and "not those of the former plan" in caplog.text
    assert len(list((folder / "results" / "wall" / "mine").iterdir())) == 2
    assert sum(cell.method == "mine" for cell in read_plan(folder).cells) == 1


def test_methods_that_are_the_same_are_run_once(wall, tmp_path):
    names = ["coliags", Variant("whole", "ablations/depth-imve-imia"), "ablations/embedding-10-5"]
    comparison, ran = again(wall, tmp_path / "new", names)
    assert ran == ["wall coliags seed 0"]
    assert [result.method for result in comparison.results] == ["coliags", "whole", "ablations/embedding-10-5"]
    assert len({result.metrics_sha256 for result in comparison.results}) == 1
    assert (tmp_path / "new/results/wall/ablations-embedding-10-5").is_dir()


@pytest.mark.parametrize("damaged", [False, True])
def test_a_run_goes_on_from_its_newest_whole_checkpoint(wall, tmp_path, monkeypatch, damaged):
    whole, part = tmp_path / "whole", tmp_path / "part"
    overrides = [*TINY, "schedule.checkpoint_every=2"]
    compare_inline(["coliags"], [wall], whole, steps=6, overrides=overrides)
    steps, lives, executor = Trainer.take_step, [], InlineExecutor()

    def struck(self):
        if self.step == 4 and not lives:
            lives.append(4)
            if damaged:
                (self.run.checkpoints / "step-000004" / "state.safetensors").write_bytes(b"")
            raise KeyboardInterrupt
        return steps(self)

    monkeypatch.setattr(Trainer, "take_step", struck)
    comparison = compare_inline(["coliags"], [wall], part, executor, steps=6, overrides=overrides)
    assert not comparison.failures and len(executor.tasks) == 2 and hashes(part) == hashes(whole)
    assert len(list(part.glob("runs/wall/coliags/s0-*/checkpoints/damaged-step-000004-*"))) == damaged


@pytest.mark.thorough
def test_progress_ends_with_the_last_cell_not_with_its_last_step(wall, tmp_path, capsys):
    compare_inline(["coliags", "scaffold-gs"], [wall], tmp_path / "new")
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("compare 6/6")]
    assert line.startswith("compare 6/6, took") and line.endswith("2 done")


# What fails


WILD = ("optimizers.opacity_mlp.lr=1e39", "optimizers.opacity_mlp.final_lr=1e39")


@pytest.mark.parametrize(
    ("methods", "options", "failed", "reason", "results"),
    [
        (
            ["coliags", "scaffold-gs"],
            {},
            ("bare", "coliags"),
            "depth",
            ["wall coliags", "wall scaffold-gs", "bare scaffold-gs"],
        ),
        ([Variant("wild", "coliags", WILD), "coliags"], {"steps": 6}, ("wall", "wild"), "not finite", ["wall coliags"]),
        (["coliags"], {"splits": ["all-train"]}, ("wall-all-train", "coliags"), "has no test frames", []),
    ],
)
def test_what_cannot_be_done_fails_alone(wall, bare, tmp_path, caplog, methods, options, failed, reason, results):
    caplog.set_level(logging.INFO)
    finished = compare_inline(methods, [wall] if options else [wall, bare], tmp_path / "new", **options)
    (failure,) = finished.failures
    assert (failure.scene, failure.method) == failed and reason in failure.reason
    assert [f"{result.scene.name} {result.method}" for result in finished.results] == results
    (file,) = (tmp_path / "new" / "failures").rglob("*.json")
    assert json.loads(file.read_text())["reason"] == failure.reason
    if "splits" in options:
        assert not [*(tmp_path / "new").rglob("metrics.jsonl")], "it fails before training"
    elif not options:
        assert re.search(r"coliags +1 of 2 .*\nscaffold-gs +2 of 2", str(finished.table()))
        messages = [text for text in caplog.messages if "bare " in text and re.search("seed 0: [^p]", text)]
        starts = ["bare coliags seed 0: started", "bare coliags seed 0: failed: "]
        starts += ["bare scaffold-gs seed 0: started", "bare scaffold-gs seed 0: done"]
        assert len(messages) == 4 and all(map(str.startswith, messages, starts))


@pytest.mark.thorough
def test_a_full_disk_in_the_middle(wall, tmp_path, monkeypatch):
    def full(trained, protocol):
        if trained.method == "coliags":
            raise OSError(errno.ENOSPC, "No space left on device")
        return evaluate(trained, protocol)

    monkeypatch.setattr("coliags_plugin.engine.evaluator.evaluate", full)
    comparison = compare_inline(["coliags", "scaffold-gs"], [wall], tmp_path / "new")
    assert [failure.method for failure in comparison.failures] == ["coliags"]
    assert comparison.failures[0].reason.startswith("no space left for")
    assert [result.method for result in comparison.results] == ["scaffold-gs"]


class Dying(InlineExecutor):
    """Whose workers die so many times."""

    def __init__(self, times):
        super().__init__()
        self.left = times

    def outcome(self, task):
        self.left -= 1
        return TaskOutcome("died", "the process was ended by SIGKILL") if self.left >= 0 else super().outcome(task)


def test_workers_that_die_are_tried_again_so_often_and_what_fails_is_forgotten_when_it_is_done(wall, tmp_path):
    (failure,) = compare_inline(["coliags"], [wall], tmp_path / "new", Dying(3)).failures
    assert (failure.reason, failure.attempts) == ("the process was ended by SIGKILL, 3 times", 3)
    comparison = compare_inline(["coliags"], [wall], tmp_path / "new", Dying(2))
    assert not comparison.failures and not list((tmp_path / "new" / "failures").rglob("*.json"))


@pytest.mark.thorough
def test_a_stop_names_what_is_done(wall, tmp_path):
    class Interrupted(InlineExecutor):
        def outcome(self, task):
            if task.name == "scaffold-gs":
                raise KeyboardInterrupt
            return super().outcome(task)

    with pytest.raises(InterruptedRunError, match="stopped with 1 of 2 cells done; the same command goes on"):
        compare_inline(["coliags", "scaffold-gs"], [wall], tmp_path / "new", Interrupted())
    comparison, ran = again(wall, tmp_path / "new")
    assert ran == ["wall scaffold-gs seed 0"] and not comparison.failures


# Damaged and foreign folders


def test_a_damaged_result_is_written_again_and_a_newer_one_refused(wall, folder, caplog):
    (path,) = (folder / "results" / "wall" / "coliags").iterdir()
    whole = path.read_bytes()
    path.write_bytes(whole[:300])
    _, ran = again(wall, folder)
    assert ran == ["wall coliags seed 0"] and "not counted as done" in caplog.text and path.name in caplog.text
    assert read_result(path).metrics_sha256 == json.loads(whole)["metrics_sha256"]
    path.write_text(path.read_text().replace('"version": 1', '"version": 99', 1))
    with pytest.raises(NewerResultError, match=re.escape(str(path))):
        again(wall, folder)
    assert '"version": 99' in path.read_text()


@pytest.mark.parametrize(
    ("content", "options", "message"),
    [
        ('{"format": "coliags-comparison", "version": 99}', {}, "plan.json is from a newer version"),
        ("{", {}, "plan.json is not JSON"),
        ('{"cells": 3}', {}, "plan.json: cells"),
        (None, {"steps": None}, "compares runs with `steps=3`, .*, not `steps=each method's own`, "),
        (
            None,
            {"overrides": ["field.features=4"]},
            "compares runs with .*`field.features=8`, .*, not .*=4`",
        ),
    ],
)
def test_plans_that_cannot_be_read_and_runs_of_another_kind(wall, folder, content, options, message):
    if content is not None:
        (folder / "plan.json").write_text(content)
    with pytest.raises(InputError, match=message):
        again(wall, folder, **options)


def test_folders_in_use_or_of_something_else_and_methods_that_are_not_there(wall, folder, tmp_path):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.txt").write_text("")
    (tmp_path / "file").write_text("")
    with ComparisonFolder(folder).held(), pytest.raises(InputError, match=r"comparison is in use by process \d+"):
        again(wall, folder)
    with pytest.raises(InputError, match="colias"):
        again(wall, tmp_path / "new", ["colias"])
    assert not (tmp_path / "new").exists()
    for path, message in [
        (tmp_path / "thesis", "not the folder of a comparison: it holds chapter.txt"),
        (tmp_path / "file", "is a file"),
        (tmp_path / "file" / "x", "cannot write to"),
    ]:
        with pytest.raises(InputError, match=message):
            again(wall, path)


# Preview


def test_a_dry_run_tells_states_and_writes_nothing(wall, folder, tmp_path, capsys):
    sets = [word for each in TINY for word in ("--set", each)]
    shutil.rmtree(folder / "results" / "wall" / "scaffold-gs")
    words = ["compare", "coliags", "scaffold-gs", "ablations/depth-imve-imia", "--scenes", wall]
    benchmark = tmp_path / "mine.yaml"
    benchmark.write_text("description: x\nscenes: {made: {phantom: {seed: 1}}}")
    before = sorted(folder.rglob("*"))
    command = [*words, benchmark, "--data", tmp_path / "made", "--output", folder, "--steps", 3, *sets]
    assert run(*command, "--dry-run") == 0
    table = capsys.readouterr().out
    for line in (
        r"wall coliags seed 0 +done +3",
        r"wall scaffold-gs seed 0 +resume +3 of 3",
        r"wall ablations/depth-imve-imia seed 0 +done",
        r"made coliags seed 0 +scene to make +3",
        r"6 cells: 2 done, 1 resume, 3 scene to make",
    ):
        assert re.search(line, table), line
    assert sorted(folder.rglob("*")) == before and not (tmp_path / "made").exists()


# Plans


def chosen(wall, *, steps=5, overrides=(), **options):
    return CompareOptions((wall,), Path("unused"), steps=steps, settings=tuple(overrides), **options)


def cells(wall, methods=("coliags",), **options):
    return plan_cells(methods, chosen(wall, **options))


def planned(wall, **options):
    (cell,) = cells(wall, **options)
    return cell.planned


def test_one_cell_for_each_method_split_and_seed_the_seeds_together(wall):
    every = cells(wall, ["coliags", "3dgs"], seeds=2, splits=["every-8th", "block"])
    assert [(cell.seed, cell.scene_label, cell.variant.name) for cell in every] == [
        (seed, label, method) for seed in (0, 1) for label in ("wall", "wall-block") for method in ("coliags", "3dgs")
    ]
    assert {cell.config.datamanager.settings.split for cell in every if cell.scene_label == "wall"} == {"every-8th"}
    assert len({cell.planned.key for cell in every}) == len(every)
    assert {cell.config.schedule.steps for cell in every} == {5}
    (cell,) = cells(wall, overrides=["datamanager.split=block"])
    assert cell.scene_label == "wall-block"


def test_a_key_depends_on_what_changes_a_result_and_on_nothing_else(wall, tmp_path):
    plain = planned(wall)
    assert planned(wall, overrides=["schedule.log_every=1", "schedule.checkpoint_every=2"]) == plain
    others = [
        planned(wall, steps=6),
        planned(wall, overrides=["field.features=8"]),
        planned(write_wall(tmp_path / "wall", frames=10)),
    ]
    assert len({each.run for each in [plain, *others]}) == len({each.key for each in [plain, *others]}) == 4
    authors = planned(wall, protocol="authors-code")
    assert authors.run == plain.run and authors.key != plain.key


def test_a_method_under_another_name_has_the_same_key(wall):
    ours, same, other = cells(
        wall, ["coliags", Variant("whole", "ablations/depth-imve-imia"), Variant("no-lamp", "ablations/depth-imve")]
    )
    assert ours.planned.key == same.planned.key != other.planned.key and ours.planned.run != same.planned.run
    (cell,) = cells(wall, ["ablations/depth"])
    assert cell.planned.run.startswith("runs/wall/ablations-depth/s0-")
    assert cell.planned.result == f"results/wall/ablations-depth/s0-{cell.planned.key[:8]}.json"


def test_the_fingerprint_is_that_of_the_loaded_scene(wall):
    manager = C3VDDataManager(C3VDDataManager.Settings())
    (cell,) = cells(wall)
    assert cell.fingerprint == manager.fingerprint(wall) == manager.load(wall).provenance.fingerprint


@pytest.mark.parametrize("layout", ["c3vd", "colmap"])
def test_a_phantom_to_be_made_has_a_cell_without_a_key(tmp_path, layout):
    source = SceneSource("planned", tmp_path / "planned", phantom=PhantomSettings(layout=layout, frames=9))
    (cell,) = make_cells([Variant("coliags", "coliags")], [source], chosen(tmp_path))
    assert cell.fingerprint is None and cell.config.schedule.steps == 5
    with pytest.raises(ValueError, match="planned coliags seed 0: the scene is not there"):
        _ = cell.planned


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"methods": []}, "no method"),
        ({"methods": ["colias"]}, "no method or ablation 'colias'.*Did you mean 'coliags'"),
        ({"methods": ["coliags", "coliags"]}, "more than one method is named coliags"),
        ({"seeds": 0}, "`seeds=0`"),
        ({"steps": 0}, "`steps=0`"),
        ({"splits": ["blok"]}, "no split 'blok'.*Did you mean 'block'"),
        ({"reference": "coliags"}, "`reference` without `primary`"),
        ({"primary": ["psnr"]}, "`primary` without `reference`"),
        ({"reference": "3dgs", "primary": ["psnr"]}, "no method '3dgs'"),
        ({"reference": "coliags", "primary": ["psnrs"]}, "no metric 'psnrs'.*Did you mean 'psnr'"),
        ({"protocol": "papre"}, "no protocol 'papre'.*Did you mean 'paper'"),
        ({"overrides": ["field.featurs=8"]}, "`field.featurs=8`.*Did you mean 'features'"),
    ],
)
def test_what_cannot_be_compared_is_refused(wall, options, message):
    with pytest.raises(InputError, match=message):
        cells(wall, **options)


def test_a_decision_is_recorded_when_the_plan_is_first_written(wall, tmp_path):
    folder = ComparisonFolder(tmp_path / "comparison")
    first = chosen(wall, reference="coliags", primary=["psnr", "depth_mse_inner"])
    folder.check_extends(first)
    folder.path.mkdir()
    folder.record(first, cells(wall))
    decided = read_plan(folder.path).decided
    assert (decided.reference, decided.primary) == ("coliags", ("psnr", "depth_mse_inner"))
    assert decided.date == datetime.now(timezone.utc).date().isoformat()
    folder.check_extends(first)
    with pytest.raises(InputError, match="had decided coliags by psnr, depth_mse_inner when it was begun"):
        folder.check_extends(chosen(wall, reference="coliags", primary=["psnr"]))
    more, both = chosen(wall), cells(wall, ["coliags", "3dgs"])
    folder.check_extends(more)
    folder.record(more, both)
    assert read_plan(folder.path).decided is not None
    assert [cell.method for cell in read_plan(folder.path).cells] == ["coliags", "3dgs"]
    changed = cells(wall, [Variant("coliags", "coliags", ("field.features=8",))])
    folder.record(first, changed)
    assert read_plan(folder.path).cells[0].key == changed[0].planned.key
    (tmp_path / "late" / "results").mkdir(parents=True)
    late = ComparisonFolder(tmp_path / "late")
    for _ in range(2):  # results alone, and a plan
        with pytest.raises(InputError, match="had decided nothing when it was begun"):
            late.check_extends(first)
        late.record(more, both)
