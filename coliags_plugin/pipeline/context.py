"""Folder of a reconstruction, with what its stages share."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from coliags_plugin.core.progress import Progress
from coliags_plugin.pipeline.settings import ReconstructionSettings

if TYPE_CHECKING:
    import torch

    from coliags_plugin.core.scenes import Frame, Scene


@dataclass(frozen=True)
class StageContext:
    """What every stage is given."""

    out: Path  # the reconstruction's folder
    source: Path  # the video, folder of images or scene
    settings: ReconstructionSettings
    mask: Path | None  # image that is black where pixels are ignored; None: found from the frames
    data_format: str | None  # of a source that is a scene; None: it is none
    device: torch.device
    progress: Progress | None = None
    anonymous: bool = False  # keep absolute paths out of what is written

    @property
    def frames(self) -> Path:
        """Frames of use."""
        return self.out / "frames"

    @property
    def posed(self) -> Path:
        """Scene with poses: of structure from motion, or the source."""
        return self.source if self.data_format is not None else self.out / "poses"

    @property
    def estimated(self) -> Path:
        """Scene with estimated depth."""
        return self.out / "depth"

    @property
    def run(self) -> Path:
        """The trained run."""
        return self.out / "run"

    def open_posed(self, stored_size: bool = False) -> Scene:
        """The posed scene at the working size, its images read when they are needed."""
        from coliags_plugin.engine.data_formats import open_scene

        size = self.settings.size
        options = ["initial_points=none", "keep_pixels=false"]
        options += [] if size is None else [f"width={size[0]}", f"height={size[1]}"]
        return open_scene(self.posed, self.data_format, options, self.progress, stored_size)

    @property
    def scene(self) -> Path:
        """Scene to train on."""
        return self.estimated if self.estimates_depth else self.posed

    @cached_property
    def estimates_depth(self) -> bool:
        """Whether depth has to be estimated: the source is no scene, or one without dense depth."""
        return self.data_format is None or self._first_frame.depth is None

    @cached_property
    def has_estimates(self) -> bool:
        """Whether the source is a scene with estimated depth."""
        return not self.estimates_depth and self._first_frame.depth_confidence is not None

    @cached_property
    def _first_frame(self) -> Frame:
        return self.open_posed().train[0]
