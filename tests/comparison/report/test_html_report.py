"""The HTML page: self-contained, complete without scripts, and refusing what is damaged."""

from __future__ import annotations

import base64
import csv
import io
import json
import math
import re
import shutil
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest

from coliags_plugin.comparison.report.report import write_report
from coliags_plugin.comparison.report.views import evenly
from coliags_plugin.config.options import ReportOptions
from coliags_plugin.core.errors import InputError
from coliags_plugin.reporting.colormaps import color_table, depth_limits, error_limit, hatch
from coliags_plugin.reporting.image_files import EncodedImage, read_depth_tiff, write_depth_tiff
from tests.commands import refused, run
from tests.comparison.report.made import (
    FRAMES,
    HEIGHT,
    WIDTH,
    made_scenes,
    result_of,
    write_comparison,
    write_run,
)

VOID = {"meta", "img", "br", "link", "input", "hr"}


class Page(HTMLParser):
    """Checks that every element is closed in order, and keeps what the tests ask about."""

    def __init__(self, html):
        super().__init__(convert_charrefs=True)
        self.open, self.tags, self.text = [], [], []
        self.feed(html)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if not {"style", "script"} & set(self.open):
            self.text.append(data)

    @property
    def words(self):
        return " ".join(" ".join(self.text).split())

    def all(self, tag):
        return [attrs for name, attrs in self.tags if name == tag]

    def images(self, alt):
        """Decoded images whose alternative text matches."""
        matches = [attrs["src"] for attrs in self.all("img") if re.search(alt, attrs["alt"])]
        raw = [base64.b64decode(source.split(",", 1)[1], validate=True) for source in matches]
        return [cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[:, :, ::-1] for data in raw]

    def charts(self):
        return [attributes["aria-label"] for attributes in self.all("svg") if attributes["class"] == "chart"]


def report(tmp_path, paths, **options):
    output = tmp_path / "out" / "report.html"
    write_report(paths, ReportOptions(output, overwrite=True, **options))
    return Page(output.read_text(encoding="utf-8"))


@pytest.fixture
def two_runs(tmp_path):
    return [
        write_run(tmp_path / "coliags", result_of("coliags", psnr=32.0, depth=0.5), depth=0.5),
        write_run(tmp_path / "3dgs", result_of("3dgs", psnr=30.0, depth=1.0), depth=1.0),
    ]


# The page


def test_one_file_that_needs_nothing_else(tmp_path, two_runs):
    words = {"title": "My <title>", "note": "A demonstration: 40 steps <only>"}
    write_report(two_runs, ReportOptions(tmp_path / "again.html", **words))
    page = report(tmp_path, two_runs, **words)
    assert [file.name for file in (tmp_path / "out").iterdir()] == ["report.html"]
    assert not {tag for tag, _ in page.tags} & {"link", "iframe", "object"}
    assert page.all("script") == [{}]
    for _, attributes in page.tags:
        for name, value in attributes.items():
            if name in ("src", "href", "srcset", "xlink:href", "data"):
                assert value.startswith(("data:image/", "data:text/csv"))
            assert "://" not in (value or "")
    html = (tmp_path / "out" / "report.html").read_text()
    assert html == (tmp_path / "again.html").read_text(), "the same runs give the same bytes"
    assert "@import" not in html and "import(" not in html and "fetch(" not in html
    scales = [f"#depth-{kind}-{index}" for index in range(len(FRAMES)) for kind in ("error-scale", "scale")]
    assert re.findall(r"url\((.*?)\)", html) == scales
    assert "prefers-color-scheme: dark" in html
    style = html.split("<style>")[1].split("</style>")[0]
    used = {word for _, attributes in page.tags for word in (attributes.get("class") or "").split()}
    defined = set(re.findall(r"\.([a-z][\w-]*)", style))
    assert used - defined <= {"tick", "frame", "right", "side", "views"}  # names for the script, and text of charts
    assert page.words.index("A demonstration: 40 steps <only>") < page.words.index("Held-out views")
    assert "My <title>" in page.words and "legacy-pinhole" in page.words
    (link,) = page.all("a")
    rows = list(csv.DictReader(io.StringIO(base64.b64decode(link["href"].split(",", 1)[1]).decode())))
    assert link["download"] == "per_frame.csv"
    assert len(rows) == 2 * sum(map(len, FRAMES.values()))


# Views


