"""Plan of a comparison: its cells, each one method on one scene with one split and one seed, and ``plan.json``."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, Field

from coliags_plugin.comparison.named_files import Variant
from coliags_plugin.comparison.scenes import SceneSource
from coliags_plugin.config.method_config import MethodConfig, load_method
from coliags_plugin.config.options import CompareOptions
from coliags_plugin.core import registry
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.json_files import read_json
from coliags_plugin.core.settings import invalid_reported
from coliags_plugin.engine.data_formats import data_manager, load_method_for
from coliags_plugin.results.hashing import code_key, result_key, training_key

#: Names within the folder of a comparison.
PLAN_FILE, RESULTS, RUNS, FAILURES, LOGS = "plan.json", "results", "runs", "failures", "logs"
#: Version of the schema below.
VERSION = 2
#: Digits of a key in names of files.
_SHORT = 8
_EXPECTED = "what `coliags compare` wrote"


class Decision(BaseModel, frozen=True):
    """Pre-registered analysis: reference method and primary metrics, fixed before the first run."""

    reference: str  # method that the others are compared with
    primary: tuple[str, ...] = Field(min_length=1)  # metrics whose p-values are not exploratory
    date: str  # YYYY-MM-DD, UTC


class PlannedCell(BaseModel, frozen=True):
    """A cell of a plan, and its places relative to the folder."""

    scene: str  # with the name of the split where it is not the scene's own
    method: str
    seed: int
    protocol: str
    key: str  # of the result
    run: str = Field(pattern=f"^{RUNS}/")  # run folder; protocols share it
    result: str = Field(pattern=f"^{RESULTS}/")  # results file; there once the cell is done

    @property
    def identity(self) -> tuple[str, str, int, str]:
        """Name of the cell: scene, method, seed, protocol."""
        return self.scene, self.method, self.seed, self.protocol

    @property
    def failure_file(self) -> str:
        """File with the reason for the failure of a cell."""
        return f"{FAILURES}/{self.result.removeprefix(f'{RESULTS}/')}"

    @property
    def log_file(self) -> str:
        """Messages of the processes that worked on its run."""
        return f"{LOGS}/{self.run.removeprefix(f'{RUNS}/')}.log"


class FailureRecord(PlannedCell, frozen=True):
    """Reason why a cell failed."""

    reason: str  # one line
    attempts: int  # processes that tried
    log: str  # their messages, relative to the comparison's folder


class ComparisonPlan(BaseModel, frozen=True):
    """Content of ``plan.json``: all that was ever asked for in this folder; what else archived ones say is not read."""

    format: Literal["coliags-comparison"] = "coliags-comparison"
    version: int = VERSION  # of this schema
    steps: int | None = None  # length of all runs; None: each method's own
    overrides: tuple[str, ...] = ()  # changes of all methods
    decided: Decision | None = None  # when the plan was first written
    cells: tuple[PlannedCell, ...] = ()  # in the order in which they were asked for


def read_plan(folder: Path) -> ComparisonPlan | None:
    """The plan of a folder; None where there is none."""
    file = folder / PLAN_FILE
    if not file.is_file():
        return None
    content = read_json(file, _EXPECTED, finite=True)
    version = content.get("version") if isinstance(content, dict) else None
    if isinstance(version, int) and version > VERSION:
        raise InputError(
            f"{file} is from a newer version of coliags_plugin: version {version}",
            f"version {VERSION} or older",
            "Update the package",
        )
    with invalid_reported(f"{file}: ", _EXPECTED):
        return ComparisonPlan.model_validate(content)


@dataclass(frozen=True)
class ComparisonCell:
    """One run of the comparison and its evaluation."""

    variant: Variant
    scene: SceneSource
    scene_label: str  # name of the scene; with that of the split where it is not the scene's own
    seed: int
    protocol: str
    overrides: tuple[str, ...]  # of the scene, the split, the variant and the comparison
    config: MethodConfig
    fingerprint: str | None  # of the scene's files; None while the scene, a phantom, is not there

    @property
    def steps(self) -> int:
        """Length of its training."""
        return self.config.schedule.steps

    @property
    def title(self) -> str:
        """Scene, method and seed, for messages."""
        return f"{self.scene_label} {self.variant.name} seed {self.seed}"

    @cached_property
    def planned(self) -> PlannedCell:
        """Names, key and places (``SCENE/METHOD/sSEED-KEY``) of a cell whose scene is there.

        Keys are those of :mod:`coliags_plugin.results.hashing`.
        """
        if self.fingerprint is None:
            raise ValueError(f"{self.title}: the scene is not there, so that it has no key")
        config, version = self.config.model_dump(), registry.protocols.get(self.protocol).version
        run = training_key(config, self.fingerprint, self.seed, code_key())
        result = result_key(config, self.fingerprint, self.seed, code_key(), self.protocol, version)
        place = f"{self.scene_label}/{self.variant.name.replace('/', '-')}/s{self.seed}"
        return PlannedCell(
            scene=self.scene_label,
            method=self.variant.name,
            seed=self.seed,
            protocol=self.protocol,
            key=result,
            run=f"{RUNS}/{place}-{run[:_SHORT]}",
            result=f"{RESULTS}/{place}-{result[:_SHORT]}.json",
        )


def make_cells(
    variants: Sequence[Variant], scenes: Sequence[SceneSource], options: CompareOptions
) -> list[ComparisonCell]:
    """All cells, those of one seed together, and within it those of one scene; of the options, the runs' are used."""
    steps = () if options.steps is None else (f"schedule.steps={options.steps}",)
    fingerprints: dict[str, str | None] = {}  # each computed once for each way of reading a scene
    cells: list[ComparisonCell] = []
    with _warnings_only():
        for scene, split, variant in product(scenes, dict.fromkeys(options.splits) or (None,), variants):
            chosen = () if split is None else (f"datamanager.split={split}",)
            overrides = (*scene.overrides, *chosen, *variant.overrides, *steps, *options.settings)
            config = _config(scene, variant.method, overrides)
            for kind, name in config.components():
                if registry.REGISTRIES[kind].source(name) == registry.REGISTERED:
                    raise InputError(
                        f"method '{variant.name}' uses '{name}' of {kind}, which this process registered",
                        "components that worker processes find",
                        f"Set {registry.PLUGIN_PATH_VARIABLE} to a file that defines COMPONENTS (docs/configs.md 7)",
                    )
            usual, used = (_split(each) for each in (_config(scene, variant.method, scene.overrides), config))
            label = scene.name if used in (None, usual) else f"{scene.name}-{used}"
            reader = config.datamanager
            way = f"{scene.name} {reader.name} {reader.settings.model_dump_json()}"
            if way not in fingerprints:
                manager = data_manager(reader, scene.path)
                fingerprints[way] = manager.fingerprint(scene.path) if scene.is_there else None
            cells += [
                ComparisonCell(variant, scene, label, seed, options.protocol, overrides, config, fingerprints[way])
                for seed in range(options.seeds)
            ]
    return sorted(cells, key=lambda cell: cell.seed)


def _config(scene: SceneSource, method: str, overrides: Sequence[str]) -> MethodConfig:
    """The method as it would read the scene; of a phantom that is not there, as far as that can be told."""
    data_format = scene.data_format
    if data_format is None and not scene.is_there:
        # The data manager that reads a phantom may have the name of its layout.
        data_format = None if scene.phantom is None else scene.phantom.layout
        if data_format not in registry.datamanagers.names():
            return load_method(method, overrides).config
    return load_method_for(scene.path, method, overrides, data_format).config


def _split(config: MethodConfig) -> str | None:
    """The split that a config's data manager makes; None where it knows none."""
    return getattr(config.datamanager.settings, "split", None)


@contextmanager
def _warnings_only() -> Iterator[None]:
    """Leave out what the data managers log of every folder."""
    logger = logging.getLogger("coliags_plugin")
    level = logger.level
    logger.setLevel(logging.WARNING)
    try:
        yield
    finally:
        logger.setLevel(level)
