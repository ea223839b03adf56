"""Settings of a reconstruction from frames."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from coliags_plugin.core.settings import Settings
from coliags_plugin.reconstruction.depth.sweeping import DepthEstimationSettings
from coliags_plugin.reconstruction.structure.sfm_settings import SfmSettings
from coliags_plugin.surface.coverage.visibility import CoverageSettings
from coliags_plugin.surface.meshing.views import MeshSettings

#: Fewest frames that can give depth (docs/depth.md 6).
FEWEST = 4
Pixels = Annotated[int, Field(gt=0)]


class FrameSettings(Settings):
    """Choice of the frames of a video that are used."""

    first: int = Field(default=0, ge=0)  # number of the first frame in the video, counted from 0
    last: int | None = Field(default=None, ge=0)  # number of the last frame; None: of the video
    # Whether of every frame one field is kept, and the rows of the other interpolated. None: where the video is flagged
    # as interlaced, or looks so.
    deinterlace: bool | None = None
    every: int = Field(default=1, ge=1)  # use the sharpest of every n frames
    # Use the sharpest of every 1/n s by the frames' times, which are `every` apart in the mean: for a variable rate.
    per_second: float | None = Field(default=None, gt=0.0)
    # Largest number of frames of use that are posed together; a longer video is cut into segments.
    segment: int = Field(default=1500, ge=50)
    # Frames less sharp than this share of the median of their neighbours are blurred: points are followed through them,
    # but depth and training do without them; 0: none.
    least_sharpness: float = Field(default=0.5, ge=0.0, lt=1.0)
    # Frames in which the image has moved by less than this share of its larger side since the last frame kept are
    # dropped, as the scope rests; 0: none.
    least_motion: float = Field(default=0.0015, ge=0.0)


class ReconstructionSettings(Settings):
    """Settings of all stages."""

    frames: FrameSettings = FrameSettings()  # choice of the frames
    sfm: SfmSettings = SfmSettings()  # structure from motion, with the camera
    diameter: float | None = Field(default=None, gt=0.0)  # the colon's inner diameter, mm; None: unit unknown
    least_submap: int = Field(default=12, ge=FEWEST)  # fewest frames of a further model beside the largest
    depth: DepthEstimationSettings = DepthEstimationSettings()  # estimation of dense depth
    # Width and height of the images that depth is estimated from and training sees, pixels. None: what fits 338 x 270.
    size: tuple[Pixels, Pixels] | None = None
    method: str = "coliags-plus"  # method to train
    # Training steps of 100 frames; a model of other size gets more or fewer in proportion, at most twice as many, at
    # least a quarter, the largest model at least these.
    steps: int = Field(default=2000, ge=1)
    mesh: MeshSettings = MeshSettings()  # fusion of the rendered depth into a mesh
    coverage: CoverageSettings = CoverageSettings()  # limits within which wall counts as seen well
    seed: int = Field(default=0, ge=0)  # seed of training
