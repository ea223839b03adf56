"""Experiments of docs/results.md: hyperparameters chosen on tuning phantoms, then all tables on test phantoms.

python benchmarks/results.py tune OUT
python benchmarks/results.py measure OUT
python benchmarks/results.py plateau OUT
python benchmarks/results.py write OUT

``tune`` tries changes of every method of the ablation ``rivals`` on held-out frames of two scenes of the benchmark
``phantoms-tuning``, as many of each: for as many steps, which tells their processor time, and then for as much of it,
by which they are chosen, in ``OUT/tuned.json``. ``measure`` trains on ``phantoms-12`` with these choices in equal
processor time, the rows of the paper's ablation, and with several seeds. ``plateau`` finds run lengths of the first
methods on the tuning scenes, and trains so long on every second scene of ``phantoms-12``. ``write`` makes the reports.
Whatever is killed, the same command goes on.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from machine import markdown_table

import coliags_plugin
from coliags_plugin.comparison.named_files import Variant, load_ablation
from coliags_plugin.config.method_config import load_method
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import write_json
from coliags_plugin.core.json_files import read_json
from coliags_plugin.results.record import Result

#: Trials of each method, as many of one kind of field as of the other: anchors in finer voxels, other fields from more
#: points; and with few events of densification, one after three tenths of the run.
TRIALS: dict[str, tuple[tuple[str, ...], ...]] = {
    "anchors": (
        ("field.voxel_pixels=3.0",),
        ("field.voxel_pixels=2.0",),
        ("field.voxel_pixels=2.0", "strategy.every={few}"),
    ),
    "points": (
        ("datamanager.points_count=50000",),
        ("datamanager.points_count=100000",),
        ("datamanager.points_count=100000", "strategy.every={few}"),
    ),
}
FEW = 0.3
#: Test frames of the tuning phantoms: every eighth from the fifth on, which are no test frames of ``every-8th``.
VALIDATION = "inner-8th"
#: The row of the paper's ablation that has all parts.
WHOLE = "depth-imve-imia"
#: Methods trained with several seeds, and to their plateau: the first of the ablation.
SEVERAL_SEEDS, SEEDS, TO_PLATEAU = 4, 3, 5
#: What the first method of a table is compared with the others by; decided before anything is measured.
PRIMARY = ("psnr", "depth_mse_inner")
#: Run lengths on the way to a plateau, and by how much twice as many steps must raise PSNR for the way to go on, dB.
LADDER, RISE = (1000, 2000, 4000), 0.1


@dataclass(frozen=True)
class _Command:
    out: tyro.conf.Positional[Path]
    """Folder of all runs and results."""
    tuning: tuple[str, ...] = ("phantoms-tuning/strong-4229", "phantoms-tuning/guides-inspection-5063")
    """Scenes on which choices are made."""
    test: tuple[str, ...] = ("phantoms-12",)
    """Benchmark or scenes that are measured."""
    steps: int = 1000
    """Steps of the trials; the processor time of ``coliags`` for as many is what every method gets."""
    jobs: int | None = None
    """Runs at a time."""

    def compare(self, name: str, variants: Sequence[Variant], scenes: Sequence[str], **options: Any) -> list[Result]:
        """Train and evaluate variants in a folder of their own; all must succeed."""
        done = coliags_plugin.compare(variants, scenes, self.out / name, jobs=self.jobs, **options)
        print(done.table(), flush=True)
        if done.failures:
            raise InputError(
                f"{len(done.failures)} runs of {name} failed", "every run to succeed", "see the reasons above"
            )
        return list(done.results)

    @property
    def tuned(self) -> Path:
        """File of the choices."""
        return self.out / "tuned.json"


@dataclass(frozen=True)
class Tune(_Command):
    """Command that chooses changes of every method on validation frames of the tuning phantoms."""

    def run(self) -> None:
        """Try, choose and write the choices."""
        methods = load_ablation("rivals")
        trials = {method.name: _trials(method) for method in methods}
        every = [one for own in trials.values() for one in own]
        results = self.compare("trials", every, self.tuning, splits=[VALIDATION], steps=self.steps)
        first, seconds = trials[methods[0].name], _means(results, lambda result: result.cost.processor_seconds)
        budget = seconds[_best(first, _means(results, _psnr)).name]
        # In as many steps, methods that grow have the time of several others.
        steps = {name: max(100, 100 * round(self.steps * budget / own / 100)) for name, own in seconds.items()}
        timed = [_for_steps(one, steps[one.name]) for one in every]
        psnr = _means(self.compare("trials-in-time", timed, self.tuning, splits=[VALIDATION]), _psnr)
        chosen = {}
        for method in methods:
            own = trials[method.name]
            best = _best(own, psnr)
            chosen[method.name] = {
                "changes": _changes(method)[own.index(best)],
                "steps": steps[best.name],
                "trials": {one.name: [psnr[one.name], steps[one.name]] for one in own},
            }
        write_json(self.tuned, chosen)
        keys = ("changes", "steps")
        print(markdown_table([{"method": name} | {key: one[key] for key in keys} for name, one in chosen.items()]))


class _WithChoices(_Command):
    def chosen(self) -> dict[str, Any]:
        """Hyperparameters and run length chosen for each method, from ``tuned.json``."""
        if not self.tuned.is_file():
            raise InputError(f"{self.tuned} is not there", "the choices", "run the command `tune` first")
        return read_json(self.tuned, "the choices")


@dataclass(frozen=True)
class Measure(_WithChoices):
    """Command that trains and evaluates on the test phantoms as was chosen."""

    def run(self) -> None:
        """Measure in equal time, the rows of the paper's ablation, and the first methods with several seeds."""
        chosen, methods = self.chosen(), load_ablation("rivals")
        equal = [_with(method, chosen, chosen[method.name]["steps"]) for method in methods]
        self.compare("equal-time", equal, self.test, reference=methods[0].name, primary=PRIMARY)
        for protocol in ("expected-depth", "median-depth"):
            self.compare("equal-time", equal, self.test, protocol=protocol)
        first = chosen[methods[0].name]
        rows = [_with(row, {row.name: first}, first["steps"]) for row in load_ablation("paper-rows")]
        self.compare("paper-rows", rows, self.test, reference=WHOLE, primary=PRIMARY)
        # Apart, and exploratory: primary is seed 0, which is not trained again.
        several = equal[:SEVERAL_SEEDS]
        for method in several:
            for file in (self.out / "equal-time" / "results").glob(f"*/{method.name}/s0-*.json"):
                copy = self.out / "seeds" / file.relative_to(self.out / "equal-time")
                copy.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(file, copy)
        self.compare("seeds", several, self.test, seeds=SEEDS)


