"""Cameras and meshes as nodes of viser's scenes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

from coliags_plugin.core.cameras import Camera
from coliags_plugin.export.viewer.content import ViewerContent, vertical_fov
from coliags_plugin.geometry.meshes.files import encode_mesh
from coliags_plugin.geometry.meshes.mesh import TriangleMesh
from coliags_plugin.outputs.image_files import as_array

#: Frusta that are drawn, at most.
MOST_CAMERAS = 40
#: Size of a frustum: of the distance between those drawn, and at most of the distance that the first frame sees.
_SIZE_OF_STEP, _SIZE_OF_DEPTH = 1.0, 0.03
#: Width of the pictures in them, px.
_PICTURE_WIDTH = 96
_LINE_SHARE = 0.03
_COLOR = (30, 120, 200)
#: Intensities; together they show a surface seen from the front in its own colour.
_AMBIENT, _HEADLIGHT = 1.4, 1.8


def add_cameras(scene: Any, content: ViewerContent, chosen: Callable[[int], None] | None = None) -> list[Any]:
    """Add a frustum with its picture for the frames of the video, or for every n-th of many.

    ``chosen`` is called with the index, in the video, of a frame whose frustum was clicked.
    """
    frames = content.frames
    indices = range(0, len(frames), -(-len(frames) // MOST_CAMERAS))
    size = frustum_size([frames[index].camera for index in indices], content.look_distance)
    handles = []
    for index in indices:
        camera, image = frames[index].camera, as_array(frames[index].image)
        small = _PICTURE_WIDTH, max(1, round(image.shape[0] * _PICTURE_WIDTH / image.shape[1]))
        wxyz, position = pose(camera)
        handle = scene.add_camera_frustum(
            f"/cameras/{frames[index].name}",
            vertical_fov(camera),
            camera.width / camera.fx * camera.fy / camera.height,
            scale=size,
            thickness=_LINE_SHARE * size,
            color=_COLOR,
            image=cv2.resize(image, small, interpolation=cv2.INTER_AREA),
            wxyz=wxyz,
            position=position,
        )
        if chosen is not None:
            handle.on_click(lambda _, index=index: chosen(index))
        handles.append(handle)
    return handles


def frustum_size(cameras: Sequence[Camera], distance: float) -> float:
    """Length of frusta along the path, scene units, such that they neither merge nor fill the view.

    ``distance`` is that which the first of them sees.
    """
    centers = np.stack([as_array(camera.center).astype(np.float64) for camera in cameras])
    largest = _SIZE_OF_DEPTH * distance
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    step = float(np.median(steps)) if len(steps) else 0.0
    return min(largest, _SIZE_OF_STEP * step) if step > 0.0 else largest


def pose(camera: Camera) -> tuple[Float[np.ndarray, "4"], Float[np.ndarray, "3"]]:
    """Rotation (wxyz) and position of a camera in the world, in OpenCV's axes as viser has them."""
    from viser.transforms import SO3

    matrix = camera.camera_to_world.double().cpu().numpy()
    return SO3.from_matrix(matrix[:3, :3]).wxyz, matrix[:3, 3]


def add_mesh(scene: Any, name: str, mesh: TriangleMesh) -> Any:
    """Add a mesh as a layer, with the colours of its vertices where it has any, seen from both sides."""
    node = "/" + name.replace(": ", "/").replace(" ", "-")
    return scene.add_glb(node, encode_mesh(mesh), cast_shadow=False, receive_shadow=False)


def add_headlight(scene: Any, position: tuple[float, float, float]) -> Any:
    """Add a light for meshes that is to move with the camera, alike at all distances, and dim light from everywhere."""
    scene.add_light_ambient("/lights/everywhere", intensity=_AMBIENT)
    return scene.add_light_point("/lights/camera", intensity=_HEADLIGHT, decay=0.0, position=position)
