"""Tables of docs/results.md, made from the archived results of its measurement.

    python docs/tools/results_page.py            # writes the tables into the page
    python docs/tools/results_page.py --check    # tells whether the page has them

A table stands between the comments ``<!-- table NAME -->`` and ``<!-- end -->``; everything else is written by hand.
"""

from __future__ import annotations

import re
import sys
import tarfile
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from coliags_plugin.comparison.plan import PlannedCell, read_plan
from coliags_plugin.reporting.model import simple_table
from coliags_plugin.reporting.text_formats import markdown_table
from coliags_plugin.results.comparisons import RivalComparison, compare_with_rivals, scene_means
from coliags_plugin.results.reading import read_result
from coliags_plugin.results.record import Result

PAGE = Path(__file__).parents[1] / "results.md"
ARCHIVE = PAGE.parent / "results" / "measurement.tar.xz"
TABLE = re.compile(r"(?<=<!-- table )([\w-]+)( -->\n).*?(?=<!-- end -->)", re.DOTALL)
#: The method that all others are compared with, and the row of the paper's ablation that has all parts.
REFERENCE, WHOLE = "coliags", "depth-imve-imia"
#: Methods whose every scene is shown.
SHOWN = ("coliags", "coliags-plus", "scaffold-gs-distance", "scaffold-gs-distance-gain", "3dgs-depth-gain", "pr-endo")
#: How many of the scenes, which come first, have light as ``coliags-plus`` models it.
ASSUMED = 5
#: Columns of a table: texts by method, by the columns' titles.
Columns = dict[str, Mapping[str, str]]


@dataclass(frozen=True)
class Comparison:
    """Results of one comparison under one protocol."""

    results: Sequence[Result]
    reference: str

    @property
    def methods(self) -> list[str]:
        """Names, in the order of the plan."""
        return list(dict.fromkeys(result.method for result in self.results))

    @property
    def with_depth(self) -> list[str]:
        """Names of the methods with depth supervision."""
        return list(dict.fromkeys(result.method for result in self.results if "depth" in result.config["losses"]))

    def values(self, metric: str, test_set: str = "test") -> dict[str, dict[str, dict[int, float]]]:
        """A metric by method, scene and seed; without those of scenes that lack it."""
        found: dict[str, dict[str, dict[int, float]]] = {name: {} for name in self.methods}
        for result in self.results:
            value = result.sets[test_set].mean(metric) if test_set in result.sets else None
            if value is not None:
                found[result.method].setdefault(result.scene.name, {})[result.seed] = value
        return found

    def column(
        self, metric: str, form: str, average: Callable[[Any], Any] = np.mean, test_set: str = "test"
    ) -> dict[str, str]:
        """Mean or median of a metric over all scenes, formatted, for each method that has it."""
        scenes = {name: [*scene_means(own).values()] for name, own in self.values(metric, test_set).items()}
        return {name: text(average(own), form) for name, own in scenes.items() if own}

    def cost(self, form: str, of: Callable[[Result], float | None]) -> dict[str, str]:
        """Mean of a cost over all runs, formatted, for each method that has it."""
        costs = {name: [of(result) for result in self.results if result.method == name] for name in self.methods}
        known = {name: [cost for cost in own if cost is not None] for name, own in costs.items()}
        return {name: text(np.mean(own), form) for name, own in known.items() if own}

    def leads(self, metric: str) -> dict[str, RivalComparison]:
        """Leads of the reference, by rival."""
        higher_is_better = self.results[0].metrics[metric].direction == "higher"
        compared = compare_with_rivals(self.values(metric), self.reference, higher_is_better)
        return {row.rival: row for row in compared}


def colour_columns(of: Comparison) -> Columns:
    """PSNR, SSIM and LPIPS, and the leads in PSNR."""
    leads = of.leads("psnr")
    return {
        "PSNR, dB": of.column("psnr", ".2f"),
        "median": of.column("psnr", ".2f", np.median),
        "SSIM": of.column("ssim", ".3f"),
        "LPIPS": of.column("lpips_squeeze", ".3f"),
        f"lead of {of.reference}, dB": {name: lead_text(row) for name, row in leads.items()},
        **significance_columns(leads),
    }