def test_views_are_spread_over_each_set_and_the_worst_are_among_them(tmp_path):
    psnr = (30.0, 29.0, 31.0, 20.0, 30.0)
    depth = (0.1, 0.5, 0.1, 0.1, 0.1)
    result = result_of("coliags", values={"psnr": psnr, "depth_mse": depth})
    page = report(tmp_path, [write_run(tmp_path / "run", result)], frames=2)
    matches = re.findall(r"frame (\d{4}) (\d of \d)(?: · (worst [\w ]+ of coliags))?", page.words)
    assert matches == [
        ("0004", "1 of 5", ""),
        ("0012", "2 of 5", "worst Depth MSE of coliags"),
        ("0028", "4 of 5", "worst PSNR of coliags"),
        ("0036", "5 of 5", ""),
        ("0100", "1 of 2", "worst PSNR and Depth MSE of coliags"),
        ("0110", "2 of 2", ""),
    ]
    # truth, its depth, a rendering and its error; two of the slider; and the sample of the hatch for each set
    assert len(page.all("img")) == 6 * 4 + 2 + len(FRAMES)


@pytest.mark.parametrize(
    ("length", "count", "indices"), [(15, 4, [0, 5, 9, 14]), (3, 10, [0, 1, 2]), (5, 1, [2]), (1, 1, [0])]
)
def test_evenly(length, count, indices):
    assert evenly(length, count) == indices


def test_error_maps_of_a_set_share_one_scale(tmp_path, two_runs):
    """Errors are 0.5 mm in one run and 1 mm in the other, and ten times that off the path: the median is 0.75 mm."""
    for folder in two_runs:
        for file in (folder / "eval/paper/depth/rotation").iterdir():
            true = read_depth_tiff(folder / "eval/paper/true_depth/rotation" / file.name)
            write_depth_tiff(file, true + 10.0 * (read_depth_tiff(file) - true))
    page, table = report(tmp_path, two_runs), color_table("error")
    for name, error in (("coliags", 0.5), ("3dgs", 1.0)):
        color = table[round(math.sqrt(error / 6.0) * 255)]
        images = page.images(f"depth error of {name}")
        assert len(images) == 4 and all(image.shape == (HEIGHT, WIDTH, 3) for image in images)
        assert all(np.abs(image[5].astype(int) - color).max() <= 4 for image in images)
        assert not any((image[0] == image[5]).all() for image in images), "pixels without truth look like known ones"
    assert "|depth error| [mm] 0 0.3 1.2 3 6" in page.words and "|depth error| [mm] 0 3 12 30 60" in page.words


@pytest.mark.parametrize("with_truth", [True, False])
def test_expected_depth_is_shown_and_hatched(tmp_path, with_truth):
    error = 0.5 if with_truth else None
    result = result_of("coliags", depth=error)
    run = write_run(tmp_path / "run", result, depth=error)
    for name, part in result.sets.items():
        for frame in part.frames:
            depth = np.full((HEIGHT, WIDTH), 40.0, np.float32)
            depth[:4] = np.nan
            write_depth_tiff(run / "eval" / "paper" / "expected_depth" / name / f"{frame}.tiff", depth)
    page = report(tmp_path, [run])
    shown = page.images("expected depth of coliags")
    assert len(shown) == 4
    # The scale is that of the true depths, or without any of the expected ones, which are all alike.
    true = np.linspace(20, 60, HEIGHT * WIDTH).reshape(HEIGHT, WIDTH)[1:]
    low, high = depth_limits([true]) if with_truth else (40.0, 41.0)
    color = color_table("depth")[round(math.log(40.0 / low) / math.log(high / low) * 255)]
    assert all(np.abs(image[5].astype(int) - color).max() <= 2 for image in shown)
    assert all((image[0] == hatch(HEIGHT, WIDTH)[0]).all() for image in shown)
    assert "no true depth" not in page.text  # as it is where true depth of other methods is compared
    assert re.search(rf" depth \[mm\] {low:g} [0-9. ]*{high:g} ", page.words)


@pytest.mark.parametrize(
    ("errors", "limit"),
    [
        ([np.array([0.0, 1.3]), np.array([1.3, np.inf])], 11.0),  # 10.4, upwards
        ([np.linspace(0, 1, 101), np.array([np.nan])], 4.1),
        ([np.linspace(0, 1, 1_000_001)], 4.1),  # sampled
        ([], 1.0),
        ([np.zeros(3)], 1.0),
    ],
)
def test_error_limit(errors, limit):
    assert error_limit(errors) == pytest.approx(limit)


