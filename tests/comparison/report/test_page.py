"""The page of a report: summaries, what is missing, statistics, published numbers, costs."""

from __future__ import annotations

import csv
import io
from dataclasses import replace

import numpy as np
import pytest

from coliags_plugin.comparison.report.published import C3VD_FRAMES
from coliags_plugin.comparison.report.report import per_frame_csv, report_page
from coliags_plugin.comparison.report.study import MissingResult, read_study
from coliags_plugin.config.options import ReportOptions
from coliags_plugin.core.errors import InputError
from coliags_plugin.reporting.model import Fact, Folded, Paragraph, Table, as_cell
from coliags_plugin.results.hashing import metrics_sha256
from coliags_plugin.results.record import MetricRecord
from tests.comparison.report.made import FRAMES, METRICS, NO_LPIPS, decided, made_scenes, result_of, write_comparison
from tests.results.made import made_set


def blocks_of(section):
    for block in section.blocks:
        yield block
        if isinstance(block, Folded):
            yield from blocks_of(block)


def tables(page):
    return {b.name: b for section in page.sections for b in blocks_of(section) if isinstance(b, Table)}


def label(row):
    return as_cell(next(iter(row.values()))).text


def entries(table, key):
    assert key in [column.key for column in table.columns]
    return {label(row): as_cell(row.get(key)) for row in table.rows}


def notes(page):
    """Notes of the tables of means, each of which is there once."""
    texts = [note for block in page.sections[0].blocks if isinstance(block, Table) for note in block.notes]
    assert len(texts) == len({*texts})
    return " ".join(texts)


def of(study_of, results, **choices):
    return report_page(study_of(results), ReportOptions(**choices))


def test_facts_and_title(study_of):
    page = of(study_of, [result_of("coliags"), result_of("3dgs")])
    assert page.title == "2 methods compared on cecum"
    facts = {fact.name: fact.text for fact in page.facts}
    assert facts["Methods"] == "coliags, 3dgs"
    assert facts["Held-out frames"] == "5 test: held out along the path; 2 rotation: beyond the path"
    assert facts["Image size"] == "16 \N{MULTIPLICATION SIGN} 12 px"
    assert facts["Protocol"] == "paper, version 1"
    assert facts["Evaluated with"] == "coliags_plugin 0.1.0"
    (protocol,) = (block for block in blocks_of(page.sections[-1]) if getattr(block, "title", "") == "Protocol")
    assert Fact("description", "as in the <paper>") in protocol.blocks[0].facts
    assert of(study_of, [result_of("coliags")], title="Mine", note="40 steps").title == "Mine"
    assert of(study_of, made_scenes({"coliags": 0}, scenes=14)).facts[0] == Fact("Scenes", "14")


# Summary


def measured(name, unit, value, reasons=None):
    """A result without true depth, with a metric of the test set that others do not have."""
    result = result_of("coliags", depth=None)
    part = result.sets["test"]
    values = {**part.values, name: (value,) * len(part.frames)}
    changed = part.model_copy(update={"values": values, "reasons": {**part.reasons, **(reasons or {})}})
    sets = {**result.sets, "test": changed}
    metrics = {**result.metrics, name: MetricRecord(unit=unit, direction="lower")}
    return result.model_copy(update={"metrics": metrics, "sets": sets, "metrics_sha256": metrics_sha256(sets)})


def shown(table):
    return [column.key for column in table.columns[1:] if column.shown]


NO_TRUTH = {name: "estimated depth is no truth" for name in METRICS if name.startswith("depth")}
TWO = [result_of("coliags", psnr=32.126, depth=0.5), result_of("3dgs", psnr=30.0, depth=1.0)]


