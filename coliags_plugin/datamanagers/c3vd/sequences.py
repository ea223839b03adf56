"""Base data manager of C3VD's releases: numbered frames, one pose file, 16-bit depth and separate test views."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from coliags_plugin.datamanagers.fusion import load_points
from coliags_plugin.datamanagers.reading.depth_formats import C3VD_DEPTH
from coliags_plugin.datamanagers.recorded import RecordedDataManager
from coliags_plugin.datamanagers.recording import Recording, Shot, check_pose_count, fingerprint, make_shots
from coliags_plugin.datamanagers.rectification import Rectification, whole_frame
from coliags_plugin.datamanagers.scene_settings import POINTS_FILE
from coliags_plugin.datamanagers.seen_masks import ROTATION, find_seen_masks
from coliags_plugin.geometry.lenses.models import Lens, octagon_mask
from coliags_plugin.geometry.poses.c3vd import read_poses


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
        shots, facts = self._shots(files, find_seen_masks(path / "truth", len(files.images)))
        test_sets = {}
        if (path / ROTATION).is_dir():
            rotation = self.find(path / ROTATION)
            seen = find_seen_masks(path / ROTATION, len(rotation.images))
            test_sets[ROTATION], facts[ROTATION] = self._shots(rotation, seen, f"{ROTATION}-")
        points = path / POINTS_FILE
        return Recording(
            kind=f"{files.kind} layout, {facts['pose_convention']['order']} poses",
            shots=shots,
            facts=facts,
            fingerprint=fingerprint(path, (*files.images, *(files.depths or ())), (files.poses, files.camera)),
            test_sets=test_sets,
            own_points=(lambda: load_points(points)) if points.is_file() else None,
            points_source=points,
        )

    def octagon_rectification(self, lens: Lens, image: Path, mask: bool) -> Rectification:
        """The rectification of raw frames like ``image``, optionally masked outside the octagon."""
        lens = whole_frame(lens, image)
        shows = octagon_mask(lens.width, lens.height) if mask else None
        size = self.working_size(lens.width, lens.height)
        return Rectification.through(lens, image, size, self.settings.focal_scale, shows)

    def _shots(
        self, files: SequenceFiles, seen: Mapping[int, Path], prefix: str = ""
    ) -> tuple[list[Shot], dict[str, Any]]:
        poses = read_poses(files.poses)
        check_pose_count(files.poses, len(poses.camera_to_world), len(files.images))
        rectification, described = self.rectification(files)
        shots = make_shots(files.images, rectification, poses.camera_to_world, files.depths, C3VD_DEPTH, seen, prefix)
        facts: dict[str, Any] = {
            "layout": files.kind,
            **described,
            **rectification.facts(),
            "pose_convention": {"order": poses.convention, **poses.evidence},
        }
        return shots, facts
