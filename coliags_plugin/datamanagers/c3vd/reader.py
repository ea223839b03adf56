"""Data manager for C3VD: posed colonoscopy of silicone phantoms with dense depth (Bobrow et al., 2023)."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from coliags_plugin.datamanagers.c3vd.layouts import find_layout, recognise
from coliags_plugin.datamanagers.c3vd.sequences import SequenceDataManager, SequenceFiles
from coliags_plugin.datamanagers.reading.camera_json import read_intrinsics
from coliags_plugin.datamanagers.rectification import Rectification
from coliags_plugin.datamanagers.scene_settings import SceneSettings
from coliags_plugin.geometry.lenses.models import LENSES


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
        return recognise(path)

    def find(self, folder: Path) -> SequenceFiles:
        """See :class:`SequenceDataManager`."""
        return find_layout(folder)

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
            pinhole = read_intrinsics(files.camera)
            size = self.working_size(pinhole.width, pinhole.height)
            return Rectification.of_pinhole(pinhole, files.camera, size), facts
        return self.octagon_rectification(LENSES[settings.lens], files.images[0], settings.mask), facts
