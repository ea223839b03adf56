"""Writes reconstructed videos as scenes in COLMAP's layout."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from coliags_plugin.core.files import atomic_folder, link_or_copy, write_json
from coliags_plugin.core.images import decode_image, read_8_bit, write_image, write_mask
from coliags_plugin.core.scene_files import Unit, write_unit
from coliags_plugin.datamanagers.colmap import ATLAS_FILE
from coliags_plugin.geometry.poses.colmap import write_reconstruction
from coliags_plugin.reconstruction.structure.image_files import Masks, mask_of
from coliags_plugin.reconstruction.structure.sfm import Atlas


def write_sfm_scene(
    folder: Path,
    atlas: Atlas,
    masks: Masks = None,
    overwrite: bool = False,
    units: Sequence[Unit] = (),
    link: bool = False,
) -> None:
    """Write a scene in COLMAP's layout: the posed images as 8-bit RGB, masks, the unit, and the models, largest first.

    ``atlas.json`` tells which images each model has, how good it is, and why the other images have no pose. ``units``
    are those of the models, unknown where not given: each has then one of its own. With ``link``, images are second
    names of the given files, where the disk allows it, and take no space.
    """
    unknown: list[Unit] = ["unknown"] * (len(atlas.models) - len(units))
    units, copy = [*units, *unknown], link_or_copy if link else _copy_as_8_bit
    with atomic_folder(folder, overwrite) as scratch:
        (scratch / "images").mkdir()
        for number, reconstruction in enumerate(atlas.models):
            for index in reconstruction.registered:
                copy(reconstruction.images[index], scratch / "images" / reconstruction.names[index])
                mask = mask_of(reconstruction.images[index], masks)
                if mask is not None:
                    write_mask(scratch / "masks" / f"{reconstruction.names[index]}.png", mask)
            write_reconstruction(scratch / "sparse" / str(number), reconstruction.model)
        write_unit(scratch, units[0])
        write_json(scratch / ATLAS_FILE, _record(atlas, units))


def _copy_as_8_bit(source: Path, target: Path) -> None:
    """Copy an image, or write it as 8-bit RGB if it is grey or of 16 bits."""
    image = decode_image(source)
    if image.ndim == 3 and image.dtype == np.uint8:
        shutil.copyfile(source, target)
    else:
        write_image(target, read_8_bit(source))


def _record(atlas: Atlas, units: Sequence[Unit]) -> dict[str, object]:
    """Contents of ``atlas.json``. Frames are numbered from 0 in the order of the images."""
    submaps = []
    for number, span in atlas.submaps():
        model = atlas.models[number]
        camera = next(iter(model.model.cameras.values()))
        submaps.append(
            {
                "model": f"sparse/{number}",
                "unit": units[number],
                "frames": [index for index in model.registered if index in span],
                "camera": {
                    "model": camera.model_name,
                    "size": [camera.width, camera.height],
                    "params": [float(value) for value in camera.params],
                },
                "points": int(model.model.num_points3D()),
                "reprojection_error_px": round(float(model.model.compute_mean_reprojection_error()), 3),
                "held_out_error_px": None if model.test_error is None else round(model.test_error, 3),
                "rigidity_px": {str(apart): round(value, 3) for apart, value in model.rigidity.items()},
                "brightness_depth_correlation": None if model.correlation is None else round(model.correlation, 3),
            }
        )
    links = [(link, True) for model in atlas.models for link in model.links]
    links += [(link, False) for link in atlas.refused]
    return {
        "format": 1,
        "frames": [path.name for path in atlas.images],
        "submaps": submaps,
        "joins": [
            {**asdict(link), "joined": joined, "reason": link.reason}
            for link, joined in sorted(links, key=lambda pair: pair[0].after)
        ],
        "lost": [{"frame": index, "reason": reason} for index, reason in atlas.lost.items()],
    }
