import base64
import csv
import json
import re
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest

from coliags_plugin.core.errors import InputError
from coliags_plugin.outputs.colormaps import color_table
from coliags_plugin.outputs.image_files import write_depth_tiff, write_png
from coliags_plugin.reporting.comparison_table import Column
from coliags_plugin.reporting.html_report import duration, write_report
from coliags_plugin.reporting.views import error_limit, evenly

HEIGHT, WIDTH = 12, 16
DASH, TIMES = "\N{EN DASH}", "\N{MULTIPLICATION SIGN}"
VOID = {"meta", "img", "br", "link", "input", "hr"}
DIRECTIONS = {"psnr": "higher", "ssim": "higher", "lpips": "lower", "depth_mse": "lower"}
UNITS = {"psnr": "dB", "ssim": "", "lpips": "", "depth_mse": "mm^2"}
FRAMES = {"test": ["0004", "0012", "0020", "0028", "0036"], "rotation": ["0100", "0110"]}


def make_run(
    root,
    method,
    *,
    psnr=30.0,
    depth_offset=0.5,
    stamp="20250101-000000",
    scene="cecum",
    version=1,
    frames=None,
    with_depth=True,
    metrics=None,
    provenance=None,
    steps=40,
):
    """A finished and evaluated run; ``metrics`` overrides metrics of the test set."""
    frames = FRAMES if frames is None else frames
    folder = root / scene / method / stamp
    evaluation = folder / "eval" / "paper"
    evaluation.mkdir(parents=True)
    rng = np.random.default_rng(0)
    sets, rows = {}, []
    for name, names in frames.items():
        sets[name] = {"frames": len(names), "psnr": psnr, "ssim": 0.9, "lpips": None, "depth_mse": depth_offset**2}
        if name == "rotation":
            sets[name]["psnr_seen"] = psnr + 2.0
        for index, frame in enumerate(names):
            truth = rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
            write_png(evaluation / "truth" / name / f"{frame}.png", truth)
            write_png(evaluation / "renders" / name / f"{frame}.png", 255 - truth)
            if with_depth:
                depth = np.linspace(20, 60, HEIGHT * WIDTH, dtype=np.float32).reshape(HEIGHT, WIDTH)
                depth[0] = np.nan
                write_depth_tiff(evaluation / "true_depth" / name / f"{frame}.tiff", depth)
                write_depth_tiff(evaluation / "depth" / name / f"{frame}.tiff", np.nan_to_num(depth) + depth_offset)
            row = {"set": name, "frame": frame, "psnr": psnr + index, "ssim": 0.9, "depth_mse": depth_offset**2}
            rows.append(row | ({"psnr_seen": psnr + index + 2.0} if name == "rotation" else {}))
    sets["test"] |= metrics or {}
    if any(name == "rotation" for name in sets):
        sets["test"].setdefault("psnr_seen", None)
    with (evaluation / "per_frame.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, ["set", "frame", *DIRECTIONS, "psnr_seen"])
        writer.writeheader()
        writer.writerows(rows)
    summary = {
        "protocol": {"name": "paper", "version": version, "description": "as in the <paper>"},
        "method": method,
        "scene": scene,
        "step": steps,
        "psnr": psnr,
        "reasons": {"lpips": "no VGG weights & none to be had"},
        "directions": DIRECTIONS,
        "units": UNITS,
        "sets": sets,
    }
    (evaluation / "metrics.json").write_text(json.dumps(summary))
    record = {
        "method": method,
        "package_version": "0.1.0",
        "git": "abc1234",
        "seed": 7,
        "device": "cpu",
        "renderer": "torch",
        "renderer_reason": "no CUDA device",
        "steps": steps,
        "scene": {"name": scene, "path": "/somewhere/secret", "provenance": {"calibration": "legacy-pinhole"}},
    }
    (folder / "provenance.json").write_text(json.dumps(record | (provenance or {})))
    with (folder / "metrics.jsonl").open("w") as file:
        for step in range(1, steps + 1):
            line = {"step": step, "loss": 1.0 / step, "terms": {"l1": 0.5 / step}, "psnr": 20 + step / 10}
            file.write(json.dumps(line | {"seconds": 2.0 * step, "gaussians": 1000 + step, "anchors": 100}) + "\n")
    return folder


class Page(HTMLParser):
    """Checks that every element is closed in order, and keeps what the tests ask about."""

    def __init__(self, html):
        super().__init__(convert_charrefs=True)
        self.open, self.tags, self.text, self.tables = [], [], [], []
        self._cell = None
        self.feed(html)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self.tables[-1][-1].append([])
        elif tag == "span" and self.open[-2:-1] == ["td"]:
            self.tables[-1][-1][-1].append(dict(attrs).get("class"))

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if "style" in self.open:
            return
        self.text.append(data)
        if "td" in self.open or "th" in self.open:
            self.tables[-1][-1][-1].append(data)

    @property
    def words(self):
        return " ".join(" ".join(self.text).split())

    def all(self, tag):
        return [attrs for name, attrs in self.tags if name == tag]

    def images(self, alt):
        """Decoded images whose alternative text matches."""
        found = [attrs["src"] for attrs in self.all("img") if re.search(alt, attrs["alt"])]
        raw = [base64.b64decode(source.split(",", 1)[1], validate=True) for source in found]
        return [cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[:, :, ::-1] for data in raw]


def report(tmp_path, runs, **options):
    output = tmp_path / "out" / "report.html"
    write_report(runs, output, **options)
    return Page(output.read_text(encoding="utf-8"))


@pytest.fixture
def two_runs(tmp_path):
    return [
        make_run(tmp_path, "coliags", psnr=32.126, depth_offset=0.5),
        make_run(tmp_path, "scaffold-gs", psnr=30.0, depth_offset=1.0),
    ]


def test_one_file_that_needs_nothing_else(tmp_path, two_runs):
    page = report(tmp_path, two_runs)
    assert [file.name for file in (tmp_path / "out").iterdir()] == ["report.html"]
    names = {tag for tag, _ in page.tags}
    assert not names & {"script", "link", "iframe", "object"}
    for _, attributes in page.tags:
        for name, value in attributes.items():
            if name in ("src", "href", "srcset", "xlink:href", "data"):
                assert value.startswith("data:image/")
            assert "://" not in (value or "")
    html = (tmp_path / "out" / "report.html").read_text()
    assert "@import" not in html
    assert re.findall(r"url\((.*?)\)", html) == ["#error-scale", "#depth-scale"]
    assert "prefers-color-scheme: dark" in html


def test_every_style_class_in_use_is_defined(tmp_path, two_runs):
    page = report(tmp_path, two_runs)
    style = (tmp_path / "out" / "report.html").read_text().split("<style>")[1].split("</style>")[0]
    used = {word for _, attributes in page.tags for word in (attributes.get("class") or "").split()}
    defined = set(re.findall(r"\.([a-z][\w-]*)", style))
    assert used - defined == {"tick"}  # as any text of a chart


def test_the_same_runs_give_the_same_bytes(tmp_path, two_runs):
    for name in ("a", "b"):
        write_report(two_runs, tmp_path / name)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_heading(tmp_path, two_runs):
    page = report(tmp_path, two_runs, note="A demonstration: 40 steps <only>")
    for text in ("cecum", f"16 {TIMES} 12 px", "5 test, 2 rotation", "paper, version 1", "as in the <paper>", "0.1.0"):
        assert text in page.words
    assert page.words.index("A demonstration: 40 steps <only>") < page.words.index("Held-out views")
    assert "legacy-pinhole" in page.words
    assert "/somewhere" not in page.words
    assert "2 runs compared on cecum" in page.words
    assert "My <title>" in report(tmp_path, two_runs, title="My <title>").words


def test_table_of_metrics(tmp_path, two_runs):
    table = report(tmp_path, two_runs).tables[0]
    head = [" ".join(cell) for cell in table[0]]
    assert head == ["Method", "PSNR ↑ dB", "SSIM ↑", "LPIPS ↓", "Depth MSE ↓ mm²"]
    assert table[1] == [["coliags"], ["best", "32.13"], ["best", "0.9000"], [DASH, "a"], ["best", "0.250"]]
    assert table[2] == [["scaffold-gs"], ["second", "30.00"], ["best", "0.9000"], [DASH, "a"], ["second", "1.000"]]


def test_rotation_has_its_own_table_with_the_seen_pixels(tmp_path, two_runs):
    page = report(tmp_path, two_runs)
    assert "rotation: beyond the path" in page.words
    table = page.tables[1]
    assert [" ".join(cell) for cell in table[0]][1:3] == ["PSNR ↑ dB", "PSNR, seen pixels ↑ dB"]
    assert [row[2][-1] for row in table[1:]] == ["34.13", "32.00"]
    assert "PSNR, seen pixels 34.13 dB" in page.words


def test_footnotes_give_reasons_once(tmp_path, two_runs):
    page = report(tmp_path, two_runs)
    assert page.words.count("LPIPS: no VGG weights & none to be had") == 2  # once under each table


def test_a_null_without_a_reason_and_a_partial_mean_are_said(tmp_path):
    run = make_run(tmp_path, "coliags", metrics={"ssim": None})
    path = run / "eval" / "paper" / "per_frame.csv"
    text = path.read_text()
    path.write_text(text.replace("30.0,", ",", 1))
    page = report(tmp_path, [run])
    assert "SSIM: no reason was recorded" in page.words
    assert "PSNR: mean over 4 of 5 frames; no reason was recorded" in page.words


@pytest.mark.parametrize(
    ("direction", "values", "ranks"),
    [
        ("higher", [1.0, 3.0, 2.0], [3, 1, 2]),
        ("lower", [1.0, 3.0, 2.0], [1, 3, 2]),
        ("higher", [3.0, 3.0, 2.0], [1, 1, 3]),  # two first places leave no second
        ("higher", [3.0, 2.0, 2.0, 1.0], [1, 2, 2, 4]),
        ("lower", [None, 3.0, 2.0], [None, 2, 1]),
        ("lower", [None, 3.0], [None, None]),  # nothing to be better than
        ("lower", [3.0], [None]),
        (None, [1.0, 2.0], [None, None]),
        ("higher", [30.001, 30.004, 29.0], [1, 1, 3]),  # equal as printed
    ],
)
def test_ranks(direction, values, ranks):
    assert Column("psnr", "dB", direction, values).ranks() == ranks


@pytest.mark.parametrize(
    ("unit", "values", "printed"),
    [
        ("dB", [30.126, 9.0], ["30.13", "9.00"]),
        ("", [0.91234], ["0.9123"]),
        ("mm^2", [0.5, 20.0], ["0.500", "20.000"]),
        ("mm^2", [0.0123, 1.0], ["0.0123", "1.0000"]),
        ("mm", [0.000004], ["0.0000"]),
        ("mm", [1234.5, 200.0], ["1234", "200"]),
        ("mm", [0.0, None], ["0.00"]),
    ],
)
def test_decimals(unit, values, printed):
    column = Column("x", unit, "lower", values)
    assert [column.text(value) for value in values if value is not None] == printed


def test_views_are_spread_over_each_set(tmp_path, two_runs):
    page = report(tmp_path, two_runs, frames=3)
    found = re.findall(r"frame (\d{4}) (\d of \d)", page.words)
    assert found == [
        ("0004", "1 of 5"),
        ("0020", "3 of 5"),
        ("0036", "5 of 5"),
        ("0100", "1 of 2"),
        ("0110", "2 of 2"),
    ]
    # truth, its depth, and for each run a rendering and its error; and the sample of the hatch
    assert len(page.all("img")) == 5 * (2 + 2 * 2) + 1
    assert all(attributes["alt"] for attributes in page.all("img"))


def test_evenly():
    assert evenly(15, 4) == [0, 5, 9, 14]
    assert evenly(3, 10) == [0, 1, 2]
    assert evenly(5, 1) == [2]
    assert evenly(1, 1) == [0]


def test_error_maps_share_one_scale(tmp_path, two_runs):
    # The errors are 0.5 mm in one run and 1 mm in the other, so the scale ends at 1 mm.
    page = report(tmp_path, two_runs)
    table = color_table("error")
    (first, *_), (second, *_) = (page.images(f"depth error of {name}") for name in ("coliags", "scaffold-gs"))
    assert first.shape == (HEIGHT, WIDTH, 3)
    assert np.abs(first[5].astype(int) - table[128]).max() <= 2
    assert (second[5] == table[255]).all()
    assert not (first[0] == first[5]).all(), "pixels without truth look like pixels with one"
    assert "|depth error| [mm] 0 0.2 0.4 0.6 0.8 1" in page.words
    assert "true depth [mm]" in page.words
    assert "95 %" in page.words


def test_error_limit():
    assert error_limit([np.array([0.0, 1.3]), np.array([1.3, np.inf])]) == 2.0
    assert error_limit([np.linspace(0, 1, 101)]) == 1.0
    assert error_limit([]) == 1.0
    assert 0 < error_limit([np.zeros(3)]) <= 1e-6


def test_without_depth_colors_are_compared(tmp_path):
    page = report(tmp_path, [make_run(tmp_path, "coliags", with_depth=False)])
    assert "no true depth" in page.words
    assert "|colour error| [levels of 255]" in page.words
    assert len(page.images("colour error of coliags")) == 6
    assert "true depth [mm]" not in page.words


def test_one_run_lacking_depth_says_so(tmp_path, two_runs):
    (two_runs[1] / "eval" / "paper" / "depth" / "test" / "0004.tiff").unlink()
    page = report(tmp_path, two_runs)
    assert page.words.count("no depth to compare") == 1


def test_large_images_are_reduced(tmp_path):
    run = make_run(tmp_path, "coliags", frames={"test": ["0001"]}, with_depth=False)
    for kind in ("truth", "renders"):
        write_png(run / "eval" / "paper" / kind / "test" / "0001.png", np.zeros((101, 1281, 3), np.uint8))
    page = report(tmp_path, [run])
    assert page.images("true image")[0].shape == (33, 427, 3)
    assert f"1281 {TIMES} 101 px" in page.words
    assert "1/3 of their size" in page.words


def test_training_costs_and_curves(tmp_path, two_runs):
    page = report(tmp_path, two_runs)
    row = next(row for table in page.tables for row in table if "Per step" in row[3:4] or row[0] == ["Run"])
    assert [" ".join(cell) for cell in row] == [
        "Run", "Steps", "Time", "Per step", "Gaussians", "Anchors", "Device", "Renderer", "Seed",
    ]  # fmt: skip
    costs = page.tables[2][1]
    assert [cell[-1] for cell in costs] == [
        "coliags",
        "40",
        "1 min 20 s",
        "2.00 s",
        "1,040",
        "100",
        "cpu",
        "torch",
        "7",
    ]
    labels = [attributes["aria-label"] for attributes in page.all("svg") if attributes["class"] == "chart"]
    assert labels == [
        "training PSNR [dB] over step",
        "loss, log scale over step",
        "PSNR [dB] over frame",
        "PSNR [dB] over frame",
    ]
    for label in ("training PSNR [dB]", "loss, log scale", "step", "frame"):
        assert label in page.text


def test_long_logs_are_drawn_through_means(tmp_path):
    page = report(tmp_path, [make_run(tmp_path, "coliags", steps=1000)])
    assert "mean of up to 9 logged steps; the band spans their extremes" in page.words
    line = next(attributes["d"] for attributes in page.all("path") if attributes["class"] == "line")
    assert line.count("L") == 119


def test_no_log_is_no_fault(tmp_path):
    run = make_run(tmp_path, "coliags")
    (run / "metrics.jsonl").unlink()
    (run / "provenance.json").unlink()
    assert "No training log" in report(tmp_path, [run]).words


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.26, "0.3 s"), (59.0, "59.0 s"), (61.0, "1 min 01 s"), (7322.0, "2 h 02 min")]
)
def test_duration(seconds, text):
    assert duration(seconds) == text


