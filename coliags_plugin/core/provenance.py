"""Origin of a scene: what data managers record of it, and what results and messages are made of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict

from coliags_plugin.core.json_files import JsonObject


class _Record(BaseModel):
    """Frozen facts; those that were not set are not written."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class SplitRecord(_Record):
    """Split of the frames into training and test frames, and the options that chose it."""

    name: str
    frame_step: int = 1
    max_frames: int | None = None
    block: tuple[float, float] = (0.4, 0.6)  # start and end as fractions of the video; set for split 'block' only
    train: list[str] = []  # names of frames
    test_sets: dict[str, list[str]] = {}


class PointsRecord(_Record):
    """Origin of the initial points."""

    source: str
    count: int = 0
    seed: int | None = None
    sha256: str | None = None  # of the source, if it is a file


class Provenance(_Record):
    """Origin of a scene's data: format, camera, unit, split, fingerprint; no places on this machine.

    Formats add facts of their own, which are recorded but not interpreted.
    """

    model_config = ConfigDict(extra="allow", frozen=True)

    dataset: str = "unknown"  # data manager that read it
    layout: str | None = None
    unit: Literal["mm", "unknown"] = "mm"  # of lengths of the loaded scene
    lens: str | None = None  # of the stored images; None: pinholes
    stored_size: tuple[int, int] | None = None  # width and height of the stored images, pixels
    size: tuple[int, int] | None = None  # of the images as they are used
    pose_convention: str | dict[str, Any] | None = None
    observations: int = 0  # of points in images, of a sparse model
    misplaced_observations: int = 0  # those that are not where the poses project the points
    fingerprint: str = ""  # hash of the files
    split: SplitRecord | None = None
    points: PointsRecord = PointsRecord(source="unknown")
    #: Test frames that "depth" or "points" were made from, by name; None where it is unknown which.
    held_out_used: dict[str, list[str] | None] = {}
    frames: dict[str, int] = {}  # number of frames, in the sequence and by part
    training_scale: float = 1.0  # factor on lengths during training

    def record(self) -> JsonObject:
        """The facts that were set, as they are written to JSON files."""
        return self.model_dump(mode="json", exclude_unset=True)

    @property
    def split_name(self) -> str:
        """Name of the split; empty where it is unknown."""
        return "" if self.split is None else self.split.name


def held_out_uses(used: Mapping[str, Sequence[str] | None]) -> list[str]:
    """Sentences on the test frames that were used before the evaluation, from :attr:`Provenance.held_out_used`."""
    return [
        f"its {what} may come from images of held-out frames, as it is not recorded which it was made from"
        if names is None
        else f"its {what} comes from images of {len(names)} held-out frames too, whose scores are too good for that"
        for what, names in used.items()
    ]
