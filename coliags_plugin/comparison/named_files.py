"""Benchmarks and ablations: lists of scenes, and of variants of a method, in YAML files; shipped ones by name."""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import AfterValidator, Field, field_validator, model_validator
from typing_extensions import Self

from coliags_plugin.config.method_config import BENCHMARKS, is_path, is_text, method_files, method_folder, method_name
from coliags_plugin.config.yaml_tree import at_origins, dump_inline, read_tree
from coliags_plugin.core import registry
from coliags_plugin.core.errors import InputError, check_name, did_you_mean
from coliags_plugin.core.files import user_path
from coliags_plugin.core.settings import Settings
from coliags_plugin.phantom.settings import PhantomSettings

#: Folder of the shipped ablations, beside the benchmarks.
ABLATIONS = "ablations"
#: A scene's name is part of file names.
_NAME = re.compile(r"[\w.-]*\w")

_Settings = TypeVar("_Settings", bound=Settings)


def shipped(folder: str = "") -> dict[str, Path]:
    """Files of benchmarks, or of the ablations in their folder, by name."""
    files = {path.stem: path for path in (method_folder() / BENCHMARKS / folder).glob("*.yaml")}
    return dict(sorted(files.items()))


def _read_file(name: str, folder: str, content: type[_Settings], noun: str) -> tuple[Path, _Settings]:
    """Path and validated content of a shipped file by its name, or of a user's own by its path."""
    files = shipped(folder)
    if not is_path(name) and name not in files:
        raise InputError(f"no {noun} '{name}'", f"one of {', '.join(files)}, or a YAML file", did_you_mean(name, files))
    path = user_path(name) if is_path(name) else files[name]
    tree = read_tree(path)
    with at_origins(tree, noun):
        return path, content.model_validate(tree.plain())


def _known(name: str) -> str:
    try:
        registry.datamanagers.get(name)
    except InputError as error:
        raise ValueError(str(error)) from error
    return name


_DataFormat = Annotated[str, AfterValidator(_known)]


class BenchmarkScene(Settings):
    """One scene of a benchmark: a folder of a dataset, or a phantom that is made when it is missing."""

    folder: str | tuple[str, ...] = Field(
        (), description="Folder in that of the benchmark's data, or names of which one is there; default: its name."
    )
    phantom: PhantomSettings | None = Field(None, description="The phantom to make (docs/phantom.md 6).")
    format: _DataFormat | None = Field(None, description="Data manager; default: the benchmark's.")
    options: dict[str, Any] = Field(default_factory=dict, description="Options of the data manager.")

    def folders(self, name: str) -> tuple[str, ...]:
        """Names that the scene's folder may have, the first being the usual one."""
        return ((self.folder,) if isinstance(self.folder, str) else self.folder) or (name,)


class Benchmark(Settings):
    """Content of a benchmark's file."""

    description: str  # one line
    format: _DataFormat | None = None  # data manager of all scenes; null: recognised from the files
    split: str | None = None  # split of all scenes; null: the data manager's
    options: dict[str, Any] = Field(default_factory=dict)  # options of the data manager, for all scenes
    scenes: dict[str, BenchmarkScene] = Field(min_length=1)  # scenes by name

    @field_validator("scenes", mode="before")
    @classmethod
    def _empty_entries(cls, scenes: Any) -> Any:
        if not isinstance(scenes, dict):
            return scenes
        for name in scenes:
            if not _NAME.fullmatch(name):
                raise ValueError(f"scene name '{name}': expected letters, digits, dots, hyphens and underscores")
        return {name: {} if entry is None else entry for name, entry in scenes.items()}

    def overrides(self, scene: str) -> tuple[str, ...]:
        """``key.path=value`` changes of a method config with which a scene is read."""
        split = {} if self.split is None else {"split": self.split}
        options = {**split, **self.options, **self.scenes[scene].options}
        return tuple(f"datamanager.{key}={dump_inline(value)}" for key, value in options.items())


def load_benchmark(name: str) -> Benchmark:
    """Read a shipped benchmark by its name, or a YAML file."""
    return _read_file(name, "", Benchmark, "benchmark")[1]


@dataclass(frozen=True)
class Variant:
    """A column of the comparison: a method with changes, under a name."""

    name: str  # in tables and file names
    method: str  # its name, or the path of a method config
    overrides: tuple[str, ...] = ()  # ``key.path=value`` changes of it


class VariantEntry(Settings):
    """One variant: a method, with changes."""

    method: str | None = None  # name or path of a method config; null: the ablation's base
    set: tuple[str, ...] = ()  # key.path=value changes of it, or lists of them

    @field_validator("set", mode="before")
    @classmethod
    def _joined_lists(cls, changes: Any) -> Any:
        """Flatten lists among the changes, such as the anchored one of another variant, by one level."""
        if not isinstance(changes, tuple):
            return changes
        return tuple(chain.from_iterable(entry if isinstance(entry, tuple) else (entry,) for entry in changes))


class AblationSettings(Settings):
    """Content of an ablation's file."""

    description: str  # one line
    base: str | None = None  # method of the variants that name none
    variants: dict[str, VariantEntry] = Field(min_length=1)  # variants by name

    @field_validator("variants", mode="before")
    @classmethod
    def _short_forms(cls, variants: Any) -> Any:
        """A bare name is a method; a list is changes of the base; nothing is the base."""
        if not isinstance(variants, dict):
            return variants
        keys: dict[type, str] = {str: "method", tuple: "set"}
        full = {name: {} if entry is None else entry for name, entry in variants.items()}
        return {name: {keys[type(entry)]: entry} if type(entry) in keys else entry for name, entry in full.items()}

    @model_validator(mode="after")
    def _base_where_needed(self) -> Self:
        without = [name for name, entry in self.variants.items() if entry.method is None]
        if self.base is None and without:
            raise ValueError(f"variant '{without[0]}' names no method, and there is no base")
        return self


def variants_of(name: str) -> list[Variant]:
    """The variants of an ablation, or a method alone; both by name, or by the path of a YAML file, or as its text.

    Raises:
        InputError: There is no such file or name, a method has the name of an ablation, or variants are not valid.
    """
    ablations, methods, is_ablation = shipped(ABLATIONS), method_files(), False
    if is_path(name):
        is_ablation = "variants" in read_tree(user_path(name)).value
    elif not is_text(name):
        check_name("method or ablation", name, sorted([*methods, *ablations]))
        is_ablation = name in ablations
        if is_ablation and name in methods:
            raise InputError(f"'{name}' is a method and an ablation", "one of them", f"Give its file, {methods[name]}")
    return load_ablation(name) if is_ablation else [Variant(method_name(name), name)]


def load_ablation(name: str) -> list[Variant]:
    """The variants of a shipped ablation, or of a YAML file, whose methods are names, or paths relative to it."""
    path, settings = _read_file(name, ABLATIONS, AblationSettings, "ablation")
    variants = []
    for title, entry in settings.variants.items():
        method = entry.method or settings.base or ""
        variants.append(Variant(title, str((path.parent / method).resolve()) if is_path(method) else method, entry.set))
    return variants
