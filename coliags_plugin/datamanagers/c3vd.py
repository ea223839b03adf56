"""C3VD: posed colonoscopy of silicone phantoms, with dense depth (Bobrow et al., 2023)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from coliags_plugin.datamanagers.c3vd_layouts import Layout, find_layout, find_optional, read_intrinsics, recognise
from coliags_plugin.datamanagers.c3vd_poses import read_poses
from coliags_plugin.datamanagers.depth_formats import C3VD_DEPTH
from coliags_plugin.datamanagers.fusion import load_points
from coliags_plugin.datamanagers.recorded import RecordedDataManager
from coliags_plugin.datamanagers.recording import Recording, Shot, check_pose_count, fingerprint
from coliags_plugin.datamanagers.scene_settings import POINTS_FILE, SceneSettings
from coliags_plugin.datamanagers.splits import EVERY
from coliags_plugin.datamanagers.views import View, whole_frame
from coliags_plugin.lenses import LENSES, octagon_mask


class C3VDSettings(SceneSettings):
    """Options of the ``c3vd`` data manager."""

    lens: Literal["omnidirectional", "legacy-pinhole", "fisheye"] = Field(
        "omnidirectional",
        description="How raw frames are undistorted (pinhole frames need none): 'omnidirectional' rendered the ground "
        "truth; 'legacy-pinhole' is behind most published numbers and off by degrees (docs/data.md 2); "
        "'fisheye' is REIM-NeRF's.",
    )
    mask: bool = Field(True, description="Ignore what lies outside the octagon of raw frames.")


class C3VDDataManager(RecordedDataManager):
    """Reads a C3VD sequence: the raw release or the undistorted layout, told apart by the files (docs/data.md 1, 3).

    A sub-folder ``rotation`` in either layout becomes the test set of that name. ``seen/NNNN_seen.png`` in it, and
    ``truth/seen/NNNN_seen.png`` beside the sequence (valid for the split every-8th of all frames), mark what training
    frames see.
    """

    Settings = C3VDSettings

    settings: C3VDSettings
    name = "c3vd"

    @classmethod
    def recognise(cls, path: Path) -> str | None:
        """See :class:`DataManager`."""
        return recognise(path)

    def open(self, path: Path) -> Recording:
        """See :class:`RecordedDataManager`."""
        settings = self.settings
        layout = find_layout(path)
        count = len(layout.images)
        whole = settings.frame_step == 1 and (settings.max_frames is None or settings.max_frames >= count)
        marks = find_optional(path / "truth" / "seen", "seen", count) if whole and settings.split == "every-8th" else {}
        shots, facts = self._shots(layout, {place: mark for place, mark in marks.items() if place % EVERY == 0})
        test_sets = {}
        if (path / "rotation").is_dir():
            rotation = find_layout(path / "rotation")
            marks = find_optional(path / "rotation" / "seen", "seen", len(rotation.images))
            test_sets["rotation"], facts["rotation"] = self._shots(rotation, marks, "rotation-")
        points = path / POINTS_FILE
        return Recording(
            kind=f"{layout.kind} layout, {facts['pose_convention']['order']} poses",
            shots=shots,
            facts=facts,
            fingerprint=_fingerprint(layout),
            test_sets=test_sets,
            own_points=(lambda: load_points(points)) if points.is_file() else None,
            points_source=points,
        )

    def _shots(self, layout: Layout, seen: Mapping[int, Path], prefix: str = "") -> tuple[list[Shot], dict[str, Any]]:
        poses = read_poses(layout.poses)
        check_pose_count(layout.poses, len(poses.camera_to_world), len(layout.images))
        view = self._view(layout)
        depths = layout.depths or (None,) * len(layout.images)
        shots = [
            Shot(prefix + image.stem, image, view, pose, depth, C3VD_DEPTH, seen=seen.get(place))
            for place, (image, depth, pose) in enumerate(zip(layout.images, depths, poses.camera_to_world, strict=True))
        ]
        raw = layout.kind == "raw"
        facts: dict[str, Any] = {
            "layout": layout.kind,
            "lens": self.settings.lens if raw else None,
            "focal_scale": self.settings.focal_scale if raw else None,
            "mask": "octagon" if raw and self.settings.mask else None,
            **view.facts(),
            "pose_convention": {"order": poses.convention, **poses.evidence},
        }
        return shots, facts

    def _view(self, layout: Layout) -> View:
        settings = self.settings
        if layout.camera is not None:
            pinhole, width, height = read_intrinsics(layout.camera)
            return View.of_pinhole(pinhole, width, height, layout.camera, settings.size)
        lens = whole_frame(LENSES[settings.lens], layout.images[0])
        shows = octagon_mask(lens.width, lens.height) if settings.mask else None
        return View.through(lens, layout.images[0], settings.size, settings.focal_scale, shows)


def _fingerprint(layout: Layout) -> str:
    return fingerprint(layout.folder, (*layout.images, *(layout.depths or ())), (layout.poses, layout.camera))