def test_runs_of_one_method_are_told_apart(tmp_path):
    runs = [make_run(tmp_path, "coliags", stamp=stamp) for stamp in ("20250101-000000", "20250102-000000")]
    assert [row[0] for row in report(tmp_path, runs).tables[0][1:]] == [
        ["coliags · 20250101-000000"],
        ["coliags · 20250102-000000"],
    ]
    other = make_run(tmp_path / "elsewhere", "coliags", stamp="20250101-000000")
    rows = report(tmp_path, [runs[0], other]).tables[0][1:]
    assert [row[0] for row in rows] == [["coliags · 20250101-000000 (1)"], ["coliags · 20250101-000000 (2)"]]


def test_cautions(tmp_path):
    first = make_run(tmp_path, "coliags")
    data = {"name": "cecum", "path": "/another", "provenance": {"calibration": "fisheye"}}
    second = make_run(tmp_path, "3dgs", steps=80, provenance={"git": "def5678", "scene": data})
    words = report(tmp_path, [first, second]).words
    assert "different numbers of steps: coliags 40, 3dgs 80" in words
    assert "different states of the source" in words
    assert "different data, see Provenance: provenance.calibration" in words
    assert "versions of the package" not in words


def test_names_are_escaped(tmp_path):
    run = make_run(tmp_path, "coliags", provenance={"renderer": "<script>alert(1)</script>"})
    page = report(tmp_path, [run])
    assert "<script>alert(1)</script>" in page.words
    assert not page.all("script")


