"""Options of tracking."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from coliags_plugin.core.settings import Settings

Method = Literal["auto", "hybrid", "point-to-plane", "intensity"]


class TrackingSettings(Settings):
    """How poses are found from pictures and depth; lengths are relative to the video's median depth."""

    method: Method = Field(
        "auto",
        description="What two frames are laid together by. 'hybrid': depth and brightness; holds up when depth is "
        "noisy. 'point-to-plane': depth alone; several times better where depth is exact, far worse where it is not. "
        "'intensity': brightness alone. 'auto': point-to-plane where a few pairs of frames show that depth is exact "
        "and brightness agrees, else hybrid.",
    )
    enlarge: int = Field(
        1,
        ge=1,
        le=4,
        description="Factor on the pictures' size while frames are laid together. open3d compares a pixel with the "
        "nearest one of the other picture; 2 halves what that errs by, and takes four times as long.",
    )
    min_fitness: float = Field(
        0.2, gt=0.0, lt=1.0, description="Smallest share of a frame that must meet the other's surface."
    )
    min_correlation: float = Field(
        0.5,
        gt=0.0,
        lt=1.0,
        description="Smallest correlation of normalised brightness between two frames laid together. Right motions "
        "have 0.7 to 0.95 on phantoms, wrong ones less than 0.5; lower it for pictures with much noise.",
    )
    max_gap: int = Field(
        8, ge=1, description="Frames that may be lost in a row before the camera is taken to be elsewhere."
    )
    pose_graph: bool = Field(True, description="Whether edges over several frames and revisits correct the path.")
    skips: tuple[Annotated[int, Field(ge=2)], ...] = Field(
        (2, 4, 8), description="Frames that the pose graph's further edges span."
    )
    revisits: bool = Field(
        True, description="Whether frames that the path says look at the same place again are laid together too."
    )
    prune: float = Field(
        0.25, ge=0.0, le=1.0, description="Edges that the optimised path contradicts below this confidence are dropped."
    )
