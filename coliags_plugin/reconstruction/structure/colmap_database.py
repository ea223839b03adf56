"""Features and matches in COLMAP's form."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float32

from coliags_plugin.reconstruction.structure.matching import Matches

if TYPE_CHECKING:
    import pycolmap


def write_database(
    path: Path,
    cameras: Sequence[pycolmap.Camera],
    images: Sequence[tuple[str, int]],
    keypoints: Sequence[Float32[np.ndarray, "K D"]],
    matches: Matches,
    first_index: int = 0,
) -> None:
    """Create a database; image i gets COLMAP's image and frame ID i + 1, camera k its camera and rig ID k + 1.

    Images are counted from ``first_index``, those of the matches too. COLMAP has to verify the matches.
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
            if len(pairs):
                database.write_matches(first + 1, second + 1, np.ascontiguousarray(pairs, np.uint32))
    finally:
        database.close()