def depth_columns(of: Comparison, kinds: Mapping[str, Comparison]) -> Columns:
    """Errors of depth, as accumulated, and of the other kinds of rendered depth."""
    return {
        "inner MSE": of.column("depth_mse_inner", ""),
        "median": of.column("depth_mse_inner", "", np.median),
        **{f"inner, {kind}": each.column("depth_mse_inner", "") for kind, each in kinds.items()},
        "MSE": of.column("depth_mse", ""),
        "median error, mm": of.column("depth_median_error", ""),
        **significance_columns(of.leads("depth_mse_inner")),
    }


def turned_columns(of: Comparison) -> Columns:
    """PSNR as rendered and with one fitted factor for each image, of turned views over seen pixels."""
    return {
        "turned views, dB": of.column("psnr_seen", ".2f", test_set="rotation"),
        "with a fitted gain": of.column("psnr_gain_fitted_seen", ".2f", test_set="rotation"),
        "held-out frames with a fitted gain": of.column("psnr_gain_fitted", ".2f"),
    }


def cost_columns(of: Comparison) -> Columns:
    """Steps, processor time, Gaussians and planned densification."""
    plans = {result.method: result.provenance.get("training", {}).get("plan") or "none" for result in of.results}
    return {
        "steps": of.cost(",.0f", lambda result: result.steps),
        "processor time, s": of.cost(".0f", lambda result: result.cost.processor_seconds),
        "Gaussians in a view": of.cost(",.0f", lambda result: result.cost.gaussians),
        "growth": {name: growth_text(plan) for name, plan in plans.items()},
    }


def growth_text(plan: str) -> str:
    """Planned densification of a run as text; the archive's range of a single event becomes its step."""
    return re.sub(r"at 1( steps)?, from (\d+) to \2\b", r"at step \2", plan.removeprefix("this run "))


def scene_table(of: Comparison, metric: str, methods: Sequence[str], form: str) -> str:
    """A metric of every scene, and its means over those with assumed light and over all others."""
    values = {name: scene_means(own) for name, own in of.values(metric).items()}
    scenes = [*dict.fromkeys(result.scene.name for result in of.results)]
    rows = {scene: [scene] for scene in scenes[:ASSUMED]} | {f"mean of these {ASSUMED}": scenes[:ASSUMED]}
    rows |= {scene: [scene] for scene in scenes[ASSUMED:]} | {"mean of the others": scenes[ASSUMED:]}
    columns: Columns = {
        name: {row: text(np.mean([values[name][scene] for scene in own]), form) for row, own in rows.items()}
        for name in methods
    }
    return table(columns, [*rows], "scene")


def seed_columns(of: Comparison) -> Columns:
    """Mean PSNR and lead of each seed, the deviation over seeds within a scene, and that of the means of all scenes."""
    values = of.values("psnr")
    grids = {name: np.array([[*by_seed.values()] for by_seed in own.values()]) for name, own in values.items()}
    rivals = [name for name in grids if name != of.reference]
    means = {name: grid.mean(axis=0) for name, grid in grids.items()}
    leads = {name: means[of.reference] - means[name] for name in rivals}
    return {
        "PSNR of seeds 0 / 1 / 2, dB": {name: by_seed_text(own, ".2f") for name, own in means.items()},
        f"lead of {of.reference}, dB": {name: by_seed_text(own, "+.2f") for name, own in leads.items()},
        "deviation over seeds: within a scene": {
            name: text(np.sqrt(grid.var(axis=1, ddof=1).mean()), ".2f") for name, grid in grids.items()
        },
        "of the mean": {name: text(own.std(ddof=1), ".2f") for name, own in means.items()},
    }


def by_seed_text(values: np.ndarray, form: str) -> str:
    """A value of each seed, formatted. [S]"""
    return " / ".join(text(value, form) for value in values)


def significance_columns(leads: Mapping[str, RivalComparison]) -> Columns:
    """Number of scenes on which the reference is better, and the adjusted p."""
    return {
        "better on": {name: f"{row.better_on} of {len(row.scenes)}" for name, row in leads.items()},
        "p, Holm": {name: text(row.tests.wilcoxon_holm, ".2g") for name, row in leads.items() if row.tests},
    }


def lead_text(row: RivalComparison) -> str:
    """Mean lead with its interval."""
    if row.lead is None:
        return ""
    interval = "" if row.tests is None else " ({:+.2f} to {:+.2f})".format(*row.tests.interval)
    return f"{row.lead:+.2f}{interval}"


