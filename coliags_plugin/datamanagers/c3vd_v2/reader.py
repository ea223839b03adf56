"""Data manager for C3VDv2, with debris, deformation and more phantoms than C3VD (doi 10.7281/T1/JC64MK)."""

from __future__ import annotations

import logging
import re
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from coliags_plugin.core.errors import InputError
from coliags_plugin.datamanagers.c3vd.reader import SequenceDataManager, SequenceFiles
from coliags_plugin.datamanagers.c3vd_v2.lens import CANDIDATE_LENS, read_camera_intrinsics
from coliags_plugin.datamanagers.reading.files import TIFF_SUFFIXES, numbered, numbered_images, paired, require_folder
from coliags_plugin.datamanagers.rectification import Rectification
from coliags_plugin.datamanagers.scene_settings import SceneSettings
from coliags_plugin.datamanagers.seen_masks import ROTATION
from coliags_plugin.geometry.lenses.models import LENSES, Lens
from coliags_plugin.geometry.poses import c3vd as c3vd_poses

log = logging.getLogger(__name__)

LAYOUT = "rgb/NNNN.png and pose.txt, for registered videos also depth/NNNN_depth.tiff"
#: Announced for the release; its location and format are not documented.
INTRINSICS = "camera_intrinsics.txt"


class C3VDv2Settings(SceneSettings):
    """Options of the ``c3vd-v2`` data manager."""

    lens: Literal["file", "v2", "v1"] = Field(
        "file",
        description="Lens calibration: 'file': from camera_intrinsics.txt, or 'v2' if it is missing; 'v2': a candidate "
        "calibration, unverified (docs/layouts/c3vd-v2.md 2); 'v1': C3VD's omnidirectional.",
    )
    mask: bool = Field(True, description="Ignore pixels outside the octagon of the frames.")


class C3VDv2DataManager(SequenceDataManager):
    """Reads a C3VDv2 sequence; see docs/layouts/c3vd-v2.md.

    Registered videos have depth; deformation and screening videos have images and poses only.
    """

    Settings = C3VDv2Settings

    settings: C3VDv2Settings
    name = "c3vd-v2"

    @classmethod
    def recognise(cls, path: Path) -> str | None:
        """See :class:`DataManager`."""
        numbers = any(re.fullmatch(r"\d+", image.stem) for image in path.glob("rgb/*.png"))
        if numbers and (path / "pose.txt").is_file() and c3vd_poses.recognise(path / "pose.txt"):
            return "pose.txt (16 numbers a line) beside rgb/NNNN.png"
        return None

    def find(self, folder: Path) -> SequenceFiles:
        """See :class:`SequenceDataManager`; ``camera`` is the intrinsics file, in it or up to two folders up."""
        require_folder(folder, f"a C3VDv2 sequence: {LAYOUT}")
        images = numbered_images(folder / "rgb", "", LAYOUT, "c1_cecum_t1_v1")
        poses = folder / "pose.txt"
        if not poses.is_file():
            raise InputError(f"{folder} has images but no pose.txt", LAYOUT, "Add pose.txt")
        depths = numbered(folder / "depth", "depth", TIFF_SUFFIXES)
        here = folder.resolve()
        camera = next((path / INTRINSICS for path in (here, *here.parents[:2]) if (path / INTRINSICS).is_file()), None)
        return SequenceFiles("c3vd-v2", folder, *paired(folder, images, depths), poses, camera)

    def rectification(self, files: SequenceFiles) -> tuple[Rectification, dict[str, Any]]:
        """See :class:`SequenceDataManager`."""
        settings = self.settings
        lens, source = self._lens(files)
        facts = {
            "lens": settings.lens,
            "lens_source": source,
            "focal_scale": settings.focal_scale,
            "mask": "octagon" if settings.mask else None,
        }
        return self.octagon_rectification(lens, files.images[0], settings.mask), facts

    def _lens(self, files: SequenceFiles) -> tuple[Lens, str]:
        """The lens and the source of its calibration."""
        if self.settings.lens == "v1":
            return LENSES["omnidirectional"], "C3VD's omnidirectional calibration"
        if self.settings.lens == "file" and files.camera is not None:
            return read_camera_intrinsics(files.camera), str(files.camera)
        if self.settings.lens == "file" and files.folder.name != ROTATION:
            log.warning("%s: no %s, so the lens is an unverified candidate (lens: v2)", files.folder, INTRINSICS)
        return CANDIDATE_LENS, "candidate calibration, unverified"
