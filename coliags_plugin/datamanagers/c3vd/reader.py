"""C3VD (Bobrow et al., 2023): posed colonoscopy of silicone phantoms, and the base of its releases' data managers."""

from __future__ import annotations

import re
from abc import abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from coliags_plugin.core.errors import InputError
from coliags_plugin.datamanagers.fusion import load_points
from coliags_plugin.datamanagers.reading import files as reading
from coliags_plugin.datamanagers.reading.depth_formats import C3VD_DEPTH
from coliags_plugin.datamanagers.reading.files import read_intrinsics
from coliags_plugin.datamanagers.recorded import RecordedDataManager
from coliags_plugin.datamanagers.recording import (
    ROTATION,
    Recording,
    Shot,
    find_seen_masks,
    fingerprint,
    make_shots,
    poses_of_images,
)
from coliags_plugin.datamanagers.rectification import Rectification, whole_frame
from coliags_plugin.datamanagers.scene_settings import POINTS_FILE, SceneSettings
from coliags_plugin.geometry.lenses.models import LENSES, Lens, PinholeLens, octagon_mask

LAYOUTS = (
    "the raw release (NNNN_color.png, NNNN_depth.tiff and pose.txt in one folder) "
    "or the undistorted layout (images/, depths/, camera_pose.txt and camera.json)"
)


@dataclass(frozen=True)
class SequenceFiles:
    """The files of one sequence in the layout ``kind``, frame 0 first; depth of all frames or None."""

    kind: str
    folder: Path
    images: tuple[Path, ...]
    depths: tuple[Path, ...] | None
    poses: Path
    camera: Path | None = None


class SequenceDataManager(RecordedDataManager):
    """Base class; subclasses find the files and define the rectification.

    A sub-folder ``rotation`` in the same layout becomes the test set of that name. ``seen/NNNN_seen.png`` in it, and
    ``truth/seen/NNNN_seen.png`` beside the sequence, are the seen masks for :attr:`seen_split`.
    """

    @abstractmethod
    def find(self, folder: Path) -> SequenceFiles:
        """Find the files of the sequence in a folder."""

    @abstractmethod
    def rectification(self, files: SequenceFiles) -> tuple[Rectification, dict[str, Any]]:
        """The rectification of a sequence's images, and its provenance."""

    def open(self, path: Path) -> Recording:
        """See :class:`RecordedDataManager`."""
        files = self.find(path)
        shots, facts = self._shots(files)
        test_sets, seen = {}, {"video": find_seen_masks(path / "truth", len(shots))}
        if (path / ROTATION).is_dir():
            rotation = self.find(path / ROTATION)
            test_sets[ROTATION], facts[ROTATION] = self._shots(rotation, f"{ROTATION}-")
            seen[ROTATION] = find_seen_masks(path / ROTATION, len(rotation.images))
        points = path / POINTS_FILE
        return Recording(
            kind=f"{files.kind} layout, {facts['pose_convention']['order']} poses",
            shots=shots,
            facts=facts,
            fingerprint=fingerprint(path, (*files.images, *(files.depths or ())), (files.poses, files.camera)),
            test_sets=test_sets,
            own_points=(lambda: load_points(points)) if points.is_file() else None,
            points_source=points,
            seen=seen,
        )

    def octagon_rectification(self, lens: Lens, image: Path, mask: bool) -> Rectification:
        """The rectification of raw frames like ``image``, optionally masked outside the octagon."""
        lens = whole_frame(lens, image)
        shows = octagon_mask(lens.width, lens.height) if mask else None
        return self.rectification_of(lens, image, shows)

    def _shots(self, files: SequenceFiles, prefix: str = "") -> tuple[list[Shot], dict[str, Any]]:
        poses = poses_of_images(files.poses, len(files.images))
        rectification, described = self.rectification(files)
        shots = make_shots(files.images, rectification, poses.camera_to_world, files.depths, C3VD_DEPTH, prefix)
        facts: dict[str, Any] = {
            "layout": files.kind,
            **described,
            **rectification.facts(),
            "pose_convention": {"order": poses.convention, **poses.evidence},
        }
        return shots, facts