def test_without_depth_colors_are_compared_and_large_images_reduced(tmp_path, two_runs):
    result = result_of("coliags", depth=None, size=(1281, 101))
    page = report(tmp_path, [write_run(tmp_path / "run", result, depth=None)])
    assert page.images("true image")[0].shape == (33, 427, 3) and "1/3 of their size" in page.words
    assert "|colour error| [levels of 255]" in page.words
    assert len(page.images("colour error of coliags")) == 4
    assert "depth [mm]" not in page.words
    assert "Error against distance" not in page.words
    (two_runs[1] / "eval" / "paper" / "depth" / "test" / "0004.tiff").unlink()
    assert report(tmp_path, two_runs).words.count("no depth to compare") == 1


# Curves and profiles


def test_curves_against_steps_and_seconds(tmp_path, two_runs):
    page = report(tmp_path, two_runs)
    assert page.charts() == [
        *(f"{y} over {x}" for x in ("distance to the camera [mm]", "angle to the optical axis [degrees]")
          for y in ("PSNR [dB]", "RMS depth error [mm]"))
    ] * 2 + [
        "training PSNR [dB] over step",
        "loss, log scale over step",
        "training PSNR [dB] over training time [s]",
        "loss, log scale over training time [s]",
        "PSNR [dB] over frame",
        "PSNR [dB] over frame",
    ]  # fmt: skip


def test_lengths_of_unknown_unit_are_in_units(tmp_path):
    result = result_of("coliags")
    metrics = {
        name: metric.model_copy(update={"unit": metric.unit.replace("mm", "units")})
        for name, metric in result.metrics.items()
    }
    page = report(tmp_path, [write_run(tmp_path / "run", result.model_copy(update={"metrics": metrics}))])
    assert "PSNR [dB] over distance to the camera [units]" in page.charts()
    assert "RMS depth error [units] over angle to the optical axis [degrees]" in page.charts()
    assert "[mm]" not in page.words


def test_profiles_are_pooled_by_pixels(tmp_path):
    """RGB errors .001 and .004 are 30 and 24 dB; the empty bin is left out, and so is one of few pixels."""
    results = [result_of("coliags"), result_of("coliags", "sigmoid"), result_of("3dgs")]
    folder = write_comparison(tmp_path, results)
    report(tmp_path, [folder])
    html = (tmp_path / "out/report.html").read_text()
    chart = re.search(r'(?s)aria-label="PSNR \[dB\] over distance.*?</svg>', html).group()
    titles = re.findall(r"<title>([\w-]+), ([\d.]+): ([\d.]+)</title>", chart)
    assert titles == [(method, x, y) for method in ("coliags", "3dgs") for x, y in (("5", "30"), ("15", "23.98"))]


def test_long_logs_are_drawn_through_means_one_curve_for_each_seed(tmp_path):
    results = [result_of("coliags", steps=1000, seed=seed) for seed in (0, 1)]
    runs = [write_run(tmp_path / str(result.seed), result) for result in results]
    page = report(tmp_path, runs)
    for text in ("more than 120 logged steps are means", "Of several seeds, the first is shown"):
        assert text in page.words
    drawn = [attributes["d"] for attributes in page.all("path") if attributes["class"] == "line"]
    assert [path.count("L") for path in drawn].count(119) == 8
    for folder in runs:
        (folder / "metrics.jsonl").unlink()
    assert "No training log" in report(tmp_path, runs).words


# Results files alone, and whole comparisons


def test_results_files_alone_give_everything_but_pictures_and_curves(tmp_path):
    results = made_scenes({"coliags": 2.0, "3dgs": 0.0})
    page = report(tmp_path, [write_comparison(tmp_path / "c", results, [("scene-1", "2dgs", 0, "ran out of memory")])])
    for text in ("No images: only results files", "No training log", "ran out of memory", "Smallest p", "Every scene"):
        assert text in page.words
    assert page.all("img") == []
    assert [label for label in page.charts() if "step" in label] == []
    assert sum("over frame" in label for label in page.charts()) == 16


def test_every_scene_of_a_comparison_is_folded(tmp_path):
    results = made_scenes({"coliags": 2.0, "3dgs": 0.0}, scenes=2)
    folder = write_comparison(tmp_path / "c", results)
    for result in results:
        write_run(folder / f"runs/{result.scene.name}/{result.method}/s0-{result.key[:8]}", result)
    page = report(tmp_path, [folder], frames=1)
    assert len(page.images("rendered by")) == 2 * len(page.all("article")) == 16
    summaries = [text for text in page.text if text.startswith("scene-")]
    assert summaries.count("scene-1") >= 3  # views, curves, tables
    shutil.rmtree(folder / f"runs/scene-1/coliags/s0-{results[0].key[:8]}")
    shutil.rmtree(folder / f"runs/scene-2/coliags/s0-{results[1].key[:8]}")
    shown_methods = [
        attributes["data-method"]
        for attributes in report(tmp_path, [folder]).all("figure")
        if "data-method" in attributes
    ]
    assert set(shown_methods) == {"truth", "3dgs"}


