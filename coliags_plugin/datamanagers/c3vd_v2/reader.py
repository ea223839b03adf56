"""Data manager for C3VDv2, with debris, deformation and more phantoms than C3VD (doi 10.7281/T1/JC64MK)."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from coliags_plugin.datamanagers.c3vd.sequences import SequenceDataManager, SequenceFiles
from coliags_plugin.datamanagers.c3vd_v2.files import INTRINSICS, find_sequence, recognise
from coliags_plugin.datamanagers.c3vd_v2.lens import CANDIDATE_LENS, read_camera_intrinsics
from coliags_plugin.datamanagers.rectification import Rectification
from coliags_plugin.datamanagers.scene_settings import SceneSettings
from coliags_plugin.datamanagers.seen import ROTATION
from coliags_plugin.geometry.lenses.models import LENSES, Lens

log = logging.getLogger(__name__)


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
        return recognise(path)

    def find(self, folder: Path) -> SequenceFiles:
        """See :class:`SequenceDataManager`."""
        return find_sequence(folder)

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
