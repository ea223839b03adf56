"""Data manager for REIM-NeRF's preprocessed C3VD (Psychogyios et al., 2023): fisheye images and distance maps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool
from pydantic import Field

from coliags_plugin.core.errors import InputError
from coliags_plugin.datamanagers.reading.files import unposed_images, warn_of_unposed
from coliags_plugin.datamanagers.reading.images import read_mask
from coliags_plugin.datamanagers.recorded import RecordedDataManager
from coliags_plugin.datamanagers.recording import Recording, fingerprint, make_shots
from coliags_plugin.datamanagers.rectification import Rectification
from coliags_plugin.datamanagers.reim_nerf.files import RayDistance, ReimNerfSequence, ray_cosines, read_sequence
from coliags_plugin.datamanagers.scene_settings import SceneSettings
from coliags_plugin.datamanagers.seen_masks import find_seen_masks
from coliags_plugin.datamanagers.splits import Split

MASK_FILE = "rgb_mask.png"


class ReimNerfDataSettings(SceneSettings):
    """Options of the ``reim-nerf`` data manager."""

    split: Split = Field(
        "own",
        description="Test frames: 'own': trains on transforms_train.json and tests on transforms_true_test.json, as "
        "REIM-NeRF does; its validation frames are in neither. Others as for every data manager.",
    )
    mask: bool = Field(True, description=f"Ignore the pixels masked by {MASK_FILE}.")


class ReimNerfDataManager(RecordedDataManager):
    """Reads REIM-NeRF's preprocessed C3VD in millimetres and C3VD's world frame (docs/layouts/reim-nerf.md)."""

    Settings = ReimNerfDataSettings

    settings: ReimNerfDataSettings
    name = "reim-nerf"
    #: REIM-NeRF trains and evaluates at a fifth of the raw size.
    fits = (270, 216)
    seen_split = "own"

    @classmethod
    def recognise(cls, path: Path) -> str | None:
        """See :class:`DataManager`."""
        if not (path / "transforms_train.json").is_file():
            return None
        beside = next((name for name in ("distmaps", MASK_FILE) if (path / name).exists()), None)
        return None if beside is None else f"transforms_train.json beside {beside}"

    def open(self, path: Path) -> Recording:
        """See :class:`RecordedDataManager`."""
        settings = self.settings
        sequence = read_sequence(path, settings.outside_files)
        if settings.split == "own" and "true_test" not in sequence.parts:
            raise InputError(
                f"{path} has no transforms_true_test.json",
                "the test frames of split 'own'",
                "Add it, or choose another split",
            )
        file, lens = sequence.files["train"], sequence.lens
        mask = path / MASK_FILE if settings.mask else None
        shows = None if mask is None else _shows(mask, lens.width, lens.height)
        rectification = Rectification.through(
            lens, file, self.working_size(lens.width, lens.height), settings.focal_scale, shows
        )
        size = sequence.distmap_scale / 65535.0 / sequence.scene_scale
        form = RayDistance(size, rectification.nearest(ray_cosines(lens)))
        seen = find_seen_masks(path / "truth", len(sequence.frames))
        images = [frame.image for frame in sequence.frames]
        distances = [frame.distances for frame in sequence.frames]
        poses = np.stack([frame.camera_to_world for frame in sequence.frames])
        shots = make_shots(images, rectification, poses, distances, form, seen)
        warn_of_unposed(path, unposed_images(images, distances))
        large = [file for pair in zip(images, distances, strict=True) for file in pair]
        parts = sequence.parts
        return Recording(
            kind="REIM-NeRF layout",
            shots=shots,
            facts=self._facts(sequence, rectification),
            fingerprint=fingerprint(path, large, (*sequence.files.values(), mask)),
            own_split={"train": parts["train"], "test": parts.get("true_test", ())},
        )

    def _facts(self, sequence: ReimNerfSequence, rectification: Rectification) -> dict[str, Any]:
        return {
            "layout": "REIM-NeRF",
            "lens": "fisheye of the JSON files",
            "focal_scale": self.settings.focal_scale,
            "mask": MASK_FILE if self.settings.mask else None,
            **rectification.facts(),
            "parts": {part: len(indices) for part, indices in sequence.parts.items()},
            "pose_convention": {
                "order": "camera-to-world, OpenGL axes, normalised",
                "scene_scale": sequence.scene_scale,
                "scene_shift_mm": [float(value) for value in sequence.scene_shift],
            },
        }


def _shows(mask: Path, width: int, height: int) -> Bool[np.ndarray, "H W"]:
    """Valid stored pixels: the mask file is white where a pixel is ignored."""
    if not mask.is_file():
        raise InputError(
            f"no file {mask}",
            "the mask of pixels outside the lens's image circle",
            "Restore it, or --set datamanager.mask=false",
        )
    ignored = read_mask(mask)
    if ignored.shape != (height, width):
        raise InputError(f"{mask} is {ignored.shape[1]} x {ignored.shape[0]}", f"the images' size, {width} x {height}")
    return np.asarray(~ignored)
