"""Options shared by all data managers: working size, unit of length, split and initial points."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator
from typing_extensions import Self

from coliags_plugin.core.scene_files import Unit
from coliags_plugin.core.settings import Settings
from coliags_plugin.core.splits import Split

POINTS_FILE = "points3D.ply"
Share = Annotated[float, Field(ge=0.0, le=1.0)]
InitialPoints = Literal["depth", "data", "file", "none"]


class SceneSettings(Settings):
    """Working size, split and initial points."""

    width: int | None = Field(
        None,
        gt=0,
        description="Working width, pixels. None: the format's own (docs/data.md 2), for most of them what fits 338 x "
        "270, the paper's quarter of a raw frame.",
    )
    height: int | None = Field(None, gt=0, description="Working height, pixels; goes with width.")
    unit: Unit | None = Field(
        None,
        description="Unit of length of the scene's files, 'mm', 'cm', 'm' or 'unknown'; known lengths are converted to "
        "mm. None: as stated by unit.txt, or else the format's.",
    )
    focal_scale: float = Field(
        1.0,
        gt=0.0,
        le=4.0,
        description="Factor on the nominal focal length of undistorted images; below 1 more of a wide field of view is "
        "kept.",
    )
    split: Split = Field(
        "every-8th",
        description="Test frames: 'every-8th': 0, 8, 16, ... as in the paper; 'inner-8th': 4, 12, 20, ... without the "
        "last frame; 'endogslam': 7, 15, 23, ...; 'block': one contiguous block of the video; 'all-train': none; "
        "'own': the dataset's own split. Counted after frame_step and max_frames.",
    )
    block: tuple[Share, Share] = Field(
        (0.4, 0.6), description="Split 'block': start and end of the block, as fractions of the video."
    )
    frame_step: int = Field(1, ge=1, description="Use every n-th frame of the video.")
    max_frames: int | None = Field(None, ge=1, description="Use at most the first n frames, after frame_step.")
    initial_points: InitialPoints = Field(
        "depth",
        description="Initial points: 'depth': fused from the training frames' depth, or the dataset's own if there is "
        "no depth; 'data': the dataset's own, or from depth if there are none; 'file': points_file; 'none': "
        "no points, to inspect a scene.",
    )
    points_file: str = Field(
        POINTS_FILE, description="PLY or NPZ for initial_points 'file', relative to the scene folder or absolute."
    )
    points_count: int = Field(200_000, ge=1, description="Largest number of initial points, sampled at random.")
    seed: int = Field(0, ge=0, description="Seed of the sampling of initial points.")
    outside_files: bool = Field(
        False,
        description="Whether files of the scene may name others outside of its folder, by absolute paths or '..'.",
    )
    keep_pixels: bool = Field(
        True,
        description="Whether to cache images in memory in the stored data type; otherwise they are read from disk at "
        "every access, which is slow, for videos larger than memory.",
    )

    @model_validator(mode="after")
    def _both_sides_or_none(self) -> Self:
        if (self.width is None) != (self.height is None):
            raise ValueError(f"width = {self.width} and height = {self.height}: give both or neither")
        return self

    @model_validator(mode="after")
    def _block_is_a_stretch(self) -> Self:
        if self.block[0] >= self.block[1]:
            raise ValueError(f"block = {self.block}: its start must be below its end")
        return self

    @property
    def size(self) -> tuple[int, int] | None:
        """Working width and height where they are set, pixels."""
        return None if self.width is None or self.height is None else (self.width, self.height)
