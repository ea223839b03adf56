"""Writes reconstructed videos as scenes in COLMAP's layout."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from coliags_plugin.core.files import atomic_folder, link_or_copy, write_json
from coliags_plugin.core.images import write_mask
from coliags_plugin.datamanagers.colmap.atlas import ATLAS_FILE
from coliags_plugin.datamanagers.colmap.writer import write_model
from coliags_plugin.datamanagers.units import Unit, write_unit
from coliags_plugin.outputs.image_files import write_png
from coliags_plugin.reconstruction.structure.image_files import Masks, mask_of
from coliags_plugin.reconstruction.structure.ribbon import draw_ribbon
from coliags_plugin.reconstruction.structure.sfm import Atlas

#: Name of the picture of the sub-maps.
RIBBON_FILE = "atlas.png"


def write_sfm_scene(
    folder: Path,
    atlas: Atlas,
    masks: Masks = None,
    overwrite: bool = False,
    units: Sequence[Unit] = (),
    link: bool = False,
) -> None:
    """Write a scene in COLMAP's layout: copies of the posed images, masks, the unit, and the models, largest first.

    ``atlas.json`` tells which images each model has, how good it is, and why the other images have no pose;
    ``atlas.png`` shows it. ``units`` are those of the models, unknown where not given: each has then one of its own.
    With ``link``, images are second names of the given files, where the disk allows it, and take no space.
    """
    unknown: list[Unit] = ["unknown"] * (len(atlas.models) - len(units))
    units, copy = [*units, *unknown], link_or_copy if link else shutil.copyfile
    with atomic_folder(folder, overwrite) as scratch:
        (scratch / "images").mkdir()
        for number, reconstruction in enumerate(atlas.models):
            for index in reconstruction.registered:
                copy(reconstruction.images[index], scratch / "images" / reconstruction.names[index])
                mask = mask_of(reconstruction.images[index], masks)
                if mask is not None:
                    write_mask(scratch / "masks" / f"{reconstruction.names[index]}.png", mask)
            write_model(scratch, reconstruction.model, number)
        write_unit(scratch, units[0])
        write_json(scratch / ATLAS_FILE, _record(atlas, units))
        write_png(scratch / RIBBON_FILE, draw_ribbon(atlas))


def _record(atlas: Atlas, units: Sequence[Unit]) -> dict[str, object]:
    """What ``atlas.json`` holds. Frames are numbered from 0 in the order of the images."""
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