# Formats


def test_formats(tmp_path, two_runs):
    written = write_report(two_runs, ReportOptions(tmp_path / "out/tables.html", formats=("all", "text")))
    files = written.files
    assert [file.name for file in files] == [f"tables.{kind}" for kind in ("html", "md", "tex", "csv", "json")]
    _, markdown, latex, table, values = (file.read_text() for file in files)
    assert markdown.startswith("# 2 methods compared on cecum") and r"\toprule" in latex
    assert table.startswith("scene,split,set,frame,method,seed,psnr")
    values = json.loads(values)
    (summary, _) = values["sections"][0]["tables"]
    assert [(row["method"], row["psnr"]) for row in summary["rows"]] == [("coliags", 32.0), ("3dgs", 30.0)]
    assert [result.method for result in written.results] == ["coliags", "3dgs"]
    assert re.search(r"\ncoliags +32.00.*\n3dgs +30.00", str(written))
    one_format = ReportOptions(tmp_path / "table.txt", formats="markdown")
    assert write_report(two_runs, one_format).files == [tmp_path / "table.txt"]


def test_text_is_printed_and_json_has_the_results_whatever_the_format(two_runs, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    assert run("report", *two_runs, "--format", "text", "--columns", "psnr", "ssim") == 0
    printed = capsys.readouterr().out
    assert re.search(r"^coliags +32.00", printed, re.MULTILINE) and "written" not in printed
    assert run("report", *two_runs, "--format", "text", "--json") == 0
    values = json.loads(capsys.readouterr().out)
    assert [(result["method"], result["psnr"]) for result in values["results"]] == [("coliags", 32.0), ("3dgs", 30.0)]
    assert values["written"] == [] and values["results"][0]["facts"]["seed"] == "0"
    for words in (("--format", "text", "-o", "x.txt"), ("--format",)):
        assert "no format of files" in refused(capsys, "report", *two_runs, *words)
    assert sorted(tmp_path.rglob("*")) == before


def test_nothing_is_replaced_unless_asked_for(two_runs, tmp_path, capsys):
    out = tmp_path / "out"
    argv = ("report", two_runs[0], "--output", out / "r.html", "--format", "html", "csv")
    assert run(*argv) == 0
    for name in ("r.csv", "r_files/a.png"):
        for file in out.glob("r.*"):
            file.unlink()
        (out / name).parent.mkdir(exist_ok=True)
        (out / name).write_text("former")
        assert f"{out / name.split('/')[0]} already exists" in refused(capsys, *argv)
        assert [file.name for file in out.glob("r.*")] == [name] * (name == "r.csv")
    assert run(*argv, "--overwrite") == 0 and "cecum" in (out / "r.csv").read_text()


# Refusals


def refuses(tmp_path, runs, match, **options):
    with pytest.raises(InputError, match=match):
        write_report(runs, ReportOptions(tmp_path / "report.html", **options))
    assert not (tmp_path / "report.html").exists()


def test_what_is_missing_is_refused(tmp_path, two_runs):
    refuses(tmp_path, two_runs, "at least one", frames=0)
    refuses(tmp_path, two_runs, r"no metric 'depth_mes'.*Did you mean 'depth_mse'", columns=("depth_mes",))
    (two_runs[0] / "eval/paper/renders/test/0004.png").unlink()
    refuses(tmp_path, two_runs, r"renders/test/0004\.png is missing")
    write_report(two_runs, ReportOptions(tmp_path / "table.txt", formats=("markdown",)))  # which has no images
    with pytest.raises(InputError, match="is a folder"):
        write_report(two_runs, ReportOptions(tmp_path))


@pytest.mark.parametrize(
    ("file", "content", "match"),
    [
        ("result.json", b"{", r"result\.json is not JSON"),
        ("truth/test/0004.png", b"x", r"truth/test/0004\.png .*cannot be decoded"),
        ("depth/test/0004.tiff", b"x", r"depth/test/0004\.tiff .*cannot be decoded"),
        (
            "renders/test/0004.png",
            EncodedImage.png(np.zeros((5, 6, 3), np.uint8)).data,
            r"6 x 5 px\. Expected 16 x 12 px, as the others",
        ),
    ],
)
def test_what_is_damaged_is_refused(tmp_path, file, content, match):
    run = write_run(tmp_path / "run", result_of("coliags"))
    (run / "eval/paper" / file).write_bytes(content)
    refuses(tmp_path, [run], match)
