"""Sub-maps of a reconstruction, folders of both, and what their stages share."""

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
        """Folder of its results, relative to the reconstruction's; empty for the first."""
        return f"submap-{self.number}" if self.number else ""

    @property
    def title(self) -> str:
        """What messages call it."""
        return f"sub-map {self.number}"


LARGEST = Submap()


def find_submaps(scene: Path, least: int) -> list[Submap]:
    """The first model of a scene in COLMAP's layout, and the others that have ``least`` frames or more."""
    models = [folder for folder in find_models(scene) if folder.name.isdecimal()]
    if len(models) < 2:
        return [LARGEST]
    counts = [len(colmap.read(folder).camera_to_world) for folder in models]
    return [
        Submap(number, folder.relative_to(scene).as_posix(), count)
        for number, (folder, count) in enumerate(zip(models, counts, strict=True))
        if number == 0 or count >= least
    ]


@dataclass(frozen=True)
class StageContext:
    """What every stage is given."""

    out: Path  # folder of the segment: the reconstruction's, or of a long video one within it
    source: Path  # the video, folder of images or scene
    settings: ReconstructionSettings
    mask: Path | None  # image that is black where pixels are ignored; None: found from the frames
    data_format: str | None  # of a source that is a scene; None: it is none
    device: torch.device
    progress: Progress | None = None
    segment: str = ""  # name of the segment's folder; empty: of the whole video
    submap: Submap = LARGEST  # which model of the posed scene is reconstructed

    @property
    def root(self) -> Path:
        """The reconstruction's folder."""
        return self.out.parent if self.segment else self.out

    @property
    def prefix(self) -> str:
        """What stages and files of the sub-map are called by in the reconstruction's folder: the way to its folder."""
        return "".join(f"{name}/" for name in (self.segment, self.submap.folder) if name)

    @property
    def places(self) -> tuple[Path, ...]:
        """Files and folders that are given."""
        return tuple(path for path in (self.root, self.source, self.mask) if path is not None)

    def submaps(self) -> list[StageContext]:
        """One for every model that is reconstructed, the largest first, as far as poses are there."""
        if self.data_format not in (None, "colmap") or not self.posed.is_dir():
            return [self]
        return [replace(self, submap=submap) for submap in find_submaps(self.posed, self.settings.least_submap)]

    @property
    def folder(self) -> Path:
        """Folder of the sub-map's results."""
        return self.out / self.submap.folder

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
        return [] if self.submap.model is None else [f"model={self.submap.model}"]

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
