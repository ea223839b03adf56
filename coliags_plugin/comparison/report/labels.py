"""Names of methods in a report, different for runs of one method that are not seeds of one another."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import replace

from coliags_plugin.comparison.report.study import StudyRun
from coliags_plugin.results.identity import training_config


def disambiguate_labels(runs: Sequence[StudyRun]) -> list[StudyRun]:
    """The runs with labels under which every method has one config and one run per scene, split and seed.

    Runs of one config that differ in seed share a label. Where a method has several configs or several runs of one
    seed, its label is followed by what tells them apart: steps, the stamp of the run, or a hash of the config.
    """
    groups: dict[str, list[int]] = {}
    for index, run in enumerate(runs):
        groups.setdefault(run.method, []).append(index)
    labelled = list(runs)
    for own in groups.values():
        group = [runs[index] for index in own]
        if not _is_one_method(group):
            for index, label in zip(own, _distinct_labels(group), strict=True):
                labelled[index] = replace(labelled[index], method=label)
    return labelled


def _is_one_method(runs: Sequence[StudyRun]) -> bool:
    """Whether runs of one label are one method: one config on each scene and split, and one run per seed."""
    configs: dict[tuple[str, str], str] = {}
    seeds = set()
    for run in runs:
        scene = run.result.scene
        key, config = (scene.name, scene.split), _config_hash(run)
        if configs.setdefault(key, config) != config or (key, run.result.seed) in seeds:
            return False
        seeds.add((key, run.result.seed))
    return True


def _distinct_labels(runs: Sequence[StudyRun]) -> list[str]:
    one_scene = len({run.scene for run in runs}) == 1
    steps, stamps = [f"{run.result.steps:,} steps" for run in runs], [run.stamp for run in runs]
    configs = [f"config {_config_hash(run)[:8]}" for run in runs]
    for suffixes in (steps, stamps, configs) if one_scene else (steps, configs, stamps):
        labels = [f"{run.method} · {suffix}" for run, suffix in zip(runs, suffixes, strict=True)]
        groups = ([run for run, own in zip(runs, labels, strict=True) if own == label] for label in set(labels))
        if all(map(_is_one_method, groups)):
            return labels
    labels = [f"{run.method} · {run.stamp}" for run in runs]
    return [
        f"{label} ({labels[: index + 1].count(label)})" if labels.count(label) > 1 else label
        for index, label in enumerate(labels)
    ]


def _config_hash(run: StudyRun) -> str:
    text = json.dumps([training_config(run.result.config), run.result.steps], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()
