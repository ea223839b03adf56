"""Tables of docs/results.md, made from the archived results of its measurement.

    python docs/tools/results_page.py            # writes the tables into the page
    python docs/tools/results_page.py --check    # tells whether the page has them

A table stands between the comments ``<!-- table NAME -->`` and ``<!-- end -->``; everything else is written by hand.
"""

from __future__ import annotations

import json
import re
import sys
import tarfile
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from coliags_plugin.results.comparisons import RivalComparison, compare_with_rivals, scene_means
from coliags_plugin.results.reading import read_result
from coliags_plugin.results.record import Result

PAGE = Path(__file__).parents[1] / "results.md"
ARCHIVE = PAGE.parent / "results" / "measurement.tar.xz"
TABLE = re.compile(r"(?<=<!-- table )([\w-]+)( -->\n).*?(?=<!-- end -->)", re.DOTALL)
#: The method that all others are compared with, and the row of the paper's ablation that has all parts.
REFERENCE, WHOLE = "coliags", "depth-imve-imia"
#: Methods without depth supervision.
NO_DEPTH = ("coliags-no-depth", "scaffold-gs", "3dgs", "2dgs", "gaussian-pancakes-no-depth", "pr-endo-no-depth")
#: Methods whose every scene is shown.
SHOWN = ("coliags", "coliags-plus", "scaffold-gs-distance", "scaffold-gs-distance-gain", "3dgs-depth-gain", "pr-endo")
#: Metrics of which more is better.
HIGHER = ("psnr", "ssim")


@dataclass(frozen=True)
class Comparison:
    """Results of one comparison under one protocol."""

    results: Sequence[Result]
    reference: str

    @property
    def methods(self) -> list[str]:
        """Names, in the order of the plan."""
        return list(dict.fromkeys(result.method for result in self.results))

    def values(self, metric: str, test_set: str = "test") -> dict[str, dict[str, dict[int, float]]]:
        """A metric by method, scene and seed."""
        found: dict[str, dict[str, dict[int, float]]] = {name: {} for name in self.methods}
        for result in self.results:
            value = result.mean(metric, test_set)
            if value is not None:
                found[result.method].setdefault(result.scene.name, {})[result.seed] = value
        return found

    def over_scenes(self, metric: str, test_set: str = "test") -> dict[str, np.ndarray]:
        """A metric's means over seeds, for every scene, by method."""
        return {
            name: np.array([*scene_means(by_seed).values()]) for name, by_seed in self.values(metric, test_set).items()
        }

    def leads(self, metric: str) -> dict[str, RivalComparison]:
        """Leads of the reference, by rival."""
        compared = compare_with_rivals(self.values(metric), self.reference, metric.startswith(HIGHER))
        return {row.rival: row for row in compared}

    def costs(self, of: Callable[[Result], float | None]) -> dict[str, float]:
        """Mean of a cost over the runs, by method."""
        return {
            name: float(np.mean([of(result) or np.nan for result in self.results if result.method == name]))
            for name in self.methods
        }


def colour_table(of: Comparison, methods: Sequence[str]) -> str:
    """PSNR, SSIM and LPIPS, and the leads in PSNR."""
    psnr, leads = of.over_scenes("psnr"), of.leads("psnr")
    ssim, lpips = of.over_scenes("ssim"), of.over_scenes("lpips_squeeze")
    head = ["method", "PSNR, dB", "median", "SSIM", "LPIPS", f"lead of `{of.reference}`, dB", "better on", "p, Holm"]
    return table(
        head,
        [
            [
                f"`{name}`",
                f"{psnr[name].mean():.2f} +- {psnr[name].std(ddof=1):.2f}",
                f"{np.median(psnr[name]):.2f}",
                f"{ssim[name].mean():.3f}",
                f"{lpips[name].mean():.3f}",
                lead_cell(leads.get(name)),
                *test_cells(leads.get(name)),
            ]
            for name in methods
        ],
    )


def depth_table(of: Comparison, kinds: Mapping[str, Comparison], methods: Sequence[str]) -> str:
    """Errors of depth, as accumulated, and of the other kinds of rendered depth."""
    inner, leads = of.over_scenes("depth_mse_inner"), of.leads("depth_mse_inner")
    whole, median = of.over_scenes("depth_mse"), of.over_scenes("depth_median_error")
    others = {kind: each.over_scenes("depth_mse_inner") for kind, each in kinds.items()}
    head = ["method", "inner MSE", "median", *(f"inner, {kind}" for kind in kinds), "MSE", "median error, mm"]
    head += ["better on", "p, Holm"]
    return table(
        head,
        [
            [
                f"`{name}`",
                number(inner[name].mean()),
                number(np.median(inner[name])),
                *(number(each[name].mean()) for each in others.values()),
                number(whole[name].mean()),
                number(median[name].mean()),
                *test_cells(leads.get(name)),
            ]
            for name in methods
        ],
    )


def turned_table(of: Comparison, methods: Sequence[str]) -> str:
    """PSNR of turned views over seen pixels, as rendered and with one fitted factor for each image."""
    raw, fitted = (of.over_scenes(f"psnr{kind}_seen", "rotation") for kind in ("", "_gain_fitted"))
    held_out = of.over_scenes("psnr_gain_fitted")
    return table(
        ["method", "turned views, dB", "with a fitted gain", "held-out frames with a fitted gain"],
        [[f"`{name}`", *(f"{each[name].mean():.2f}" for each in (raw, fitted, held_out))] for name in methods],
    )


