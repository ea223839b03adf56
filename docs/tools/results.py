"""Archive, tables and picture of docs/results.md, from finished comparisons.

    python docs/tools/results.py pack COMPARISON ...   # into docs/results.tar.xz; the same results give the same bytes
    python docs/tools/results.py tables [--check]      # writes the archive's tables into the page, or compares them
    python docs/tools/results.py picture COMPARISON    # docs/looks/results.jpg, from the runs of a comparison

A table stands between ``<!-- table COMPARISON KIND -->`` and ``<!-- end -->``, KIND being one of ``TABLES``; everything
else is written by hand. Cells without a result are left out.
"""

from __future__ import annotations

import io
import json
import lzma
import re
import sys
import tarfile
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

import coliags_plugin
from coliags_plugin.comparison.plan import PlannedCell, read_plan
from coliags_plugin.reporting.colormaps import color_bar, colorize_depth, depth_limits, side_by_side, stacked
from coliags_plugin.reporting.model import simple_table
from coliags_plugin.reporting.text_formats import markdown_table
from coliags_plugin.results.comparisons import scene_means
from coliags_plugin.results.reading import read_result
from coliags_plugin.results.record import Result

DOCS = Path(__file__).parents[1]
PAGE, ARCHIVE, PICTURE = DOCS / "results.md", DOCS / "results.tar.xz", DOCS / "looks" / "results.jpg"
TABLE = re.compile(r"(?<=<!-- table )([\w-]+) (\w+)( -->\n).*?(?=<!-- end -->)", re.DOTALL)
#: Methods, scenes and frames of the picture.
SHOWN = ("coliags-plus", "coliags", "scaffold-gs-distance-gain", "3dgs-depth-gain")
#: The metric by which the frame of median quality is chosen in each test set.
CHOSEN_BY = {"test": "psnr", "rotation": "psnr_gain_fitted_seen"}
TITLES = {"test": "held out", "rotation": "turned"}


@dataclass(frozen=True)
class Column:
    """One column of means: title, metric, test set, format (none: two significant digits)."""

    title: str
    metric: str
    test_set: str = "test"
    form: str = ""


COLUMNS = (
    Column("PSNR, dB", "psnr", form=".2f"),
    Column("with a fitted gain", "psnr_gain_fitted", form=".2f"),
    Column("SSIM", "ssim", form=".3f"),
    Column("LPIPS", "lpips_squeeze", form=".3f"),
    Column("inner depth MSE, mm²", "depth_mse_inner"),
    Column("depth MSE, mm²", "depth_mse"),
    Column("turned views, dB", "psnr_gain_fitted_seen", "rotation", ".2f"),
)


def means_table(results: Sequence[Result]) -> str:
    """Means over all scenes of every method: metrics, steps and processor time."""
    columns = {column.title: values(results, column) for column in COLUMNS}
    rows = []
    for method in names(results, lambda result: result.method):
        runs = [result for result in results if result.method == method]
        seconds = [result.cost.processor_seconds for result in runs if result.cost.processor_seconds is not None]
        cells = [
            text(float(np.mean([*scene_means(by_method[method]).values()])), column.form)
            if by_method.get(method)
            else ""
            for column, by_method in zip(COLUMNS, columns.values(), strict=True)
        ]
        rows.append([method, *cells, text(np.mean([run.steps for run in runs]), ",.0f"), text(np.mean(seconds), ".0f")])
    filled = [index for index, _ in enumerate(rows[0]) if any(row[index] for row in rows)]
    head = ["method", *columns, "steps", "s"]
    return markdown(
        [head[index] for index in filled],
        [[row[index] for index in filled] for row in rows],
    )


def scenes_table(results: Sequence[Result]) -> str:
    """PSNR and inner depth MSE of every scene."""
    methods = names(results, lambda result: result.method)
    psnr, depth = values(results, COLUMNS[0]), values(results, COLUMNS[4])
    rows = []
    for scene in names(results, lambda result: result.scene.name):
        cells = [
            f"{text(scene_means(psnr[name])[scene], '.2f')} / {text(scene_means(depth[name])[scene], '')}"
            if scene in psnr[name]
            else ""
            for name in methods
        ]
        rows.append([scene, *cells])
    return markdown(["PSNR, dB / inner depth MSE, mm²", *methods], rows)


TABLES: dict[str, Callable[[Sequence[Result]], str]] = {
    "means": means_table,
    "scenes": scenes_table,
}


def values(results: Sequence[Result], column: Column) -> dict[str, dict[str, dict[int, float]]]:
    """A metric by method, scene and seed; without those of runs that lack it."""
    found: dict[str, dict[str, dict[int, float]]] = {}
    for result in results:
        part = result.sets.get(column.test_set)
        value = None if part is None or column.metric not in part.values else part.mean(column.metric)
        if value is not None:
            found.setdefault(result.method, {}).setdefault(result.scene.name, {})[result.seed] = value
    return found


def names(results: Sequence[Result], key: Callable[[Result], str]) -> list[str]:
    """Distinct names, in the order of the plan."""
    return list(dict.fromkeys(map(key, results)))


