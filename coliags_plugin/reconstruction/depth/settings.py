"""Options of depth estimation."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator
from typing_extensions import Self

from coliags_plugin.core.settings import Settings
from coliags_plugin.reconstruction.structure.features import FeatureSettings

Positive = Annotated[float, Field(gt=0.0)]


class SweepSettings(Settings):
    """Options of one sweep: matching and aggregation."""

    reduction: int = Field(default=1, ge=1, le=8, description="Factor by which images are reduced.")
    step: float = Field(default=0.03, gt=0.0, lt=0.5, description="Relative difference of neighbouring hypotheses.")
    reach: float | None = Field(
        default=None,
        gt=0.0,
        lt=1.0,
        description="Relative depth about the depth of the sweep before that is swept. None: the whole depth range.",
    )
    baselines: tuple[Positive, ...] = Field(
        default=(0.05, 0.08, 0.12, 0.16, 0.2, 0.25),
        min_length=1,
        description="Distances of the neighbours from a frame, in units of its median depth; one frame to either side "
        "in the video for each.",
    )
    radius: int = Field(default=3, ge=1, le=15, description="Half the width of the correlation windows, pixels.")
    small_penalty: float = Field(
        default=0.08, ge=0.0, description="Semi-global penalty P1 of a change by one hypothesis; costs are in [0, 2]."
    )
    large_penalty: float = Field(default=1.0, ge=0.0, description="Semi-global penalty P2 of a greater change.")


class DepthEstimationSettings(Settings):
    """Options of depth estimation."""

    max_baseline: float = Field(default=0.6, gt=0.0, description="Largest distance of a neighbour.")
    max_turn: float = Field(
        default=40.0, gt=0.0, le=180.0, description="Largest angle between the optical axes of neighbours, degrees."
    )
    best_share: float = Field(
        default=0.75, gt=0.0, le=1.0, description="Part of the neighbours that counts at a pixel: the best-matching."
    )
    noise: float = Field(
        default=0.01,
        gt=0.0,
        description="Standard deviation of the noise of log intensity, below which nothing matches.",
    )
    edge_contrast: float = Field(
        default=10.0, ge=0.0, description="How much edges of the log image lower the large penalty."
    )
    sweeps: tuple[SweepSettings, ...] = Field(
        default=(
            SweepSettings(reduction=2, radius=4),
            SweepSettings(
                step=0.01, reach=0.15, baselines=(0.05, 0.1, 0.2, 0.3, 0.4, 0.5), radius=2, small_penalty=0.01
            ),
        ),
        min_length=1,
        description="Sweeps, one after the other; each but the first is about the completed depth of the one before, "
        "smoothed.",
    )
    agreement: float = Field(
        default=0.02, gt=0.0, lt=0.5, description="Relative difference up to which two frames' depths agree."
    )
    features: FeatureSettings = Field(
        default=FeatureSettings(), description="Features that the depth range is found from, and highlights."
    )

    @model_validator(mode="after")
    def _first_sweep_is_whole(self) -> Self:
        if self.sweeps[0].reach is not None:
            raise ValueError(f"sweeps: the first has reach {self.sweeps[0].reach:g}: it has no depth to be near to")
        return self