def text(value: float | np.floating, form: str) -> str:
    """A number in a format; without one, two significant digits and no exponent."""
    return f"{value:{form}}" if form else f"{float(f'{value:.2g}'):f}".rstrip("0").rstrip(".")


def table(columns: Columns, rows: Sequence[str], kind: str = "method") -> str:
    """Format columns as a Markdown table with these rows."""
    cells = [[row, *(column.get(row) for column in columns.values())] for row in rows]
    return markdown_table(simple_table([kind, *columns], cells)) + "\n"


def equal_time_tables(folder: Path) -> Iterator[tuple[str, str]]:
    """Tables of all methods in equal processor time."""
    equal = comparison(folder, "equal-time")
    kinds = {kind: comparison(folder, "equal-time", f"{kind}-depth") for kind in ("expected", "median")}
    colour, depth = colour_columns(equal), depth_columns(equal, kinds)
    without = [name for name in equal.methods if name not in equal.with_depth]
    for name, methods in (("with-depth", equal.with_depth), ("without-depth", without)):
        yield f"{name}-colour", table(colour, methods)
        yield f"{name}-depth", table(depth, methods)
    yield "turned", table(turned_columns(equal), equal.methods)
    yield "cost", table(cost_columns(equal), equal.methods)
    shown = [name for name in equal.methods if name in SHOWN]
    yield "scenes-psnr", scene_table(equal, "psnr", shown, ".2f")
    yield "scenes-depth", scene_table(equal, "depth_mse_inner", shown, "")


def plateau_tables(folder: Path) -> Iterator[tuple[str, str]]:
    """Tables of run lengths on the tuning phantoms, and of the longest runs on the test phantoms."""
    plateau = comparison(folder, "plateau")
    lengths = sorted(int(path.name.removeprefix("ladder-")) for path in folder.glob("ladder-*"))
    rungs = {f"{steps:,} steps": comparison(folder, f"ladder-{steps}").column("psnr", ".2f") for steps in lengths}
    yield "ladder", table(rungs, plateau.methods)
    yield "plateau-colour", table(colour_columns(plateau), plateau.methods)
    yield "plateau-depth", table(depth_columns(plateau, {}), plateau.methods)
    yield "plateau-cost", table(cost_columns(plateau), plateau.methods)


def row_tables(folder: Path) -> Iterator[tuple[str, str]]:
    """Tables of the paper's ablation."""
    rows = comparison(folder, "paper-rows", reference=WHOLE)
    yield "rows-colour", table(colour_columns(rows), rows.methods)
    yield "rows-depth", table(depth_columns(rows, {}), rows.methods)


def seed_tables(folder: Path) -> Iterator[tuple[str, str]]:
    """Table of the seeds."""
    seeds = comparison(folder, "seeds")
    yield "seeds", table(seed_columns(seeds), seeds.methods)


#: Tables of each comparison, by its folder in the archive.
TABLES = {
    "equal-time": equal_time_tables,
    "plateau": plateau_tables,
    "paper-rows": row_tables,
    "seeds": seed_tables,
}


def tables(folder: Path) -> dict[str, str]:
    """All tables of the comparisons that are in a folder, by name."""
    there = [of for name, of in TABLES.items() if (folder / name).is_dir()]
    return {name: made for of in there for name, made in of(folder)}


def comparison(folder: Path, name: str, protocol: str = "paper", reference: str = REFERENCE) -> Comparison:
    """The results of a comparison under one protocol, methods and scenes in the order of the plan."""
    files = [folder / name / cell.result for cell in planned_cells(folder / name, protocol)]
    return Comparison([read_result(file) for file in files if file.is_file()], reference)


def planned_cells(folder: Path, protocol: str) -> list[PlannedCell]:
    """The cells of a comparison's plan under one protocol."""
    plan = read_plan(folder)
    return [] if plan is None else [cell for cell in plan.cells if cell.protocol == protocol]


def filled(page: str, made: Mapping[str, str]) -> str:
    """A page with these tables in their places."""
    return TABLE.sub(lambda found: f"{found[1]}{found[2]}\n{made[found[1]]}\n", page)


def main(arguments: Sequence[str]) -> int:
    """Write the tables into the page, or check that it has them."""
    before = PAGE.read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as folder:
        with tarfile.open(ARCHIVE) as archive:
            archive.extractall(folder, filter="data")
        after = filled(before, tables(Path(folder)))
    if "--check" in arguments:
        return int(after != before)
    PAGE.write_text(after, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
