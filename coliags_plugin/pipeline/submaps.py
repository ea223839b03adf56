"""Models of a posed scene that are reconstructed each by itself."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from coliags_plugin.datamanagers.colmap.files import find_models
from coliags_plugin.geometry.poses import colmap


@dataclass(frozen=True)
class Submap:
    """A model of a scene. The first, number 0, is the largest that structure from motion has found."""

    number: int = 0
    model: str | None = None  # its folder, relative to the scene; None: the only one, which the data manager finds
    frames: int | None = None  # that have a pose in it; None: not counted, as it is the only one

    @property
    def folder(self) -> str:
        """Folder of its results, relative to the reconstruction's; empty for the first."""
        return f"submap-{self.number}" if self.number else ""

    @property
    def title(self) -> str:
        """What messages call it."""
        return f"sub-map {self.number}"


LARGEST = Submap()


def find_submaps(scene: Path, least: int) -> list[Submap]:
    """The first model of a scene in COLMAP's layout, and the others that have ``least`` frames or more."""
    models = [folder for folder in find_models(scene) if folder.name.isdecimal()]
    if len(models) < 2:
        return [LARGEST]
    counts = [len(colmap.read(folder).camera_to_world) for folder in models]
    return [
        Submap(number, folder.relative_to(scene).as_posix(), count)
        for number, (folder, count) in enumerate(zip(models, counts, strict=True))
        if number == 0 or count >= least
    ]