@dataclass(frozen=True)
class Plateau(_WithChoices):
    """Command that finds the run lengths of plateaus, and trains so long on every second test phantom."""

    test: tuple[str, ...] = (
        "phantoms-12/rotation-14241",
        "phantoms-12/inspection-drift-37830",
        "phantoms-12/guides-54793",
        "phantoms-12/rough-wall-58216",
        "phantoms-12/tracked-61817",
        "phantoms-12/living-tracked-97640",
    )
    """Scenes that are measured."""

    def run(self) -> None:
        """Climb on the tuning scenes, and measure."""
        chosen, methods = self.chosen(), load_ablation("rivals")[:TO_PLATEAU]
        reached = {method.name: self._climbed(method, chosen) for method in methods}
        write_json(self.out / "plateaus.json", reached)
        long = [_with(method, chosen, int([*reached[method.name]][-1])) for method in methods]
        self.compare("plateau", long, self.test, reference=methods[0].name, primary=PRIMARY)

    def _climbed(self, method: Variant, chosen: Mapping[str, Any]) -> dict[str, float]:
        """PSNR by run length, doubled until it no longer rises; the last is that of the plateau."""
        reached: dict[str, float] = {}
        for steps in LADDER:
            tried = [_with(method, chosen, steps)]
            results = self.compare(f"ladder-{steps}", tried, self.tuning, splits=[VALIDATION])
            before, reached[str(steps)] = [*reached.values()], _means(results, _psnr)[method.name]
            if before and reached[str(steps)] < before[-1] + RISE:
                break
        return reached


@dataclass(frozen=True)
class Write(_Command):
    """Command that writes the reports of all comparisons on the test phantoms."""

    def run(self) -> None:
        """Write every comparison's report as a page, Markdown and CSV."""
        for name in ("equal-time", "seeds", "plateau", "paper-rows"):
            written = coliags_plugin.report(
                self.out / name, self.out / f"{name}.html", formats=["html", "markdown", "csv"]
            )
            print(*written, sep="\n")


def _changes(method: Variant) -> list[tuple[str, ...]]:
    """The changes of a method that are tried."""
    config = load_method(method.method, method.overrides).config
    few = round(FEW * config.schedule.written_for)
    kind = "anchors" if config.field.name == "anchors" else "points"
    return [tuple(change.format(few=few) for change in changes) for changes in TRIALS[kind]]


def _trials(method: Variant) -> list[Variant]:
    """A method with each change that is tried, under names of their own."""
    return [
        replace(method, name=f"{method.name}.{number}", overrides=(*method.overrides, *changes))
        for number, changes in enumerate(_changes(method))
    ]


def _best(trials: Sequence[Variant], psnr: Mapping[str, float]) -> Variant:
    """The trial of the highest PSNR."""
    return max(trials, key=lambda one: psnr[one.name])


def _for_steps(method: Variant, steps: int) -> Variant:
    """A method for so many steps."""
    return replace(method, overrides=(*method.overrides, f"schedule.steps={steps}"))


def _with(method: Variant, chosen: Mapping[str, Any], steps: int) -> Variant:
    """A method with the changes that were chosen, for so many steps."""
    changed = replace(method, overrides=(*method.overrides, *chosen[method.name]["changes"]))
    return _for_steps(changed, steps)


def _psnr(result: Result) -> float | None:
    return result.mean("psnr")


def _means(results: Sequence[Result], measure: Callable[[Result], float | None]) -> dict[str, float]:
    """Average of a metric or cost over all scenes, for each method; InputError where a result lacks it."""
    values: dict[str, list[float]] = {}
    for result in results:
        value = measure(result)
        if value is None:
            raise InputError(f"{result.title} lacks a measure", "PSNR and processor time of every run")
        values.setdefault(result.method, []).append(value)
    return {name: float(np.mean(own)) for name, own in values.items()}


Options = Tune | Measure | Plateau | Write


def main(options: Options) -> None:
    """Run the chosen command."""
    options.run()


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