def text(value: float | np.floating, form: str) -> str:
    """A number in a format; without one, two significant digits and no exponent."""
    return f"{value:{form}}" if form else f"{float(f'{value:.2g}'):f}".rstrip("0").rstrip(".")


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format a Markdown table."""
    return markdown_table(simple_table(head, rows)) + "\n"


def cells(folder: Path) -> list[PlannedCell]:
    """The cells of a comparison that have a result, scenes and methods in the order of the plan."""
    plan = read_plan(folder)
    return [] if plan is None else [cell for cell in plan.cells if (folder / cell.result).is_file()]


def filled(page: str, folder: Path) -> str:
    """A page with the tables of the comparisons in a folder in their places."""

    def table(found: re.Match[str]) -> str:
        comparison = folder / found[1]
        made = TABLES[found[2]]([read_result(comparison / cell.result) for cell in cells(comparison)])
        return f"{found[1]} {found[2]}{found[3]}\n{made}\n"

    return TABLE.sub(table, page)


def pack(folders: Sequence[Path], archive: Path) -> None:
    """Write plans and results of comparisons into an archive, in place of those that it has under their names."""
    contents: dict[str, bytes] = {}
    if archive.is_file():
        with tarfile.open(archive) as kept:
            contents = {member.name: kept.extractfile(member).read() for member in kept}
    replaced = tuple(f"{folder.name}/" for folder in folders)
    contents = {name: content for name, content in contents.items() if not name.startswith(replaced)}
    for folder in folders:
        plan = json.loads((folder / "plan.json").read_text(encoding="utf-8"))
        plan["cells"] = [cell for cell in plan["cells"] if (folder / cell["result"]).is_file()]
        contents[f"{folder.name}/plan.json"] = (json.dumps(plan, indent=2) + "\n").encode()
        contents |= {
            f"{folder.name}/{cell['result']}": (folder / cell["result"]).read_bytes() for cell in plan["cells"]
        }
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w", format=tarfile.PAX_FORMAT) as tar:
        for name, content in sorted(contents.items()):
            member = tarfile.TarInfo(name)
            member.size = len(content)
            tar.addfile(member, io.BytesIO(content))
    archive.write_bytes(lzma.compress(packed.getvalue(), preset=9 | lzma.PRESET_EXTREME))


def write_tables(check: bool) -> int:
    """Write the archive's tables into the page; or, to check, return 1 where the page has others."""
    before = PAGE.read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as folder:
        with tarfile.open(ARCHIVE) as archive:
            archive.extractall(folder, filter="data")
        after = filled(before, Path(folder))
    if not check:
        PAGE.write_text(after, encoding="utf-8")
    return int(check and after != before)


def draw(folder: Path) -> np.ndarray:
    """Held-out and turned view, and their depth, of the last scene: frames of median quality of the first method."""
    last = cells(folder)[-1].scene
    of_scene = {cell.method: cell for cell in cells(folder) if cell.scene == last and cell.seed == 0}
    shown = {name: of_scene[name] for name in SHOWN if name in of_scene}
    results = {name: read_result(folder / cell.result) for name, cell in shown.items()}
    runs = {name: coliags_plugin.load_run(folder / cell.run) for name, cell in shown.items()}
    columns = [column(part, results, runs) for part in CHOSEN_BY if part in results[SHOWN[0]].sets]
    return side_by_side(columns, [TITLES[part] for part in CHOSEN_BY][: len(columns)])


def column(part: str, results: Mapping[str, Result], runs: Mapping[str, coliags_plugin.Run]) -> np.ndarray:
    """Colours and depth of one view as recorded and by each method, below each other, and the scale of depth."""
    scores = {name: scored(result, part) for name, result in results.items()}
    first = scores[SHOWN[0]]
    frame = sorted(first, key=lambda name: first[name])[len(first) // 2]
    views = {name: run.render(frame) for name, run in runs.items()}
    truth = views[SHOWN[0]]
    assert truth.true_rgb is not None and truth.true_depth is not None  # a phantom has both
    limits = depth_limits([truth.true_depth])
    rows = [("recorded", truth.true_rgb, truth.true_depth)]
    rows += [(f"{name}, {scores[name][frame]:.1f} dB", view.rgb, view.depth) for name, view in views.items()]
    pictures = [
        side_by_side([enlarged(rgb), enlarged(colorize_depth(depth, limits))], [title, ""])
        for title, rgb, depth in rows
    ]
    return stacked([*pictures, color_bar(limits, "mm", "depth")])


def scored(result: Result, part: str) -> dict[str, float]:
    """The metric by which a frame of a test set is chosen, for each frame that has it."""
    of = result.sets[part]
    pairs = zip(of.frames, of.values[CHOSEN_BY[part]], strict=True)
    return {frame: value for frame, value in pairs if value is not None}


def enlarged(image: np.ndarray) -> np.ndarray:
    """An image twice as large."""
    return cv2.resize(image, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)


def main(command: str, *arguments: str) -> int:
    """Run a command; its exit status."""
    if command == "tables":
        return write_tables("--check" in arguments)
    if command == "pack":
        pack([Path(argument) for argument in arguments], ARCHIVE)
    else:
        cv2.imwrite(str(PICTURE), draw(Path(arguments[0]))[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
