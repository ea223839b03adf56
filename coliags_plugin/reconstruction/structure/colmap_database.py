"""Features and matches in the form COLMAP takes them: its database."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from coliags_plugin.reconstruction.structure.features import Features
from coliags_plugin.reconstruction.structure.matching import Pairs

if TYPE_CHECKING:
    import pycolmap


def write_database(
    path: Path,
    cameras: Sequence[pycolmap.Camera],
    pictures: Sequence[tuple[str, int]],
    features: Sequence[Features],
    matches: Mapping[tuple[int, int], Pairs],
    verified: bool,
) -> None:
    """Make a database. Picture i gets COLMAP's image and frame number i + 1, camera k its camera and rig number k + 1.

    Args:
        path: The file to make.
        cameras: Their numbers are set.
        pictures: Name, and which camera took it.
        features: Of each picture.
        matches: Of pairs of pictures, counted from 0.
        verified: Whether the matches obey a geometry of two views already; otherwise COLMAP has to find one.
    """
    import numpy as np
    import pycolmap

    database = pycolmap.Database.open(str(path))
    try:
        for number, camera in enumerate(cameras, start=1):
            camera.camera_id = number
            database.write_camera(camera, use_camera_id=True)
            rig = pycolmap.Rig(rig_id=number)
            rig.add_ref_sensor(camera.sensor_id)
            database.write_rig(rig, use_rig_id=True)
        for number, ((name, camera_index), found) in enumerate(zip(pictures, features, strict=True), start=1):
            image = pycolmap.Image(name=name, camera_id=camera_index + 1, image_id=number)
            database.write_image(image, use_image_id=True)
            frame = pycolmap.Frame(frame_id=number, rig_id=camera_index + 1)
            frame.add_data_id(image.data_id)
            database.write_frame(frame, use_frame_id=True)
            database.write_keypoints(number, found.keypoints)
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