@pytest.mark.parametrize(
    ("results", "options", "table", "columns"),
    [
        (TWO, {}, "test", ["psnr", "ssim", "depth_mse", "depth_mse_inner", "depth_median_error"]),
        (TWO, {}, "rotation", ["psnr", "psnr_seen", "ssim", "depth_mse", "depth_mse_inner", "depth_median_error"]),
        (TWO, {"columns": ("depth_abs_rel", "psnr")}, "test", ["depth_abs_rel", "psnr"]),
        (TWO, {"columns": ("all",)}, "test", [name for name in METRICS if name != "psnr_seen"]),
        (TWO, {"columns": ("psnr_seen", "ssim")}, "test", ["ssim"]),  # the first is the rotation set's
        # LPIPS of another net where there is no VGG; metrics at points where there is no true depth.
        ([measured("lpips_squeeze", "", 0.1)], {}, "test", ["psnr", "ssim", "lpips_squeeze"]),
        ([measured("lpips_squeeze", "", 0.1)], {}, "rotation", ["psnr", "psnr_seen", "ssim"]),
        ([measured("lpips_squeeze", "", 0.1)], {"columns": ("lpips",)}, "test", ["lpips"]),
        ([measured("sparse_depth_median", "%", 3.0, NO_TRUTH)], {}, "test", ["psnr", "ssim", "sparse_depth_median"]),
    ],
)
def test_columns(study_of, results, options, table, columns):
    assert shown(tables(of(study_of, results, **options))[f"summary-{table}"]) == columns


def scenes_without(method, scene):
    """Results of three methods, one of which lacks a scene."""
    results = made_scenes({"coliags": 2.0, "3dgs": 0.0, "2dgs": 1.0})
    return [r for r in results if (r.method, r.scene.name) != (method, scene)]


NO_DEPTH = "the frame has no true depth"
FLAT = [result_of(m, s, depth=d) for m in ("coliags", "3dgs") for s, d in (("p", 0.5), ("q", 0.5), ("flat", None))]
SEEDS = [result_of("coliags", seed=seed, psnr=30.0 + seed) for seed in range(3)]
RULED = {"coliags": (0.1, 0.1, 0.1, 2.0), "3dgs": (0.2, 0.2, 0.3, 0.2)}


SOME_FRAMES = [result_of("coliags", values={"ssim": (0.9, None, 0.8, 0.7, 0.6)})]
APART = [result_of("a", "p"), result_of("b", "p"), result_of("b", "q"), result_of("c", "q")]
#: Results, table, metric, and cells as mean, spread, rank and footnote; cells of all methods where only one is given.
MEANS = [
    (TWO, "summary-test", "psnr", ("32.13", "", 1, ""), ("30.00", "", 2, "")),
    (TWO, "summary-test", "ssim", ("0.9000", "", 1, "")),
    (TWO, "summary-test", "depth_mse", ("0.250", "", 1, ""), ("1.000", "", 2, "")),
    (TWO, "summary-test", "lpips", ("", "", None, f"LPIPS: {NO_LPIPS}")),
    (SEEDS, "summary-test", "psnr", ("31.00", "1.00", None, "")),
    ([*SEEDS, result_of("coliags", "q")], "scene-cecum-test", "psnr", ("31.00", "1.00", None, "")),
    (
        SOME_FRAMES,
        "summary-test",
        "ssim",
        ("0.7500", "", None, "SSIM: mean over 4 of 5 frames; no reason was recorded"),
    ),
    (APART, "summary-test", "psnr", ("", "", None, "PSNR: no scene that all methods have")),
    # A scene without depth counts for PSNR, and for no depth metric.
    (FLAT, "summary-test", "depth_mse", ("0.250", "0.000", 1, f"Depth MSE: not available for flat; {NO_DEPTH}")),
    (FLAT, "scene-flat-test", "depth_mse", ("", "", None, "")),
]


@pytest.mark.parametrize(("results", "table", "metric", "cells"), [(*row[:3], row[3:]) for row in MEANS])
def test_means_of_metrics(study_of, results, table, metric, cells):
    shown = [(c.text, c.spread, c.rank, c.note) for c in entries(tables(of(study_of, results))[table], metric).values()]
    assert shown == (list(cells) if len(cells) > 1 else [*cells] * len(shown))


