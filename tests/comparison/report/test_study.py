"""Reading of runs, results files and comparisons; what is refused, and how methods are told apart."""

from __future__ import annotations

import pytest

from coliags_plugin.comparison.report.metric_tables import compare
from coliags_plugin.comparison.report.report import report_page
from coliags_plugin.comparison.report.study import read_study
from coliags_plugin.config.options import ReportOptions
from coliags_plugin.core.errors import InputError
from coliags_plugin.reporting.model import Column
from coliags_plugin.results.reading import write_result
from tests.comparison.report.made import FRAMES, made_scenes, result_of, write_comparison, write_plan, write_run


def refuses(paths, match, **options):
    with pytest.raises(InputError, match=match):
        read_study(paths, **options)


def test_an_evaluation_against_the_truth_is_asked_for_by_name(tmp_path):
    result = result_of("coliags")
    run = write_run(tmp_path / "run", result)
    with pytest.raises(InputError, match=r"Run `coliags eval \S+ --protocol paper --truth SCENE` first"):
        read_study([run], protocol="paper-truth")
    against = result.model_copy(
        update={"provenance": {**result.provenance, "truth": {"scene": "cecum", "trained_on": {"name": "estimate"}}}}
    )
    (run / "eval" / "paper").rename(run / "eval" / "paper-truth")
    write_result(run / "eval" / "paper-truth" / "result.json", against)
    (cell,) = read_study([run], protocol="paper-truth").runs
    assert cell.evaluation == run / "eval" / "paper-truth" and (cell.evaluation / "renders").is_dir()


def test_a_run_a_file_and_a_comparison_are_read_alike(tmp_path):
    result = result_of("coliags")
    run, file = write_run(tmp_path / "run", result), tmp_path / "result.json"
    write_result(file, result)
    folder = write_comparison(tmp_path / "comparison", [result])
    for path in (run, file, folder):
        study = read_study([path])
        assert [cell.result for cell in study.runs] == [result]
        assert study.missing == ()
    assert read_study([run]).runs[0].run == run
    assert read_study([file]).runs[0].run is None
    assert read_study([run / "eval/paper/result.json"]).runs[0].run == run
    other = write_run(tmp_path / "other", result_of("3dgs"))
    assert read_study([file, other]).methods == ["coliags", "3dgs"]


def test_some_methods_alone_in_the_order_asked_for(tmp_path):
    results = [result_of(name) for name in ("coliags", "2dgs", "3dgs")]
    folder = write_comparison(tmp_path, results, [("cecum", "3dgs", 2, "no memory"), ("cecum", "2dgs", 2, "no memory")])
    study = read_study([folder], methods=["3dgs", "coliags"])
    assert study.methods == ["3dgs", "coliags"]
    assert [failure.method for failure in study.missing] == ["3dgs"]
    refuses([folder], "no method '3dg'.* Did you mean '3dgs'", methods=["3dg"])


def test_the_plan_gives_order_runs_and_what_is_not_finished(tmp_path):
    results = [result_of("scaffold-gs"), result_of("coliags"), result_of("coliags", steps=4000)]
    folder = write_comparison(tmp_path, results, [("cecum", "2dgs", 0, "no memory")])
    write_plan(folder, results[:2], ("cecum", "2dgs", 0), ("cecum", "3dgs", 1))
    write_run(folder / f"runs/cecum/coliags/s0-{results[1].key[:8]}", results[1])
    study = read_study([folder])
    assert study.methods == ["scaffold-gs", "coliags"]  # without the result that the plan no longer has
    assert [cell.run is None for cell in study.runs] == [True, False]
    assert [(f.method, f.seed, f.reason) for f in study.missing] == [("2dgs", 0, "no memory"), ("3dgs", 1, None)]
    refuses([folder], "results of protocol paper only", protocol="authors-code")
    damaged = {"{": "is not JSON", "[]": "valid dictionary", '{"cells": [{}]}': "cells.0.scene: is missing"}
    for content, match in damaged.items():
        (folder / "plan.json").write_text(content)
        refuses([folder], f"plan.json.*{match}")
    write_plan(folder, results)
    text = (folder / "plan.json").read_text()
    (folder / "plan.json").write_text(text.replace('"results/', '"elsewhere/'))
    refuses([folder], "plan.json: cells.0.result: String should match pattern")


