"""Options of RGB-D odometry."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from coliags_plugin.core.settings import Settings

Method = Literal["auto", "hybrid", "point-to-plane", "intensity"]


class TrackingSettings(Settings):
    """Options of RGB-D odometry; lengths are relative to the video's median depth."""

    method: Method = Field(
        "auto",
        description="Residual of pairwise registration. 'hybrid': depth and brightness; robust to noisy depth. "
        "'point-to-plane': depth alone; several times more accurate with exact depth, far worse otherwise. "
        "'intensity': brightness alone. 'auto': point-to-plane if a few test pairs indicate exact depth and similar "
        "brightness correlation, else hybrid.",
    )
    enlarge: int = Field(
        1,
        ge=1,
        le=4,
        description="Upsampling factor for registration. open3d compares a pixel with the nearest pixel of the other "
        "image; 2 halves that rounding error and takes four times as long.",
    )
    min_fitness: float = Field(
        0.2, gt=0.0, lt=1.0, description="Least share of a frame's pixels that are inliers on the other's surface."
    )
    min_correlation: float = Field(
        0.5,
        gt=0.0,
        lt=1.0,
        description="Least correlation of normalised brightness between registered frames. Correct motions have 0.7 "
        "to 0.95 on phantoms, wrong ones less than 0.5; lower it for noisy images.",
    )
    max_gap: int = Field(
        8, ge=1, description="Largest number of consecutive lost frames before tracking restarts at a guessed pose."
    )
    pose_graph: bool = Field(True, description="Whether to optimise a pose graph with further edges.")
    skips: tuple[Annotated[int, Field(ge=2)], ...] = Field(
        (2, 4, 8), description="Frame distances of the pose graph's further edges."
    )
    revisits: bool = Field(True, description="Whether to add loop-closure edges between frames at similar poses.")
    prune: float = Field(
        0.25, ge=0.0, le=1.0, description="Weight below which the optimisation drops a further edge as an outlier."
    )
