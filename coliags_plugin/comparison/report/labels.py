"""Names of methods in a report, different for runs of one method that are not seeds of one another."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import replace

from coliags_plugin.comparison.report.study import Cell
from coliags_plugin.results.identity import training_config


def told_apart(cells: Sequence[Cell]) -> list[Cell]:
    """The cells with labels under which every method has one config and one run per scene, split and seed.

    Runs of one config that differ in seed share a label. Where a method has several configs or several runs of one
    seed, its label is followed by what tells them apart: steps, the stamp of the run, or a hash of the config.
    """
    groups: dict[str, list[int]] = {}
    for index, cell in enumerate(cells):
        groups.setdefault(cell.method, []).append(index)
    labelled = list(cells)
    for own in groups.values():
        group = [cells[index] for index in own]
        if not _clear(group):
            for index, label in zip(own, _distinct(group), strict=True):
                labelled[index] = replace(labelled[index], method=label)
    return labelled


def _clear(cells: Sequence[Cell]) -> bool:
    """Whether cells of one label are one method: one config on each scene and split, and one run per seed."""
    configs: dict[tuple[str, str], str] = {}
    seen = set()
    for cell in cells:
        scene = cell.result.scene
        place, config = (scene.name, scene.split), _config_hash(cell)
        if configs.setdefault(place, config) != config or (place, cell.result.seed) in seen:
            return False
        seen.add((place, cell.result.seed))
    return True


def _distinct(cells: Sequence[Cell]) -> list[str]:
    one_scene = len({cell.scene for cell in cells}) == 1
    ways: list[Callable[[Cell], str]] = [_steps, _stamp, _config] if one_scene else [_steps, _config, _stamp]
    for way in ways:
        labels = [f"{cell.method} · {way(cell)}" for cell in cells]
        groups = ([cell for cell, own in zip(cells, labels, strict=True) if own == label] for label in set(labels))
        if all(map(_clear, groups)):
            return labels
    labels = [f"{cell.method} · {cell.stamp}" for cell in cells]
    return [
        f"{label} ({labels[: index + 1].count(label)})" if labels.count(label) > 1 else label
        for index, label in enumerate(labels)
    ]


def _steps(cell: Cell) -> str:
    return f"{cell.result.steps:,} steps"


def _stamp(cell: Cell) -> str:
    return cell.stamp


def _config(cell: Cell) -> str:
    return f"config {_config_hash(cell)[:8]}"


def _config_hash(cell: Cell) -> str:
    text = json.dumps([training_config(cell.result.config), cell.result.steps], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()
