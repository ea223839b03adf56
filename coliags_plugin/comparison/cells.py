"""Cells of a comparison: one method on one scene, with one split and one seed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any

from coliags_plugin.comparison.scenes import SceneSource
from coliags_plugin.config.method_config import MethodConfig

#: Digits of a key in names of files.
_SHORT = 8


@dataclass(frozen=True)
class Variant:
    """A column of the comparison: a method with changes, under a name.

    Attributes:
        name: In tables and file names.
        method: Name of a method, or path of a method config.
        overrides: ``key.path=value`` changes of it.
    """

    name: str
    method: str
    overrides: tuple[str, ...] = ()


@dataclass(frozen=True)
class CellKeys:
    """Hashes that identify a cell's scene, run and result; see :mod:`coliags_plugin.results.hashing`."""

    fingerprint: str
    training: str
    result: str


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
    keys: CellKeys | None  # None while the scene, a phantom, is not there

    @property
    def named(self) -> dict[str, Any]:
        """Scene, method, seed, protocol and key of its result, as records hold them."""
        return {
            "scene": self.scene_label,
            "method": self.variant.name,
            "seed": self.seed,
            "protocol": self.protocol,
            "key": self.known_keys.result,
        }

    @property
    def identity(self) -> tuple[str, str, int, str]:
        """What it is called: scene, method, seed, protocol."""
        return self.scene_label, self.variant.name, self.seed, self.protocol

    @property
    def steps(self) -> int:
        """Length of its training."""
        return self.config.schedule.steps

    @property
    def title(self) -> str:
        """For messages: scene, method and seed."""
        return f"{self.scene_label} {self.variant.name} seed {self.seed}"

    @property
    def known_keys(self) -> CellKeys:
        """Its keys."""
        if self.keys is None:
            raise ValueError(f"{self.title}: the scene is not there, so that it has no key")
        return self.keys

    @property
    def run_path(self) -> PurePosixPath:
        """Of the run, among runs: ``SCENE/METHOD/sSEED-KEY``; protocols share a run."""
        return self._path(self.known_keys.training)

    @property
    def result_path(self) -> PurePosixPath:
        """Of the result, among results, without suffix: ``SCENE/METHOD/sSEED-KEY``."""
        return self._path(self.known_keys.result)

    def _path(self, key: str) -> PurePosixPath:
        return PurePosixPath(self.scene_label, file_name(self.variant.name), f"s{self.seed}-{key[:_SHORT]}")


def file_name(variant: str) -> str:
    """A variant's name as part of a path: ``ablations/depth`` is ``ablations-depth``."""
    return variant.replace("/", "-")