DEPTHS = "Depth MSE; Depth MSE, inner; Depth median error"
NO_WEIGHTS = made_set(("0",), values={"lpips": (None,)}, reasons={"lpips": "no weights. To have some, run `x`"})
REMEDY = result_of("coliags").model_copy(update={"sets": {"test": NO_WEIGHTS}})
REMEDY = REMEDY.model_copy(update={"metrics_sha256": metrics_sha256(REMEDY.sets)})
BY_FEW = [result_of(m, f"s{i}", depth=depth) for m, depths in RULED.items() for i, depth in enumerate(depths)]


@pytest.mark.parametrize(
    ("results", "note"),
    [
        (TWO, f"Not shown, without values: LPIPS ({NO_LPIPS})"),
        (
            [REMEDY],
            f"Not shown, without values: PSNR; PSNR, seen pixels; SSIM; {DEPTHS} (no reason was recorded); "
            "LPIPS (no weights)",
        ),
        (
            [measured("sparse_depth_median", "%", 3.0, NO_TRUTH)],
            f"Not shown, without values: LPIPS ({NO_LPIPS}); {DEPTHS} (estimated depth is no truth)",
        ),
        (SEEDS, "± standard deviation over seeds"),
        (BY_FEW, "± standard deviation over scenes"),
        (scenes_without("3dgs", "scene-5"), "Means over 7 of 8 scenes, without scene-5"),
        (FLAT, f"{DEPTHS}; Depth AbsRel: means over 2 of 3 scenes, without flat"),
        (
            BY_FEW,
            "Depth MSE: few scenes rule the mean, which is more than twice the median over scenes, of coliags (0.01",
        ),
    ],
)
def test_notes_below_the_means(study_of, results, note):
    lines = tables(of(study_of, results))["summary-test"].notes
    assert any(line.startswith(note) for line in lines), lines


def test_the_summary_of_many_scenes_is_the_mean_over_those_that_all_have(study_of):
    results = scenes_without("3dgs", "scene-5")
    page = of(study_of, results)
    table = tables(page)["summary-test"]
    others = [r.sets["test"].mean("psnr") for r in results if r.method == "coliags" and r.scene.name != "scene-5"]
    entry = entries(table, "psnr")["coliags"]
    assert (entry.value, table.count) == (pytest.approx(np.mean(others)), "8 scenes, 40 frames")
    assert float(entry.spread) == pytest.approx(np.std(others, ddof=1), abs=0.005)
    assert any(caution.startswith("3dgs has no result of scene-5") for caution in page.cautions)
    assert [e.text for e in entries(tables(page)["lead-test-psnr"], "scenes").values()] == ["7", "8"]
    assert entries(tables(page)["scene-scene-5-test"], "psnr")["3dgs"].text == ""
    assert [section.title for section in page.text_sections] == ["Metrics", "Details"]
    details = page.text_sections[1].blocks
    assert {type(block) for block in details} == {Folded}
    assert [each.title for each in details] == [
        "Lead of coliags over each method",
        "Costs",
        "Every scene",
        "Provenance",
    ]


# Reference


def test_reference(study_of):
    results = made_scenes({"a": 0.0, "b": 1.0, "c": 0.5})
    assert "lead of b" in tables(of(study_of, results))["lead-test-psnr"].title
    chosen = of(study_of, results, reference="a")
    assert list(entries(tables(chosen)["lead-test-psnr"], "lead")) == ["b", "c"]
    with pytest.raises(InputError, match=r"no method 'd'\. Expected one of a, b, c"):
        of(study_of, results, reference="d")


# Statistics


@pytest.mark.parametrize(
    ("scenes", "rivals", "text"),
    [
        (5, 2, "cannot give less than p = .0625; tests are run from 6 scenes on (p = .0312)."),
        (1, 1, "No test is run: 1 scene cannot tell"),
        (6, 2, "no p below .0312, or .0625 after Holm's adjustment for 2 rivals: every"),
        (8, 6, "no p below .00781, or .0469 after Holm's adjustment for 6 rivals: every"),
    ],
)  # fmt: skip
def test_what_the_statistics_can_say(study_of, scenes, rivals, text):
    methods = {"coliags": 9.0} | {f"rival-{index}": 0.0 for index in range(rivals)}
    page = report_page(decided(study_of(made_scenes(methods, scenes)), "psnr"), ReportOptions())
    assert text in notes(page)
    table = tables(page)["summary-test"]
    stars = {entry.stars for label, entry in entries(table, "psnr").items() if label != "coliags"}
    assert stars == ({"*"} if (scenes, rivals) == (8, 6) else {""})
    lead = tables(page).get("lead-test-psnr")
    assert (lead is None) == (scenes == 1)
    if lead is not None:
        keys = [column.key for column in lead.columns]
        assert ("wilcoxon" in keys) == (scenes >= 6)
        assert entries(lead, "better")["rival-0"].text == f"{scenes} of {scenes}"


