"""Options shared by all data managers: working size, unit of length, train/test split and initial points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal, cast, get_args

import numpy as np
from jaxtyping import Bool
from pydantic import Field, model_validator
from typing_extensions import Self

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_write
from coliags_plugin.core.settings import Settings
from coliags_plugin.core.text_files import read_text
from coliags_plugin.geometry.poses.formats import shortened

Unit = Literal["mm", "cm", "m", "unknown"]

#: Factors to the lengths of a loaded scene: mm, or the files' own where their unit is unknown.
FACTORS: dict[Unit, float] = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "unknown": 1.0}
#: The file that states the unit, in the scene's folder; without it the unit is that of the dataset's format.
UNIT_FILE = "unit.txt"


def read_unit(folder: Path, otherwise: Unit = "unknown") -> Unit:
    """The unit of the poses and depth of the scene in a folder; ``otherwise``: that of a folder that states none."""
    path = folder / UNIT_FILE
    if not path.is_file():
        return otherwise
    word = read_text(path, "the unit of length").strip()
    if word not in get_args(Unit):
        raise InputError(f"{path}: '{shortened(word)}'", " or ".join(get_args(Unit)), "Correct or remove the file")
    return cast(Unit, word)


def printed_unit(unit: Unit) -> str:
    """A unit as it is printed: ``units`` where it is unknown."""
    return "units" if unit == "unknown" else unit


def write_unit(folder: Path, unit: Unit) -> None:
    """State the unit of a scene's poses and depth."""
    atomic_write(folder / UNIT_FILE, unit + "\n")


Split = Literal["every-8th", "inner-8th", "endogslam", "block", "all-train", "own"]

EVERY = 8


def held_out(split: Split, count: int, block: tuple[float, float] = (0.4, 0.6)) -> Bool[np.ndarray, "N"]:
    """Mask of the test frames among ``count`` frames in video order.

    ``every-8th``: 0, 8, 16, ... (the paper, Gaussian Pancakes); ``inner-8th``: 4, 12, 20, ... without the last frame,
    so that every one is between training frames; ``endogslam``: 7, 15, 23, ... (EndoGSLAM, PR-Endo; docs/data.md 3);
    ``block``: one contiguous block, given by fractions of the video, so that test views are not between neighbouring
    training views; ``all-train``: none. ``own`` is handled by :func:`divide`.
    """
    index = np.arange(count)
    if split == "every-8th":
        return np.asarray(index % EVERY == 0)
    if split == "inner-8th":
        return np.asarray((index % EVERY == EVERY // 2) & (index < count - 1))
    if split == "endogslam":
        return np.asarray(index % EVERY == EVERY - 1)
    if split == "block":
        return np.asarray((index >= round(block[0] * count)) & (index < round(block[1] * count)))
    return np.zeros(count, bool)


def split_options(split: str, block: Sequence[float] = (0.4, 0.6)) -> list[str]:
    """Options of training that choose a split, none for ``every-8th``; ``block``: that of split ``block``."""
    chosen = [] if split == "every-8th" else [f"datamanager.split={split}"]
    return [*chosen, f"datamanager.block=[{block[0]:g}, {block[1]:g}]"] if split == "block" else chosen


def divide(
    split: Split,
    indices: Sequence[int],
    own_split: Mapping[str, Sequence[int]] | None = None,
    block: tuple[float, float] = (0.4, 0.6),
) -> tuple[list[int], list[int]]:
    """Training and test indices among the used frames of a video, given in video order.

    ``own_split`` is the dataset's split, ``{"train": ..., "test": ...}``, for split ``own``; the others are as for
    :func:`held_out`.
    """
    if split == "own":
        if own_split is None:
            raise ValueError("split 'own' needs the dataset's own split")
        used = set(indices)
        train, test = ([index for index in own_split[part] if index in used] for part in ("train", "test"))
        return train, test
    is_test = held_out(split, len(indices), block)
    train = [index for index, is_held in zip(indices, is_test, strict=True) if not is_held]
    return train, [index for index, is_held in zip(indices, is_test, strict=True) if is_held]


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
