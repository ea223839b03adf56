"""Sub-maps of a reconstruction, and the context in which stages run: source, settings and folders."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from coliags_plugin.core.jobs import Progress
from coliags_plugin.datamanagers.colmap import find_models
from coliags_plugin.geometry.poses import colmap
from coliags_plugin.pipeline.frames import read_blurred
from coliags_plugin.pipeline.settings import ReconstructionSettings

if TYPE_CHECKING:
    import torch

    from coliags_plugin.core.scenes import Frame, Scene


@dataclass(frozen=True)
class Submap:
    """A model of a scene. The first, number 0, is the largest that structure from motion has found."""

    number: int = 0
    model: str | None = None  # its folder, relative to the scene; None: the only one, which the data manager finds
    frames: int | None = None  # that have a pose in it; None: not counted, as it is the only one

    @property
    def folder(self) -> str:
        """Folder of its results, relative to its segment's; empty for the first."""
        return f"submap-{self.number}" if self.number else ""


def find_submaps(scene: Path, least: int) -> list[Submap]:
    """The first model of a scene in COLMAP's layout, and the others that have ``least`` frames or more."""
    models = [folder for folder in find_models(scene) if folder.name.isdecimal()]
    if len(models) < 2:
        return [Submap()]
    counts = [len(colmap.read(folder).camera_to_world) for folder in models]
    return [
        Submap(number, folder.relative_to(scene).as_posix(), count)
        for number, (folder, count) in enumerate(zip(models, counts, strict=True))
        if number == 0 or count >= least
    ]


@dataclass(frozen=True)
class StageContext:
    """Input of a stage: source, settings, and which segment and sub-map it is of."""

    root: Path  # the reconstruction's folder
    source: Path  # the video, folder of images or scene
    settings: ReconstructionSettings
    mask: Path | None  # image that is black where pixels are ignored; None: found from the frames
    data_format: str | None  # of a source that is a scene; None: it is none
    device: torch.device
    progress: Progress | None = None
    segment: str = ""  # name of the segment's folder; empty: the only one, which lies in the root
    submap: Submap | None = None  # which model of the posed scene is reconstructed; None: what all of them need

    @property
    def prefix(self) -> str:
        """The way from the root to the folder, which names of stages and of files begin with."""
        return "".join(f"{name}/" for name in (self.segment, self.submap and self.submap.folder) if name)

    @property
    def places(self) -> list[Path]:
        """Files and folders that were given."""
        return [path for path in (self.source, self.mask) if path is not None]

    def submaps(self) -> list[StageContext]:
        """Contexts of the models that are reconstructed, the largest first, as far as poses are there."""
        is_atlas = self.data_format in (None, "colmap") and self.posed.is_dir()
        found = find_submaps(self.posed, self.settings.least_submap) if is_atlas else [Submap()]
        return [replace(self, submap=submap) for submap in found]

    @property
    def out(self) -> Path:
        """Folder of the segment."""
        return self.root / self.segment

    @property
    def folder(self) -> Path:
        """Folder of the sub-map's results."""
        return self.root / self.prefix

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
        return self.folder / "depth"

    @property
    def run(self) -> Path:
        """The trained run."""
        return self.folder / "run"

    def open_posed(self, stored_size: bool = False) -> Scene:
        """The posed scene at the working size without blurred frames, its images read when they are needed."""
        from coliags_plugin.engine.data_formats import open_scene

        size = self.settings.size
        options = ["initial_points=none", "keep_pixels=false", *self.model_options]
        options += [] if size is None else [f"width={size[0]}", f"height={size[1]}"]
        options += ["split=inner-8th"] if self.data_format is None else []
        scene = open_scene(self.posed, self.data_format or "colmap", options, self.progress, stored_size)
        return scene if self.data_format is not None else scene.without(read_blurred(self.frames))

    @property
    def model_options(self) -> list[str]:
        """Options of the posed scene's data manager: which model is read."""
        return [f"model={self.submap.model}"] if self.submap and self.submap.model else []

    @property
    def scene(self) -> Path:
        """Scene to train on."""
        return self.estimated if self.estimates_depth else self.posed

    @cached_property
    def estimates_depth(self) -> bool:
        """True if depth has to be estimated, as the source is no scene, or one without dense depth."""
        return self.data_format is None or self._first_frame.depth is None

    @cached_property
    def has_estimates(self) -> bool:
        """True if the source is a scene with estimated depth."""
        return not self.estimates_depth and self._first_frame.depth_confidence is not None

    @cached_property
    def _first_frame(self) -> Frame:
        return self.open_posed().train[0]