def test_a_rival_with_few_scenes_is_not_tested(study_of):
    results = made_scenes({"coliags": 2.0, "3dgs": 0.0, "2dgs": 1.0})
    page = of(study_of, [r for r in results if r.method != "2dgs" or r.scene.name < "scene-4"])
    lead = tables(page)["lead-test-psnr"]
    assert entries(lead, "wilcoxon")["2dgs"].text == ""
    assert entries(lead, "wilcoxon")["3dgs"].text == ".0078"
    assert entries(lead, "smallest")["3dgs"].text == ".00781"
    assert "for 2 rivals" in notes(page)
    assert entries(lead, "wilcoxon_holm")["3dgs"].text == ".016"


def stars(page, metric, name="summary-test"):
    return {method: cell.stars for method, cell in entries(tables(page)[name], metric).items() if cell.stars}


def test_only_what_was_decided_before_the_first_run_has_stars(study_of):
    study = study_of(made_scenes({"coliags": 9.0, "3dgs": 0.0, "2dgs": 4.0}))
    page = report_page(study, ReportOptions())
    assert "before the first run (nothing)." in notes(page)
    assert not stars(page, "psnr") and page.cautions == []
    page = report_page(decided(study, "depth_mse"), ReportOptions())
    assert stars(page, "depth_mse") == {"3dgs": "*", "2dgs": "*"} and not stars(page, "psnr")
    assert "(coliags against the others by Depth MSE, on 2026-11-01)" in notes(page)
    other = report_page(decided(study, "psnr"), ReportOptions(reference="3dgs"))
    assert not stars(other, "psnr")
    best = report_page(decided(study, "psnr", reference="2dgs"), ReportOptions())
    assert stars(best, "psnr") == {"coliags": "*", "3dgs": "*"}


# Cautions


def changed(result, **provenance):
    return result.model_copy(update={"provenance": {**result.provenance, **provenance}})


def coded(scene, code, /, **training):
    return changed(result_of("coliags", scene, software={"code": code, "git": None}), training=training)


def transparent(share):
    result = result_of("coliags")
    sets = {name: part.model_copy(update={"transparent": share}) for name, part in result.sets.items()}
    return result.model_copy(update={"sets": sets})


OURS, THEIRS = (result_of(method, software={"code": "c1"}) for method in ("coliags", "3dgs"))
#: A rival of other code, steps and data; and one scene trained and evaluated by other code, and one resumed with it.
OTHER = result_of("3dgs", steps=80, software={"code": "c2"}, data={"calibration": "x"})
CODES = [
    coded("p", "c1", code="c1"),
    coded("q", "c2", code="c1"),
    coded("r", "c2", code="c1", code_changes=[{"at_step": 3, "code": "c2"}]),
]
HELD_OUT = {"depth": ["0004", "0012"], "points": None}
MOVED = changed(OURS, untrained_views={"poses": "poses are moved"})
#: Results, and a part of each caution on them.
CAUTIONS = {
    "code, steps and data": ([OURS, OTHER], "code: c1: coliags; c2: 3dgs.", "steps of training: 40: coliags; 80: 3dgs.",
                             "different data: calibration."),
    "nothing": ([OURS, THEIRS],),
    "codes of one method": (CODES, "code: c1: coliags (1 of 3); c1, evaluated by c2: coliags (1 of 3); "
                                   "c1, then c2, evaluated by c2: coliags (1 of 3)."),
    "held-out frames used": ([changed(each, held_out_used=HELD_OUT) for each in (OURS, THEIRS)],
                             "cecum, split every-8th: its depth comes from images of 2 held-out frames too",
                             "cecum, split every-8th: its points may come from images of held-out frames"),
    "seeds": ([*(result_of("coliags", seed=seed) for seed in range(2)), result_of("3dgs")],
              "different seeds on cecum (coliags: 0, 1; 3dgs: 0); a mean"),
    "sizes": ([result_of(m, s, size=size) for m in "ab" for s, size in (("p", (16, 12)), ("q", (32, 24)))],
              "image size: 16 x 12 px: a (1 of 2), b (1 of 2); 32 x 24 px: a (1 of 2), b (1 of 2)."),
    "untrained views": ([MOVED, THEIRS], "coliags, poses: poses are moved."),
    "untrained views of all methods": ([MOVED],),
    "transparent pixels": ([transparent(0.1234)], "coliags on cecum, set test: 12.3 % of the pixels have alpha below "
                           "0.5: their depth, hatched, means little. At most as many in 1 more set of views."),
    "few transparent pixels": ([transparent(0.01)],),
}  # fmt: skip