@pytest.fixture
def compared(tmp_path):
    """A comparison of four methods on eight scenes, and of one without results."""
    results = made_scenes({"coliags": 1.0, "a": 0.7, "b": 0.6, "c": 0.9})
    folder = write_comparison(tmp_path / "comparison", results)
    write_plan(folder, results, ("scene-1", "later", 0))
    return folder


def test_the_family_is_all_that_was_planned_shown_or_not(compared):
    for shown in ((), ["coliags", "a"], ["b", "coliags"]):
        study = read_study([compared], methods=shown)
        assert study.family == ("coliags", "a", "b", "c", "later")
        rows = compare(study.test_sets[0], Column("psnr", direction="higher"), "coliags")
        others = [row.tests.wilcoxon_holm / row.tests.wilcoxon for row in rows]
        assert max(others) == pytest.approx(4.0)  # as of the smallest p among four
        page = report_page(study, ReportOptions())
        notes = " ".join(page.sections[0].blocks[1].notes)
        assert "after Holm's adjustment for 4 rivals: every method that was planned or given." in notes


def test_a_decision_holds_where_all_plans_have_it(tmp_path):
    decision = {"reference": "coliags", "primary": ["psnr"], "date": "2026-11-01"}
    results = {tmp_path / name: [result_of(name, scene) for scene in "pq"] for name in ("coliags", "3dgs")}
    for folder, each in results.items():
        write_plan(write_comparison(folder, each), each, decided=decision)
    assert read_study([*results]).decided.primary == ("psnr",)
    write_plan(folder, each)
    assert read_study([*results]).decided is None


def test_a_method_under_a_second_name_shows_the_run_of_the_first(tmp_path):
    first, other = result_of("coliags"), result_of("3dgs")
    second = first.model_copy(update={"method": "depth-imve-imia"})
    folder = write_comparison(tmp_path, [second, first, other])
    run = write_run(folder / f"runs/cecum/coliags/s0-{first.key[:8]}", first)
    assert [cell.run for cell in read_study([folder]).runs] == [run, run, None]


def test_nothing_what_was_not_evaluated_and_what_is_there_twice_are_refused(tmp_path):
    refuses([], "no results")
    refuses([tmp_path / "none"], "none.json|none")
    refuses([tmp_path], "holds no results")
    refuses([write_comparison(tmp_path / "new", [])], "holds no results. Expected at least one finished cell")
    failed = write_comparison(tmp_path / "f", [], [("cecum", "3dgs", 0, "no <memory>")])
    refuses([failed], "holds no results of 1 cells; 3dgs on cecum: no <memory>")
    run = write_run(tmp_path / "run", result_of("coliags"))
    refuses([run], f"Run `coliags eval {run} --protocol authors-code` first", protocol="authors-code")
    refuses([run, run / ".." / "run"], "twice")


def test_a_damaged_file_is_refused_by_name(tmp_path):
    folder = write_comparison(tmp_path, [result_of("coliags")], [("cecum", "3dgs", 0, "")])
    for kind, content, match in (("failures", "{", "is not JSON"), ("results", "{}", "not a results file")):
        (file,) = folder.glob(f"{kind}/*/*/*.json")
        whole = file.read_text()
        file.write_text(content)
        refuses([folder], f"{file.name}.*{match}")
        file.write_text(whole)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"version": 2}, "version 1, .*version 2"),
        ({"size": (32, 24)}, "16 x 12 and 32 x 24 px"),
        ({"scene": "sigmoid"}, "coliags has cecum by split 'every-8th', the other methods have sigmoid by"),
        ({"split": "block"}, "coliags has cecum by split 'every-8th', the other methods have cecum by split 'block'"),
        ({"train": ("0001", "0003")}, r"training set has 2 and 2 frames, which differ in 0002, 0003"),
        ({"frames": FRAMES | {"test": (*FRAMES["test"][:-1], "0037")}}, "5 and 5 frames, which differ in 0036, 0037"),
        ({"truth_sha256": "f" * 64}, "true images or depths of set 'test' differ"),
        ({"frames": {"test": FRAMES["test"]}}, "set 'rotation' has 2 and 0 frames"),
    ],
)
def test_what_cannot_be_compared_is_refused(study_of, options, match):
    other = {name: value for name, value in options.items() if name == "truth_sha256"}
    rival = result_of("3dgs", **{name: value for name, value in options.items() if name not in other})
    sets = {name: part.model_copy(update=other) for name, part in rival.sets.items()}
    with pytest.raises(InputError, match=match):
        study_of([result_of("coliags"), rival.model_copy(update={"sets": sets})])


