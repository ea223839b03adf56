"""Writes the result of structure from motion as a scene in COLMAP's layout."""

from __future__ import annotations

import shutil
from pathlib import Path

from coliags_plugin.core.files import atomic_folder
from coliags_plugin.core.images import write_mask
from coliags_plugin.datamanagers.colmap.writer import write_model
from coliags_plugin.datamanagers.units import Unit, write_unit
from coliags_plugin.reconstruction.structure.image_files import Masks, mask_of
from coliags_plugin.reconstruction.structure.sfm import Reconstruction


def write_sfm_scene(
    folder: Path,
    found: Reconstruction,
    masks: Masks = None,
    overwrite: bool = False,
    unit: Unit = "unknown",
) -> None:
    """Write a scene in COLMAP's layout: copies of the registered images, masks, the model and its unit.

    Args:
        folder: The folder to create.
        found: What to write.
        masks: As for :func:`~coliags_plugin.reconstruction.structure.sfm.reconstruct`.
        overwrite: Replace the folder if it exists.
        unit: Of the model.

    Raises:
        InputError: The folder exists or cannot be written.
    """
    with atomic_folder(folder, overwrite) as scratch:
        (scratch / "images").mkdir()
        for index in found.registered:
            shutil.copyfile(found.images[index], scratch / "images" / found.names[index])
            mask = mask_of(found.images[index], masks)
            if mask is not None:
                write_mask(scratch / "masks" / f"{found.names[index]}.png", mask)
        write_model(scratch, found.model)
        write_unit(scratch, unit)