@pytest.mark.parametrize("of_what", CAUTIONS)
def test_cautions(study_of, of_what):
    results, *parts = CAUTIONS[of_what]
    cautions = of(study_of, results).cautions
    assert len(cautions) == len(parts) and all(map(str.__contains__, cautions, parts)), cautions


def test_cells_without_a_result(tmp_path, study_of):
    failed = [("cecum", "3dgs", 0, "ran out of memory"), ("sigmoid", "3dgs", 1, "")]
    page = report_page(read_study([write_comparison(tmp_path, [result_of("coliags")], failed)]), ReportOptions())
    assert [list(row.values()) for row in tables(page)["failed"].rows] == [
        ["3dgs", "cecum", 0, "ran out of memory"],
        ["3dgs", "sigmoid", 1, "no reason was recorded"],
    ]
    missing = tuple(MissingResult(scene, "3dgs", 0, None) for scene in "pq")
    page = report_page(replace(study_of([result_of("coliags")]), missing=missing), ReportOptions())
    assert "failed" not in tables(page)
    assert Paragraph("2 cells not finished: 3dgs (2).") in page.sections[1].blocks


# Published numbers


def c3vd_sequences(**changes):
    """All 22 sequences, under other names."""
    sequences = []
    for index, frames in enumerate(C3VD_FRAMES.values()):
        names = [f"{frame:04d}" for frame in range(frames)]
        facts = {"frames": {"test": tuple(names[::8])}, "train": [name for i, name in enumerate(names) if i % 8]}
        facts |= {"size": (338, 270), "data": {"dataset": "c3vd"}}
        sequences.append(result_of("coliags", f"sequence-{index}", **{**facts, **changes}))
    return sequences


def published(study_of, results):
    table = tables(of(study_of, results))["summary-test"]
    rows = [row for row in table.cells if row[0].published]
    return {row[0].text: row[1:] for row in rows}, table


def test_c3vd_has_the_published_numbers_beside_ours(study_of):
    rows, table = published(study_of, c3vd_sequences())
    assert len(rows) == 7
    assert [entry.text for entry in rows["ColIAGS, published"][:4]] == ["36.30", "0.91", "0.15", "0.042"]
    assert all(entry.rank is None for row in rows.values() for entry in row)
    assert [row[0].published for row in table.cells] == [False] + [True] * 7
    assert any("as printed in the paper of ColIAGS for C3VD, 22 sequences" in note for note in table.notes)


def test_another_benchmark_has_none(study_of):
    for results in (
        c3vd_sequences()[:-1],  # a mean over fewer sequences
        c3vd_sequences(size=(169, 135)),
        c3vd_sequences(split="block"),
        c3vd_sequences(data={"dataset": "colmap"}),
        made_scenes({"coliags": 0.0}, size=(338, 270)),
        [result_of("coliags")],
    ):
        assert published(study_of, results)[0] == {}


