"""Millimetres per unit of a model, from the colon's diameter or the distance between two cameras."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from coliags_plugin.core.errors import InputError
from coliags_plugin.reconstruction.structure.sfm import Atlas, Reconstruction

log = logging.getLogger(__name__)

#: Least number of points beside the path for an estimate of the diameter.
_FEWEST_BESIDE = 30


def millimetres(
    reconstruction: Reconstruction, diameter: float | None = None, distance: tuple[str, str, float] | None = None
) -> float | None:
    """Millimetres per unit of a model; None where the scale stays unknown, with a warning.

    Known are the colon's typical inner diameter, mm, or the names of two images and their cameras' distance, mm, which
    takes precedence.
    """
    try:
        if distance is not None:
            return from_distance(reconstruction, *distance)
        return None if diameter is None else from_diameter(reconstruction, diameter)
    except InputError as error:
        # The poses took minutes: they are kept all the same.
        log.warning("%s The scale stays unknown", error)
        return None


def distances_beside(path: Float[np.ndarray, "M 3"], points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "K"]:
    """Distances of points from a polyline, without the points ahead of and behind it."""
    start, along = path[:-1], np.diff(path, axis=0)
    squares = np.maximum((along**2).sum(axis=1), 1e-30)
    best = np.full(len(points), np.inf)
    where = np.zeros(len(points))
    for index, (origin, direction, square) in enumerate(zip(start, along, squares, strict=True)):
        share = np.clip((points - origin) @ direction / square, 0.0, 1.0)
        distance = np.linalg.norm(points - origin - share[:, None] * direction, axis=1)
        nearer = distance < best
        best[nearer], where[nearer] = distance[nearer], index + share[nearer]
    return best[(where > 0.0) & (where < len(along))]


def from_diameter(reconstruction: Reconstruction, diameter: float) -> float:
    """Millimetres per unit, for a colon whose inner diameter, mm, is twice the wall's median distance from the path."""
    points = np.array([point.xyz for point in reconstruction.model.points3D.values()]).reshape(-1, 3)
    beside = distances_beside(reconstruction.camera_to_world[:, :3, 3], points)
    if len(beside) < _FEWEST_BESIDE:
        raise InputError(
            f"--diameter {diameter:g}, and {len(beside)} of {len(points)} points lie beside the camera's path",
            f"at least {_FEWEST_BESIDE}",
            "Take a longer part of the video, or give the distance of two cameras (--distance), or neither",
        )
    return float(diameter / (2.0 * np.median(beside)))


def from_distance(reconstruction: Reconstruction, first: str, second: str, distance: float) -> float:
    """Millimetres per unit, from a known distance, mm, between the cameras of two images, by file name or stem."""
    rows = {}
    for row, index in enumerate(reconstruction.registered):
        rows[reconstruction.images[index].stem] = rows[reconstruction.images[index].name] = row
    for name in (first, second):
        if name not in rows:
            raise InputError(f"--distance: no image '{name}' with a pose", "two of the registered images, by name")
    centers = reconstruction.camera_to_world[[rows[first], rows[second]], :3, 3]
    units = float(np.linalg.norm(centers[1] - centers[0]))
    if not units > 0.0:
        raise InputError(f"--distance: the cameras of {first} and {second} coincide", "two positions")
    return distance / units


def scaled(reconstruction: Reconstruction, factor: float) -> Reconstruction:
    """The model with positions of cameras and points multiplied by a factor."""
    import pycolmap

    model = pycolmap.Reconstruction(reconstruction.model)
    model.transform(pycolmap.Sim3d(factor, pycolmap.Rotation3d(), np.zeros(3)))
    camera_to_world = reconstruction.camera_to_world.copy()
    camera_to_world[:, :3, 3] *= factor
    return replace(reconstruction, model=model, camera_to_world=camera_to_world)


def atlas_scaled(atlas: Atlas, factor: float) -> Atlas:
    """The atlas with its largest model in units of ``factor``."""
    return replace(atlas, models=(scaled(atlas.largest, factor), *atlas.models[1:]))
