"""The record of a procedure: its video, segments, what was left out, and joins (``procedure.json``)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float
from pydantic import BaseModel, ConfigDict, Field, model_validator
from typing_extensions import Self

from coliags_plugin._version import __version__
from coliags_plugin.core.files import write_json
from coliags_plugin.pipeline.procedure.segments import Segment, Skipped, Stretch
from coliags_plugin.pipeline.stages import FORMAT, read_record

#: Name of the file.
PROCEDURE_FILE = "procedure.json"
#: Most frames of a video: a day at 60 a second.
_MOST_FRAMES = 6_000_000
#: Error of a rotation matrix in double precision that is written as JSON.
_SKEW = 1e-4

Row = Annotated[list[float], Field(min_length=4, max_length=4)]
#: A model of a segment: the segment's name, and the model's folder relative to the segment's scene.
ModelKey = tuple[str, str]


class _Part(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True, allow_inf_nan=False)


class SegmentJoin(_Part):
    """What came out where the models of two segments were compared."""

    segments: tuple[str, str]
    models: tuple[str, str]  # folders, relative to the segments' scenes; empty where a side has none
    frames: int  # posed in both
    joined: bool
    reason: str = ""  # why not
    #: similarity from the world of the second to that of the first; None where they are not joined. [4][4]
    transform: Annotated[list[Row], Field(min_length=4, max_length=4)] | None = None
    rotation_deg: float | None = None  # residual of the shared frames, degrees
    position: float | None = None  # residual of their positions, relative to the median depth

    @model_validator(mode="after")
    def _transform_of_joined(self) -> Self:
        if self.joined and (self.transform is None or not _is_similarity(np.array(self.transform))):
            raise ValueError("'transform' is no similarity, though 'joined' is true")
        return self

    @property
    def keys(self) -> tuple[ModelKey, ModelKey]:
        """The two models."""
        first, second = zip(self.segments, self.models, strict=True)
        return first, second


class Procedure(_Part):
    """A video and its segments; numbers of frames are those of the video."""

    source: Annotated[list[str], Field(min_length=1)]  # names of the video's files, or of the folder
    bytes: int  # their size, to notice that it is another one
    rate: Annotated[float, Field(gt=0.0, lt=1e4)] | None  # frames a second; None: unknown
    frames: Annotated[int, Field(gt=0, lt=_MOST_FRAMES)]  # that were looked at
    size: tuple[int, int]  # width and height, pixels
    first: Annotated[int, Field(ge=0, lt=_MOST_FRAMES)]  # at which the survey began
    options: dict[str, Any]  # of cutting
    seek: bool  # whether frames are found by their number
    deinterlace: bool  # whether they were read so
    segments: Sequence[Segment]
    skipped: Sequence[Skipped]
    joins: Sequence[SegmentJoin]

    @model_validator(mode="after")
    def _within_the_video(self) -> Self:
        stretches: list[Stretch] = [*self.segments, *self.skipped]
        for one in stretches:
            if not self.first <= one.first <= one.last < self.stop:
                raise ValueError(f"frames {one.first} to {one.last}, not of {self.first} to {self.stop - 1}")
        if len({segment.name for segment in self.segments}) < len(self.segments):
            raise ValueError("two segments have the same name")
        return self

    @property
    def stop(self) -> int:
        """Number of the last frame that was looked at, plus one."""
        return self.first + self.frames

    def write(self, folder: Path) -> None:
        """Write ``procedure.json``."""
        write_json(folder / PROCEDURE_FILE, {"format": FORMAT, "version": __version__, **self.model_dump(mode="json")})

    @classmethod
    def read(cls, folder: Path) -> Procedure | None:
        """Read ``procedure.json``; None without one."""
        file = folder / PROCEDURE_FILE
        if not file.is_file():
            return None
        return read_record(file, lambda text, _: cls.model_validate_json(text, strict=True))


def _is_similarity(matrix: Float[np.ndarray, "4 4"]) -> bool:
    """Whether a matrix turns, scales and moves, and mirrors nothing."""
    linear = matrix[:3, :3]
    scale = float(np.cbrt(np.linalg.det(linear)))
    if not (1e-9 < scale < 1e9 and np.array_equal(matrix[3], (0.0, 0.0, 0.0, 1.0))):
        return False
    turn = linear / scale
    return bool(np.abs(turn @ turn.T - np.eye(3)).max() < _SKEW)