class C3VDSettings(SceneSettings):
    """Options of the ``c3vd`` data manager."""

    lens: Literal["omnidirectional", "legacy-pinhole", "fisheye"] = Field(
        "omnidirectional",
        description="Lens model to undistort raw frames: 'omnidirectional': that of the rendered ground truth; "
        "'legacy-pinhole': used for most published numbers, and wrong by degrees (docs/layouts/c3vd.md 2); 'fisheye': "
        "REIM-NeRF's.",
    )
    mask: bool = Field(True, description="Ignore pixels outside the octagon of raw frames.")


class C3VDDataManager(SequenceDataManager):
    """Reads a C3VD sequence in the raw or the undistorted layout.

    See docs/layouts/c3vd.md 1 and 3, and :class:`SequenceDataManager` for test views beside the sequence.
    """

    Settings = C3VDSettings

    settings: C3VDSettings
    name = "c3vd"

    @classmethod
    def recognise(cls, path: Path) -> str | None:
        """See :class:`DataManager`."""
        if (path / "camera_pose.txt").is_file() and (path / "images").is_dir():
            return "camera_pose.txt beside images/"
        if (path / "pose.txt").is_file() and next(path.glob("*_color.png"), None) is not None:
            return "pose.txt beside NNNN_color.png"
        return None

    def find(self, folder: Path) -> SequenceFiles:
        """See :class:`SequenceDataManager`; ``kind`` is ``raw`` (distorted) or ``undistorted`` (pinhole images)."""
        reading.require_folder(folder, f"a C3VD sequence: {LAYOUTS}")
        raw = [path for path in folder.iterdir() if re.fullmatch(r"\d+_color\.png", path.name)]
        camera = None
        if raw and (folder / "images").is_dir():
            raise InputError(
                f"{folder} holds both {raw[0].name} and images/",
                "one sequence in one layout",
                "Move one of the two to its own folder",
            )
        if raw:
            kind, poses = "raw", folder / "pose.txt"
            images = reading.numbered(folder, "color", frozenset({".png"}))
            depths = reading.numbered(folder, "depth", reading.TIFF_SUFFIXES)
        elif (folder / "images").is_dir():
            kind, poses, camera = "undistorted", folder / "camera_pose.txt", folder / "camera.json"
            images = reading.numbered(folder / "images", "color", reading.IMAGE_SUFFIXES)
            depths = reading.numbered(folder / "depths", "depth", reading.DEPTH_SUFFIXES)
        else:
            do = "Name the sequence's own folder, for instance cecum_t1_a"
            raise InputError(f"{folder} holds {reading.inventory(folder)}", LAYOUTS, do)
        if not images:
            raise InputError(
                f"{folder / 'images'} holds {reading.inventory(folder / 'images')}", "<number>_color.png files"
            )
        for path in filter(None, (poses, camera)):
            if not path.is_file():
                raise InputError(f"{folder} has images but no {path.name}", LAYOUTS, f"Add {path.name}")
        return SequenceFiles(kind, folder, *reading.paired(folder, images, depths), poses, camera)

    def rectification(self, files: SequenceFiles) -> tuple[Rectification, dict[str, Any]]:
        """See :class:`SequenceDataManager`."""
        settings = self.settings
        raw = files.camera is None
        facts = {
            "lens": settings.lens if raw else None,
            "focal_scale": settings.focal_scale if raw else None,
            "mask": "octagon" if raw and settings.mask else None,
        }
        if files.camera is not None:
            return self.rectification_of(PinholeLens.of(read_intrinsics(files.camera)), files.camera), facts
        return self.octagon_rectification(LENSES[settings.lens], files.images[0], settings.mask), facts
