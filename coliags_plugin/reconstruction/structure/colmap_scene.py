"""A triangulated video as a scene in COLMAP's layout, which ``coliags train`` reads."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_folder
from coliags_plugin.core.scenes import Frame
from coliags_plugin.reconstruction.structure.colmap_model import posed_model
from coliags_plugin.reconstruction.structure.pictures import file_names, write_mask, write_picture
from coliags_plugin.reconstruction.structure.triangulation import Observations, Triangulation

if TYPE_CHECKING:
    import pycolmap


def write_colmap_scene(
    folder: Path,
    frames: Sequence[Frame],
    triangulation: Triangulation,
    held_out: Sequence[Frame] = (),
    overwrite: bool = False,
) -> None:
    """Write pictures, masks and a sparse model: ``images/NAME.png``, ``masks/NAME.png``, ``sparse/0/*.bin``.

    Poses, intrinsics and the unit of length are those of the frames.

    Args:
        folder: The folder to make.
        frames: What was triangulated. Frames without a mask get none.
        triangulation: Its points.
        held_out: Further frames of the same video, which see no points; they get the places that their ``index`` gives
            them among the others.
        overwrite: Replace the folder where it exists.

    Raises:
        InputError: The points belong to other frames, or the folder exists or cannot be written.
    """
    if len(triangulation.observations) != len(frames):
        raise InputError(
            f"a triangulation of {len(triangulation.observations)} frames, and {len(frames)} frames", "the same frames"
        )
    blind = Observations(np.empty((0, 2)), np.empty(0), np.empty(0, np.int64))
    seen = [*zip(frames, triangulation.observations, strict=True), *((frame, blind) for frame in held_out)]
    seen.sort(key=lambda pair: pair[0].index)
    video = [frame for frame, _ in seen]
    names = file_names([frame.name for frame in video], ".png")
    model = _model(video, names, [observations for _, observations in seen], triangulation)
    with atomic_folder(folder, overwrite) as scratch:
        for frame, name in zip(video, names, strict=True):
            write_picture(scratch / "images" / name, frame.image.cpu().numpy())
            mask = frame.mask
            if mask is not None:
                write_mask(scratch / "masks" / name, mask.cpu().numpy())
        write_model(scratch / "sparse" / "0", model)


def _model(
    frames: Sequence[Frame],
    names: Sequence[str],
    observations: Sequence[Observations],
    triangulation: Triangulation,
) -> pycolmap.Reconstruction:
    """COLMAP's model of posed frames and their points; frame i is image i + 1, point k is point k + 1."""
    import pycolmap

    model = posed_model(frames, names)
    tracks = [pycolmap.Track() for _ in range(len(triangulation))]
    for number, here in enumerate(observations, start=1):
        model.images[number].points2D = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in here.pixels])
        for place, point in enumerate(here.points):
            tracks[point].add_element(number, place)
    for track, position, color, error in zip(
        tracks, triangulation.positions, triangulation.colors, triangulation.errors, strict=True
    ):
        number = model.add_point3D(position, track, color)
        model.points3D[number].error = float(error)
    return model


def write_model(folder: Path, model: pycolmap.Reconstruction) -> None:
    """Write a binary model into a new folder."""
    folder.mkdir(parents=True)
    model.write_binary(str(folder))
