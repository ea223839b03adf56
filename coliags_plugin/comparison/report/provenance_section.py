"""Section of provenance: data, methods, and every run with its hashes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from coliags_plugin.comparison.report.comparability import scene_provenance
from coliags_plugin.comparison.report.cost_table import training_device
from coliags_plugin.comparison.report.html_blocks import folded, html_table
from coliags_plugin.comparison.report.study import Cell, Study
from coliags_plugin.comparison.report.tables import Column, Entry, Row, Table, counted
from coliags_plugin.outputs.page import leaves, plain, record

#: Hexadecimal digits of a hash that are shown.
_DIGITS = 12


def provenance_section(study: Study) -> str:
    """HTML section: what is recorded of every scene, of one run of every method, and of all runs in a table."""
    parts = ["<section><h2>Provenance</h2>"]
    for scene in study.scenes():
        parts += _scene([cell for cell in study.cells if cell.scene == scene])
    parts += [record(method, _run(cells[0])) for method, cells in study.by_method.items()]
    parts.append(folded(counted(len(study.cells), "run"), [html_table(_runs(study))]))
    return "\n".join([*parts, "</section>"])


def _scene(cells: list[Cell]) -> list[str]:
    """One record of a scene, or one for each run where they differ."""
    scene = cells[0].scene
    first = scene_provenance(cells[0].result)
    if all(leaves(scene_provenance(cell.result)) == leaves(first) for cell in cells):
        return [record(f"Data of {scene}", first)]
    return [record(f"Data of {scene}, {cell.method}", scene_provenance(cell.result)) for cell in cells]


def _run(cell: Cell) -> Mapping[str, Any]:
    result = cell.result
    own = {name: value for name, value in result.provenance.items() if name != "scene"}
    return {
        "run": cell.stamp,
        "steps": result.steps,
        "seed": result.seed,
        "software": result.software,
        **own,
        "config": result.config,
    }


def _runs(study: Study) -> Table:
    columns = ("Scene", "Split", "Seed", "Steps", "Run", "Device", "Version", "Key", "Values", "Predictions", "Truth")
    numbers = {"Seed", "Steps"}
    return Table(
        title="Runs",
        head="Method",
        columns=tuple(Column(name.lower(), name, words=name not in numbers) for name in columns),
        rows=tuple(_row(cell, study.methods.index(cell.method)) for cell in study.cells),
        notes=(
            f"Key: of all that determines the result. Values, predictions, truth: the first {_DIGITS} digits of their "
            "SHA-256, the latter two of each test set",
        ),
        name="runs",
    )


def _row(cell: Cell, style: int) -> Row:
    result = cell.result
    predictions, truth = (
        " ".join(dict.fromkeys(getattr(part, name)[:_DIGITS] for part in result.sets.values()))
        for name in ("predictions_sha256", "truth_sha256")
    )
    words = (
        result.scene.name,
        result.scene.split,
        str(result.seed),
        f"{result.steps:,}",
        cell.stamp,
        training_device(result.cost),
        plain(result.software.get("package_version")),
        result.key,
        result.metrics_sha256[:_DIGITS],
        predictions,
        truth,
    )
    numbers = {2: float(result.seed), 3: float(result.steps)}
    return Row(cell.method, tuple(Entry(word, numbers.get(index)) for index, word in enumerate(words)), style)
