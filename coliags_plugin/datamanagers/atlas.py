"""The record of a video's sub-maps beside its COLMAP models: ``atlas.json`` (docs/poses.md 9.4)."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ConfigDict

from coliags_plugin.core.settings import read_validated
from coliags_plugin.datamanagers.scene_settings import Unit, read_unit

#: Name of the file, in the scene's folder.
ATLAS_FILE = "atlas.json"
_EXPECTED = "what `coliags poses sfm` wrote"


class _Part(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True)


class AtlasStretch(_Part):
    """Frames, by number, of one model between two places at which few points are seen from both sides."""

    model: str  # folder of the model, relative to the scene
    unit: Unit  # of the model
    frames: list[int]


class AtlasJoin(_Part):
    """A place between two stretches."""

    after: int  # last frame before it
    joined: bool  # whether both sides are of one model
    reason: str


class LostFrame(_Part):
    """A frame without a pose."""

    frame: int
    reason: str


class AtlasRecord(_Part):
    """Which frames of a video have a pose, in which models, and why the others have none."""

    frames: list[str]  # names of the images in order: frames are numbered from 0
    submaps: list[AtlasStretch]
    joins: list[AtlasJoin]
    lost: list[LostFrame]


def read_atlas(scene: Path) -> AtlasRecord | None:
    """Read a scene's ``atlas.json``; None if it has none."""
    file = scene / ATLAS_FILE
    if not file.is_file():
        return None
    return read_validated(AtlasRecord, file, _EXPECTED)


def model_unit(scene: Path, model: Path, atlas: AtlasRecord | None) -> Unit:
    """Unit of length of one of a scene's models: from its atlas if that lists the model, else from ``unit.txt``.

    COLMAP's own models are of an arbitrary scale: unknown where neither states it.
    """
    units = {} if atlas is None else {scene / stretch.model: stretch.unit for stretch in atlas.submaps}
    return units.get(model) or read_unit(scene)
