"""Ablations: named variants of a method in one file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import Field, field_validator, model_validator
from typing_extensions import Self

from coliags_plugin.comparison.cells import Variant
from coliags_plugin.comparison.named_files import find_file, is_path, read_settings, shipped
from coliags_plugin.core.settings import Settings

#: Folder of the shipped ones, beside the benchmarks.
ABLATIONS = "ablations"


class VariantEntry(Settings):
    """One variant: a method, with changes."""

    method: str | None = None  # name or path of a method config; null: the ablation's base
    set: tuple[str, ...] = ()  # key.path=value changes of it


class AblationSettings(Settings):
    """Content of an ablation's file."""

    description: str  # one line
    base: str | None = None  # method of the variants that name none
    variants: dict[str, VariantEntry] = Field(min_length=1)  # by name

    @field_validator("variants", mode="before")
    @classmethod
    def _short_forms(cls, variants: Any) -> Any:
        """A bare name is a method; a list is changes of the base; nothing is the base."""
        if not isinstance(variants, dict):
            return variants
        return {name: _full(entry) for name, entry in variants.items()}

    @model_validator(mode="after")
    def _base_where_needed(self) -> Self:
        without = [name for name, entry in self.variants.items() if entry.method is None]
        if self.base is None and without:
            raise ValueError(f"variant '{without[0]}' names no method, and there is no base")
        return self


def load_ablation(name: str) -> list[Variant]:
    """The variants of a shipped ablation, or of a YAML file, whose methods are names, or paths relative to it."""
    path = find_file(name, shipped(ABLATIONS), "ablation")
    settings = read_settings(path, AblationSettings, "ablation")
    return [
        Variant(title, _method(entry.method or settings.base or "", path.parent), entry.set)
        for title, entry in settings.variants.items()
    ]


def _full(entry: Any) -> Any:
    if entry is None:
        return {}
    if isinstance(entry, str):
        return {"method": entry}
    return {"set": entry} if isinstance(entry, tuple) else entry


def _method(method: str, folder: Path) -> str:
    return str((folder / method).resolve()) if is_path(method) else method