def test_endogslam_and_rotatecolon(study_of):
    names = list(C3VD_FRAMES)[:10]
    options = {"split": "endogslam", "frames": {"test": ("7",)}, "data": {"dataset": "c3vd-endogslam"}}
    rows, _ = published(study_of, [result_of("coliags", name, **options) for name in names])
    assert [entry.text for entry in rows["ColIAGS, published"][:4]] == ["35.58", "0.91", "0.23", "0.122"]
    assert published(study_of, [result_of("coliags", f"phantom-{i}", **options) for i in range(10)])[0] == {}
    options = {"split": "all-train", "frames": {"test": tuple(map(str, range(223)))}, "train": [*map(str, range(381))]}
    rows, _ = published(study_of, [result_of("coliags", depth=None, data={"dataset": "rotatecolon"}, **options)])
    assert [entry.text for entry in rows["ColIAGS, published"][:4]] == ["23.29", "0.90", "0.21", ""]


# Costs


def test_costs_are_means_over_scenes(study_of):
    results = [
        result_of(m, s, cost={"train_seconds": t, "seconds_to_psnr": {"25": 5.0, "30": t / 2, "32": mark, "34": None}})
        for m, s, t, mark in (("a", "p", 50.0, 9), ("a", "q", 150.0, 9), ("b", "p", 40.0, None), ("b", "q", 50.0, 8))
    ]
    table = tables(of(study_of, results))["costs"]
    assert [(e.text, e.rank) for e in entries(table, "train_seconds").values()] == [("1 min 40 s", 2), ("45.0 s", 1)]
    assert [e.text for e in entries(table, "seconds_to_30").values()] == ["50.0 s", "22.5 s"]
    assert entries(table, "seconds_to_32")["b"].note == "To 32 dB: not reached; known of 1 of 2 scenes"
    assert entries(table, "gaussians")["a"].rank is None
    assert entries(table, "checkpoint")["a"].text == "3.0"
    assert "All training on a processor, 2 threads" in table.notes
    # Those that all reached, and the next one.
    assert [c.key for c in table.columns if c.shown and "seconds_to" in c.key] == [
        "seconds_to_25", "seconds_to_30", "seconds_to_32",
    ]  # fmt: skip


@pytest.mark.parametrize("change", [{"device": "a GPU"}, {"threads": 1}])
def test_costs_on_different_devices_are_not_ranked(study_of, change):
    table = tables(of(study_of, [result_of("a"), result_of("b", cost={"render_device": "a processor", **change})]))[
        "costs"
    ]
    assert {e.rank for key in ("train_seconds", "memory") for e in entries(table, key).values()} == {None}
    assert all(entry.text for entry in entries(table, "train_seconds").values())
    assert any(note.startswith("Not ranked: training") and "different devices" in note for note in table.notes)


def test_what_was_not_measured_and_what_was_planned(study_of):
    bare = result_of("a", cost={"train_seconds": None, "gaussians": None})
    planned = result_of("b")
    planned = changed(planned, training={**planned.provenance["training"], "plan": "this run densifies 12 times"})
    table = tables(of(study_of, [bare, planned]))["costs"]
    assert entries(table, "train_seconds")["a"].note == "Training: not measured"
    assert "a radiance field" in entries(table, "gaussians")["a"].note
    assert "b: this run densifies 12 times" in table.notes
    assert not any(note.startswith("a:") for note in table.notes)


# Frames


def test_per_frame_csv(study_of):
    results = [result_of(method, seed=seed) for method in ("a", "b") for seed in (0, 1)]
    rows = list(csv.DictReader(io.StringIO(per_frame_csv(study_of(results)))))
    assert len(rows) == 4 * sum(map(len, FRAMES.values()))
    first = rows[0]
    assert [first[key] for key in ("scene", "split", "set", "frame", "method", "seed")] == [
        "cecum", "every-8th", "test", "0004", "a", "0",
    ]  # fmt: skip
    assert (float(first["psnr"]), first["lpips"], first["psnr_seen"]) == (28.0, "", "")
    assert float(rows[-1]["psnr_seen"]) == 32.5
