"""Features, matches and posed frames in COLMAP's form."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float32

from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.core.scenes import Frame
from coliags_plugin.geometry.poses.colmap import posed_model
from coliags_plugin.geometry.poses.rigid import inverse
from coliags_plugin.reconstruction.structure.matching import Matches

if TYPE_CHECKING:
    import pycolmap


def write_database(
    path: Path,
    cameras: Sequence[pycolmap.Camera],
    images: Sequence[tuple[str, int]],
    keypoints: Sequence[Float32[np.ndarray, "K D"]],
    matches: Matches,
    verified: bool,
    first_index: int = 0,
) -> None:
    """Create a database; image i gets COLMAP's image and frame ID i + 1, camera k its camera and rig ID k + 1.

    Images are counted from ``first_index``, those of the matches too. Matches that are ``verified`` are stored as
    inliers of a two-view geometry; the others COLMAP has to verify.
    """
    import pycolmap

    database = pycolmap.Database.open(str(path))
    try:
        for number, camera in enumerate(cameras, start=1):
            camera.camera_id = number
            database.write_camera(camera, use_camera_id=True)
            rig = pycolmap.Rig(rig_id=number)
            rig.add_ref_sensor(camera.sensor_id)
            database.write_rig(rig, use_rig_id=True)
        numbered = enumerate(zip(images, keypoints, strict=True), start=first_index + 1)
        for number, ((name, camera_index), image_keypoints) in numbered:
            image = pycolmap.Image(name=name, camera_id=camera_index + 1, image_id=number)
            database.write_image(image, use_image_id=True)
            frame = pycolmap.Frame(frame_id=number, rig_id=camera_index + 1)
            frame.add_data_id(image.data_id)
            database.write_frame(frame, use_frame_id=True)
            database.write_keypoints(number, np.ascontiguousarray(image_keypoints))
        for (first, second), pairs in matches.items():
            if not len(pairs):
                continue
            rows = np.ascontiguousarray(pairs, np.uint32)
            if not verified:
                database.write_matches(first + 1, second + 1, rows)
                continue
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            geometry.inlier_matches = rows
            database.write_two_view_geometry(first + 1, second + 1, geometry)
    finally:
        database.close()


def frame_model(frames: Sequence[Frame], names: Sequence[str] | None = None) -> pycolmap.Reconstruction:
    """A reconstruction of posed frames without points: frame i is COLMAP's image i + 1, equal cameras are shared."""
    import pycolmap

    camera_to_world = np.stack([frame.camera.camera_to_world.cpu().double().numpy() for frame in frames])
    names = [f"{index}.png" for index in range(len(frames))] if names is None else names
    cameras: dict[Intrinsics, int] = {}
    camera_indices = [cameras.setdefault(frame.camera.intrinsics, len(cameras)) for frame in frames]
    world_to_camera = [pycolmap.Rigid3d(matrix[:3]) for matrix in inverse(camera_to_world)]
    return posed_model(world_to_camera, names, list(cameras), camera_indices)
