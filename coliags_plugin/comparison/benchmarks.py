"""Benchmarks: named lists of scenes, with the options that their data are read with."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

from pydantic import Field, field_validator

from coliags_plugin.comparison.named_files import find_file, read_settings, shipped
from coliags_plugin.config import registry
from coliags_plugin.config.yaml_tree import dump
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.settings import Settings
from coliags_plugin.phantom.settings import PhantomSettings, phantom_settings

#: A scene's name is part of file names.
_NAME = re.compile(r"[\w.-]*\w")


class BenchmarkScene(Settings):
    """One scene of a benchmark: a folder of a dataset, or a phantom that is made when it is missing."""

    folder: str | tuple[str, ...] = Field(
        (), description="Folder in that of the benchmark's data, or names of which one is there; default: its name."
    )
    phantom: dict[str, Any] | None = Field(None, description="Settings of the phantom to make (docs/phantom.md 6).")
    format: str | None = Field(None, description="Data manager; default: the benchmark's.")
    options: dict[str, Any] = Field(default_factory=dict, description="Options of the data manager.")

    @field_validator("phantom")
    @classmethod
    def _valid_phantom(cls, options: dict[str, Any] | None) -> dict[str, Any] | None:
        if options is not None:
            try:
                phantom_settings(options)
            except InputError as error:
                raise ValueError(str(error)) from error
        return options

    def folders(self, name: str) -> tuple[str, ...]:
        """Names that the scene's folder may have, the first being the usual one."""
        return ((self.folder,) if isinstance(self.folder, str) else self.folder) or (name,)

    @property
    def phantom_settings(self) -> PhantomSettings | None:
        """The phantom's settings; None for a scene of a dataset."""
        return None if self.phantom is None else phantom_settings(self.phantom)


class BenchmarkSettings(Settings):
    """Content of a benchmark's file."""

    description: str  # one line
    format: str | None = None  # data manager of all scenes; null: recognised from the files
    split: str | None = None  # of all scenes; null: the data manager's
    options: dict[str, Any] = Field(default_factory=dict)  # options of the data manager, for all scenes
    scenes: dict[str, BenchmarkScene] = Field(min_length=1)  # by name

    @field_validator("scenes", mode="before")
    @classmethod
    def _empty_entries(cls, scenes: Any) -> Any:
        if not isinstance(scenes, dict):
            return scenes
        for name in scenes:
            if not _NAME.fullmatch(name):
                raise ValueError(f"scene name '{name}': expected letters, digits, dots, hyphens and underscores")
        return {name: {} if entry is None else entry for name, entry in scenes.items()}

    @field_validator("format")
    @classmethod
    def _known_format(cls, name: str | None) -> str | None:
        if name is not None:
            try:
                registry.datamanagers.get(name)
            except InputError as error:
                raise ValueError(str(error)) from error
        return name


@dataclass(frozen=True)
class Benchmark:
    """A benchmark by its name."""

    name: str
    settings: BenchmarkSettings

    def overrides(self, scene: str) -> tuple[str, ...]:
        """``key.path=value`` changes of a method config with which a scene is read."""
        entry = self.settings.scenes[scene]
        split = {} if self.settings.split is None else {"split": self.settings.split}
        options = {**split, **self.settings.options, **entry.options}
        return tuple(f"datamanager.{key}={_as_text(value)}" for key, value in options.items())


def load_benchmark(name: str) -> Benchmark:
    """Read a shipped benchmark by its name, or a YAML file."""
    path = find_file(name, shipped(), "benchmark")
    return Benchmark(path.stem, read_settings(path, BenchmarkSettings, "benchmark"))


def _as_text(value: Any) -> str:
    """A value as it is written behind ``--set key=``."""
    return dump([value]).strip()[1:-1] if not isinstance(value, (dict, list, tuple)) else dump(value).strip()