def test_scenes_may_differ_in_size_and_sets_and_splits_are_parts_of_their_own(study_of):
    other_scene = {"scene": "sigmoid", "size": (32, 24), "frames": {"test": ("0",)}}
    options = ({}, other_scene, {"split": "block"})
    study = study_of([result_of(method, **each) for each in options for method in ("a", "b")])
    assert study.scenes == ["cecum", "sigmoid"] and study.methods == ["a", "b"]
    expected = [(split, name) for split in ("every-8th", "block") for name in ("test", "rotation")]
    assert [(each.split, each.set_name) for each in study.test_sets] == expected
    assert study.test_sets[1].scenes == ["cecum"]


@pytest.mark.parametrize(
    ("results", "labels"),
    [
        ([result_of("a"), result_of("a", seed=1)], ["a", "a"]),
        (made_scenes({"a": 0, "b": 0}, scenes=2, seeds=2), ["a"] * 4 + ["b"] * 4),
        (  # what does not change a model: a cell taken from an ablation keeps the description of its row
            [
                result_of("a", seed=seed, config={"x": 1, "description": text, "schedule": {"log_every": seed}})
                for seed, text in enumerate("pq")
            ],
            ["a", "a"],
        ),
        (
            [result_of("a"), result_of("a", seed=1), result_of("a", steps=2000), result_of("b")],
            ["a · 40 steps", "a · 40 steps", "a · 2,000 steps", "b"],
        ),
        (  # seeds of two configs: the stamps would make four methods of them
            [result_of("a", seed=seed, scene=s, config={"x": x}) for x in (1, 2) for seed in (0, 1) for s in "pq"],
            ["a · config "] * 8,
        ),
    ],
)
def test_runs_of_one_method_are_told_apart_where_they_are_not_seeds(study_of, results, labels):
    shown = [run.method for run in study_of(results).runs]
    assert [label[: len(expected)] for label, expected in zip(shown, labels, strict=True)] == labels
    assert len({*shown}) == (2 if "config" in labels[0] else len({*labels})) and shown[0] == shown[1]


def test_runs_are_told_apart_by_their_stamps(tmp_path):
    runs = [write_run(tmp_path / name, result_of("a")) for name in ("one", "two", "sub/one")]
    assert [run.method for run in read_study(runs[:2]).runs] == ["a · one", "a · two"]
    assert [run.method for run in read_study([runs[0], runs[2]]).runs] == ["a · one (1)", "a · one (2)"]


def test_versions_of_one_scene_are_evaluated_against_its_truth(tmp_path):
    """Of estimated depth, whatever its frames are called; and copies that have other depth."""
    truth = write_run(tmp_path / "true", result_of("3dgs", "colon"))
    estimated = result_of("coliags", "colon-estimated", train=("7", "8"), data={"depth_is_estimated": True})
    copy, same_name = result_of("coliags", "copy"), result_of("coliags", "colon")
    sets = {name: part.model_copy(update={"truth_sha256": "f" * 64}) for name, part in same_name.sets.items()}
    versions = {"estimated": estimated, "copy": copy, "other": same_name.model_copy(update={"sets": sets})}
    for name, result in versions.items():
        run = write_run(tmp_path / name, result)
        to_do = (
            rf"run `coliags eval {run} --truth SCENE`, .*, and report {run}/eval/paper-truth/result.json in its place"
        )
        refuses([run, truth], to_do)
        if name == "estimated":
            refuses([truth, run], to_do)
    refuses([truth, write_run(tmp_path / "a", result_of("2dgs", "sigmoid", train=("9",)))], "Write one report for each")
