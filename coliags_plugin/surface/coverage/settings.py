"""Settings of the measurement of coverage."""

from __future__ import annotations

import math

from pydantic import Field

from coliags_plugin.core.settings import Settings


class CoverageSettings(Settings):
    """What counts as seen, and which missed regions are listed. Lengths are mm."""

    max_distance: float = Field(default=100.0, gt=0.0)  # farthest z-depth at which surface counts as seen, mm
    far: float = Field(default=60.0, gt=0.0)  # surface that no frame shows from nearer is seen too far away, mm
    dark: float = Field(default=0.12, ge=0.0, le=1.0)  # grey value below which a pixel is too dark to judge the surface
    # Angle to the surface's normal above which it is only glanced at, degrees.
    grazing: float = Field(default=75.0, gt=0.0, le=90.0)
    # Fewest frames that show a surface well; with fewer it is seen only at a glance.
    glance_frames: int = Field(default=3, ge=1)
    # Diameter of the circle of the smallest missed area that is listed, mm.
    region_diameter: float = Field(default=5.0, gt=0.0)
    # Most viewing rays per frame. Images with fewer pixels get 2 x 2 rays a pixel, larger ones are sampled more
    # coarsely.
    rays: int = Field(default=150_000, ge=1000)

    @property
    def region_area(self) -> float:
        """Area of the smallest missed region that is listed, mm^2."""
        return 0.25 * math.pi * self.region_diameter**2
