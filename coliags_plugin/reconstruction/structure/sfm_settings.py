"""Options of structure from motion."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator
from typing_extensions import Self

from coliags_plugin.core.settings import Settings
from coliags_plugin.reconstruction.structure.features import FeatureSettings


class CameraSettings(Settings):
    """Camera model and initial intrinsics, shared by all images."""

    model: str | None = Field(
        default=None,
        description="COLMAP camera model, for instance OPENCV_FISHEYE; or a calibrated camera, scaled to the images: "
        "c3vd, c3vd-undistorted, or that of a calibration file, NAME.xml. None: SIMPLE_RADIAL_FISHEYE and "
        "SIMPLE_RADIAL are tried.",
    )
    params: tuple[float, ...] | None = Field(
        default=None,
        description="The model's parameters, in COLMAP's order; pixels, pixel centres at integers + 0.5. None: "
        "estimated, or those of the calibrated camera.",
    )
    refine: bool | None = Field(
        default=None, description="Whether focal length and distortion are refined. None: if they are not known."
    )
    focal_factors: tuple[float, ...] = Field(
        default=(0.75, 0.5),
        min_length=1,
        description="Initial focal lengths to try, relative to the image's larger side, the most likely first, "
        "which alone is tried of SIMPLE_RADIAL where the camera model is unknown too. Endoscopes have 0.4 to 1.2.",
    )
    field_of_view: tuple[float, float] = Field(
        default=(40.0, 150.0),
        description="Plausible nominal fields of view, degrees: of the image's larger side, 2 atan(side / 2f), or "
        "side / f of a fisheye. A model with another one is refused.",
    )

    @model_validator(mode="after")
    def _ranges(self) -> Self:
        if self.params is not None and self.model is None:
            raise ValueError("parameters (--params) without their camera model (--camera)")
        if not min(self.focal_factors) > 0.0:
            raise ValueError(f"focal_factors = {self.focal_factors}: they must be positive")
        if not 0.0 < self.field_of_view[0] < self.field_of_view[1] < 180.0:
            raise ValueError(f"field_of_view = {self.field_of_view}: two ascending angles between 0 and 180 degrees")
        return self


class TrackSettings(Settings):
    """Options of point tracks."""

    side: int = Field(
        default=384, ge=64, description="Larger side of the images that are tracked, pixels; larger ones are reduced."
    )
    corners: int = Field(default=1400, ge=100, description="Number of points followed, topped up in every frame.")
    spacing: int = Field(default=6, ge=2, description="Least distance of a new corner from other points, pixels.")
    bridge_below: int = Field(
        default=150,
        ge=0,
        description="Where fewer points survive, those lost are searched for again in the next frames; 0: never.",
    )
    longest_window: int = Field(
        default=400,
        ge=8,
        description="Largest number of frames mapped together; longer videos are cut where few points are followed.",
    )


class SfmSettings(Settings):
    """Options of matching and incremental mapping."""

    camera: CameraSettings = CameraSettings()
    """Camera model and initial intrinsics, shared by all images."""
    features: FeatureSettings = FeatureSettings(max_features=6000, peak_threshold=0.002)
    """Feature extraction."""
    matching: Literal["auto", "tracks", "features"] = Field(
        default="auto",
        description="What is matched: points tracked from frame to frame through a video, or SIFT features. auto: "
        "features where neighbouring images have plenty of them in common, and where tracks do not hold either.",
    )
    tracks: TrackSettings = TrackSettings()
    """Tracking of points."""
    features_at_most: int = Field(
        default=300,
        ge=2,
        description="Largest number of images of which features are matched: of more, the sharpest of every n.",
    )
    exhaustive_up_to: int = Field(default=25, ge=0, description="Up to this many images are matched exhaustively.")
    min_alike: int = Field(
        default=12,
        ge=1,
        description="Images further apart than two are matched if at least this many of their largest features match.",
    )
    max_ratio: float = Field(default=0.8, gt=0.0, le=1.0, description="Largest ratio in Lowe's ratio test.")
    max_distance: float = Field(
        default=0.7, gt=0.0, le=2.0, description="Largest L2 distance between matched unit-length descriptors."
    )
    max_error: float = Field(
        default=4.0, gt=0.0, description="RANSAC inlier threshold of two-view geometric verification, pixels."
    )
    min_model_size: int = Field(default=3, ge=2, description="Least number of registered images of a model.")
    search_images: int = Field(
        default=24,
        ge=3,
        description="An unknown camera is chosen on this many images from the middle of the video; with tracks, from "
        "the middle of each of the three largest models.",
    )
    seed: int = Field(default=0, ge=0, description="Seed of COLMAP's random samples.")
