"""Section of provenance: data, methods, and every run with its hashes."""

from __future__ import annotations

from collections.abc import Sequence

from coliags_plugin.comparison.report.comparability import code_of, scene_provenance
from coliags_plugin.comparison.report.costs import training_device
from coliags_plugin.comparison.report.study import Study, StudyRun
from coliags_plugin.reporting.model import Column, Folded, Section, Table, TableCell, leaves, record
from coliags_plugin.reporting.numbers import counted, plain

#: Hexadecimal digits of a hash that are shown.
_DIGITS = 12
_NUMBERS = ("Seed", "Steps")


def provenance_section(study: Study) -> Section:
    """What is recorded of every scene, of one run of every method, and of all runs in a table."""
    by_scene = [[run for run in study.runs if run.scene == scene] for scene in study.scenes]
    blocks = [block for runs in by_scene for block in _scene_records(runs)]
    blocks += [_run_record(method, runs[0]) for method, runs in study.by_method.items()]
    return Section(
        "Provenance", [*blocks, Folded(counted(len(study.runs), "run"), [_runs_table(study)])], screen_only=True
    )


def _scene_records(runs: Sequence[StudyRun]) -> list[Folded]:
    """One record of a scene, or one for each run where they differ."""
    scene, records = runs[0].scene, [scene_provenance(run.result) for run in runs]
    if all(leaves(own) == leaves(records[0]) for own in records):
        return [record(f"Data of {scene}", records[0])]
    return [record(f"Data of {scene}, {run.method}", own) for run, own in zip(runs, records, strict=True)]


def _run_record(title: str, run: StudyRun) -> Folded:
    result = run.result
    values = {"run": run.stamp, "steps": result.steps, "seed": result.seed, "software": result.software}
    own = {name: value for name, value in result.provenance.items() if name != "scene"}
    return record(title, {**values, **own, "config": result.config})


def _runs_table(study: Study) -> Table:
    rows = [_row(run, study.methods.index(run.method)) for run in study.runs]
    note = (
        f"Key: of all that determines the result. Values, predictions, truth: the first {_DIGITS} digits of their "
        "SHA-256, the latter two of each test set"
    )
    columns = [Column(name, words=name not in _NUMBERS) for name in rows[0]]
    return Table("Runs", columns, rows, [note], name="runs")


def _row(run: StudyRun, style: int) -> dict[str, TableCell | str | float]:
    result = run.result
    predictions, truth = (
        " ".join(dict.fromkeys(getattr(part, name)[:_DIGITS] for part in result.sets.values()))
        for name in ("predictions_sha256", "truth_sha256")
    )
    return {
        "Method": TableCell(run.method, style=style),
        "Scene": run.scene,
        "Split": result.scene.split,
        "Seed": result.seed,
        "Steps": TableCell(f"{result.steps:,}", result.steps),
        "Run": run.stamp,
        "Device": training_device(result.cost),
        "Version": plain(result.software.get("package_version")),
        "Code": code_of(result),
        "Key": result.key,
        "Values": result.metrics_sha256[:_DIGITS],
        "Predictions": predictions,
        "Truth": truth,
    }