def refuses(tmp_path, runs, match, **options):
    with pytest.raises(InputError, match=match):
        write_report(runs, tmp_path / "report.html", **options)
    assert not (tmp_path / "report.html").exists()


def test_what_cannot_be_compared_is_refused(tmp_path):
    run = make_run(tmp_path, "coliags")
    refuses(tmp_path, [run, make_run(tmp_path, "a", version=2)], "version 1, .*version 2")
    refuses(tmp_path, [run, make_run(tmp_path, "b", scene="sigmoid")], "scene 'cecum'.*scene 'sigmoid'")
    other = {"test": [*FRAMES["test"][:-1], "0037"], "rotation": FRAMES["rotation"]}
    refuses(tmp_path, [run, make_run(tmp_path, "c", frames=other)], "'0036' in one where the other has '0037'")
    refuses(tmp_path, [run, make_run(tmp_path, "d", frames={"test": ["0004"]})], "5 and 1 frames")
    refuses(tmp_path, [run, make_run(tmp_path, "e", frames={"test": FRAMES["test"]})], "'rotation' is in one of them")
    refuses(tmp_path, [run, run / ".." / run.name], "twice")


def test_what_is_missing_is_refused(tmp_path):
    run = make_run(tmp_path, "coliags")
    refuses(tmp_path, [], "no run folders")
    refuses(tmp_path, [tmp_path / "none"], "is not a folder")
    refuses(tmp_path, [run], "at least one", frames=0)
    refuses(tmp_path, [run], f"Run `coliags eval {run} --protocol authors-code` first", protocol="authors-code")
    (run / "eval" / "paper" / "renders" / "test" / "0004.png").unlink()
    refuses(tmp_path, [run], r"renders/test/0004\.png is missing")
    with pytest.raises(InputError, match="is a folder"):
        write_report([run], tmp_path)