def cost_table(of: Comparison, methods: Sequence[str]) -> str:
    """What the runs cost, and what they densified."""
    steps, seconds = of.costs(lambda result: result.steps), of.costs(lambda result: result.cost.processor_seconds)
    drawn, memory = of.costs(lambda result: result.cost.gaussians), of.costs(lambda result: result.cost.peak_memory_mib)
    plans = {result.method: result.provenance.get("training", {}).get("plan") or "none" for result in of.results}
    return table(
        ["method", "steps", "processor time, s", "Gaussians in a view", "peak memory, MiB", "plan of growth"],
        [
            [
                f"`{name}`",
                f"{steps[name]:.0f}",
                f"{seconds[name]:.0f}",
                f"{drawn[name] / 1000:.0f},000",
                f"{memory[name]:.0f}",
                plans[name],
            ]
            for name in methods
        ],
    )


def scene_table(of: Comparison, metric: str, methods: Sequence[str], form: Callable[[float], str]) -> str:
    """A metric of every scene."""
    values = {name: scene_means(own) for name, own in of.values(metric).items()}
    scenes = dict.fromkeys(result.scene.name for result in of.results)
    rows = [[f"`{scene}`", *(form(values[name].get(scene, np.nan)) for name in methods)] for scene in scenes]
    return table(["scene", *(f"`{name}`" for name in methods)], rows)


def seeds_table(of: Comparison) -> str:
    """Means of each seed, and the spread over seeds within scenes beside that over scenes."""
    rows = []
    for name, by_scene in of.values("psnr").items():
        grid = np.array([[*seeds.values()] for seeds in by_scene.values()])
        within = np.sqrt(grid.var(axis=1, ddof=1).mean())
        rows.append([f"`{name}`", " / ".join(f"{mean:.2f}" for mean in grid.mean(axis=0)), f"{within:.2f}"])
    return table(["method", "PSNR of seeds 0 / 1 / 2, dB", "deviation over seeds, within a scene"], rows)


def lead_cell(row: RivalComparison | None) -> str:
    """Mean lead with its interval; empty for the reference itself."""
    if row is None or row.lead is None:
        return ""
    interval = "" if row.tests is None else " ({:+.2f} to {:+.2f})".format(*row.tests.interval)
    return f"{row.lead:+.2f}{interval}"


def test_cells(row: RivalComparison | None) -> list[str]:
    """Number of scenes on which the reference is better, and the adjusted p; empty for the reference itself."""
    if row is None:
        return ["", ""]
    p = "" if row.tests is None else f"{row.tests.wilcoxon_holm:.2g}"
    return [f"{row.better_on} of {len(row.scenes)}", p]


def number(value: float) -> str:
    """Two significant digits without an exponent."""
    return f"{float(f'{value:.2g}'):f}".rstrip("0").rstrip(".")


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    return "\n".join([f"| {' | '.join(row)} |" for row in [head, ["---"] * len(head), *rows]]) + "\n"


def tables(folder: Path) -> Iterator[tuple[str, str]]:
    """All tables of the measurement in a folder, by name."""
    kinds = {kind: comparison(folder, "equal-time", f"{kind}-depth") for kind in ("expected", "median")}
    equal = comparison(folder, "equal-time")
    with_depth = [name for name in equal.methods if name not in NO_DEPTH]
    for name, methods in (("with-depth", with_depth), ("without-depth", NO_DEPTH)):
        yield f"{name}-colour", colour_table(equal, methods)
        yield f"{name}-depth", depth_table(equal, kinds, methods)
    yield "turned", turned_table(equal, equal.methods)
    yield "cost", cost_table(equal, equal.methods)
    shown = [name for name in with_depth if name in SHOWN]
    yield "scenes-psnr", scene_table(equal, "psnr", shown, "{:.2f}".format)
    yield "scenes-depth", scene_table(equal, "depth_mse_inner", shown, number)
    plateau = comparison(folder, "plateau")
    yield "plateau-colour", colour_table(plateau, plateau.methods)
    yield "plateau-cost", cost_table(plateau, plateau.methods)
    rows = comparison(folder, "paper-rows", reference=WHOLE)
    yield "rows-colour", colour_table(rows, rows.methods)
    yield "rows-depth", depth_table(rows, {}, rows.methods)
    yield "seeds", seeds_table(comparison(folder, "seeds"))


def comparison(folder: Path, name: str, protocol: str = "paper", reference: str = REFERENCE) -> Comparison:
    """The results of a comparison under one protocol, methods and scenes in the order of the plan."""
    plan = json.loads((folder / name / "plan.json").read_text(encoding="utf-8"))
    files = [folder / name / cell["result"] for cell in plan["cells"] if cell["protocol"] == protocol]
    return Comparison([read_result(file) for file in files if file.is_file()], reference)


def filled(page: str, made: Mapping[str, str]) -> str:
    """A page with these tables in their places."""
    return TABLE.sub(lambda found: f"{found[1]}{found[2]}\n{made[found[1]]}\n", page)


def main(arguments: Sequence[str]) -> int:
    """Write the tables into the page, or check that it has them."""
    before = PAGE.read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as folder:
        with tarfile.open(ARCHIVE) as archive:
            archive.extractall(folder, filter="data")
        after = filled(before, dict(tables(Path(folder))))
    if "--check" in arguments:
        return int(after != before)
    PAGE.write_text(after, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
