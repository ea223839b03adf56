"""Writes triangulated or reconstructed videos as scenes in COLMAP's layout."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_folder
from coliags_plugin.core.images import write_mask
from coliags_plugin.core.scenes import Frame
from coliags_plugin.datamanagers.colmap.writer import SeenPoints, add_points, write_image_and_mask, write_model
from coliags_plugin.datamanagers.units import Unit, write_unit
from coliags_plugin.reconstruction.structure.colmap_database import frame_model
from coliags_plugin.reconstruction.structure.features import image_and_mask
from coliags_plugin.reconstruction.structure.image_files import Masks, file_names, mask_of
from coliags_plugin.reconstruction.structure.sfm import Reconstruction
from coliags_plugin.reconstruction.structure.triangulation import Triangulation


def write_colmap_scene(
    folder: Path,
    frames: Sequence[Frame],
    triangulation: Triangulation,
    held_out: Sequence[Frame] = (),
    overwrite: bool = False,
    unit: Unit = "mm",
) -> None:
    """Write images, masks and a sparse model: ``images/NAME.png``, ``masks/NAME.png``, ``sparse/0/*.bin``.

    Poses, intrinsics and the unit of length (``unit.txt``) are those of the frames, which have masks or none. Those
    ``held_out``, of the same video but without observations, are sorted among the others by ``index``.
    """
    if len(triangulation.observations) != len(frames):
        raise InputError(
            f"a triangulation of {len(triangulation.observations)} frames, and {len(frames)} frames", "the same frames"
        )
    no_points = SeenPoints(np.empty((0, 2)), np.empty(0, np.int64))
    observed = [SeenPoints(observations.pixels, observations.points) for observations in triangulation.observations]
    video = [*zip(frames, observed, strict=True), *((frame, no_points) for frame in held_out)]
    video.sort(key=lambda pair: pair[0].index)
    posed = [frame for frame, _ in video]
    names = file_names([frame.name for frame in posed], ".png")
    model = frame_model(posed, names)
    points = triangulation.positions, triangulation.colors, triangulation.errors
    add_points(model, [points_seen for _, points_seen in video], *points)
    with atomic_folder(folder, overwrite) as scratch:
        for frame, name in zip(posed, names, strict=True):
            write_image_and_mask(scratch, name, *image_and_mask(frame))
        write_model(scratch, model)
        write_unit(scratch, unit)


def write_sfm_scene(
    folder: Path, reconstruction: Reconstruction, masks: Masks = None, overwrite: bool = False, unit: Unit = "unknown"
) -> None:
    """Write a scene in COLMAP's layout: copies of the registered images, masks, the model and its unit."""
    with atomic_folder(folder, overwrite) as scratch:
        (scratch / "images").mkdir()
        for index in reconstruction.registered:
            shutil.copyfile(reconstruction.images[index], scratch / "images" / reconstruction.names[index])
            mask = mask_of(reconstruction.images[index], masks)
            if mask is not None:
                write_mask(scratch / "masks" / f"{reconstruction.names[index]}.png", mask)
        write_model(scratch, reconstruction.model)
        write_unit(scratch, unit)