@pytest.mark.parametrize(
    ("file", "content", "match"),
    [
        ("eval/paper/metrics.json", "{", r"metrics\.json is not JSON"),
        ("eval/paper/metrics.json", "[]", r"metrics\.json"),
        ("eval/paper/metrics.json", '{"protocol": {"name": "paper"}}', r"protocol\.version"),
        ("provenance.json", "nope", r"provenance\.json is not JSON"),
        ("provenance.json", "[1]", "JSON object"),
        ("metrics.jsonl", '{"step": 1}\n{"step": ', r"metrics\.jsonl, line 2 is not JSON"),
        ("metrics.jsonl", "3\n", "line 1 holds a int"),
        ("eval/paper/per_frame.csv", "set,frame,psnr\n", "lists no frames"),
        ("eval/paper/per_frame.csv", "set,frame,psnr\ntest,0001,many\n", "cannot be read"),
        ("eval/paper/per_frame.csv", "frame,psnr\n0001,3\n", "line 2 has no set"),
        ("eval/paper/truth/test/0004.png", "x", r"truth/test/0004\.png cannot be decoded"),
        ("eval/paper/depth/test/0004.tiff", "x", r"depth/test/0004\.tiff cannot be decoded"),
    ],
)
def test_what_is_damaged_is_refused(tmp_path, file, content, match):
    run = make_run(tmp_path, "coliags")
    (run / file).write_text(content)
    refuses(tmp_path, [run], match)


def test_images_of_another_size_are_refused(tmp_path):
    run = make_run(tmp_path, "coliags")
    write_png(run / "eval" / "paper" / "renders" / "test" / "0004.png", np.zeros((5, 6, 3), np.uint8))
    refuses(tmp_path, [run], "6 x 5 px. Expected 16 x 12 px")
