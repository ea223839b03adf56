"""The tilted wall of ``wall_scenes`` as a COLMAP scene, through any of COLMAP's cameras, with points and tracks."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pycolmap

from tests.datamanagers.wall_scenes import colors, look, poses

WIDTH, HEIGHT = 64, 48
#: Off-centre; pixel centres at integers + 0.5. One set of parameters for every model that takes images.
_F, _FF, _C = [61.0], [61.0, 55.0], [33.5, 21.5]
CAMERAS = {
    "SIMPLE_PINHOLE": [*_F, *_C],
    "PINHOLE": [*_FF, *_C],
    "SIMPLE_RADIAL": [*_F, *_C, -0.12],
    "RADIAL": [*_F, *_C, -0.15, 0.03],
    "OPENCV": [*_FF, *_C, -0.15, 0.03, 0.003, -0.004],
    "FULL_OPENCV": [*_FF, *_C, -0.15, 0.03, 0.003, -0.004, 0.01, 0.02, 0.01, 0.005],
    "FOV": [*_FF, *_C, 0.7],
    "SIMPLE_RADIAL_FISHEYE": [*_F, *_C, -0.05],
    "RADIAL_FISHEYE": [*_F, *_C, -0.05, 0.01],
    "OPENCV_FISHEYE": [*_FF, *_C, -0.05, 0.01, 0.003, -0.001],
    "THIN_PRISM_FISHEYE": [*_FF, *_C, -0.05, 0.01, 0.002, -0.001, 0.0, 0.0, 0.001, -0.002],
    "RAD_TAN_THIN_PRISM_FISHEYE": [*_FF, *_C, -0.05, 0.01, 0, 0, 0, 0, 0.002, -0.001, 0.001, 0, -0.001, 0],
    "SIMPLE_DIVISION": [*_F, *_C, -0.1],
    "DIVISION": [*_FF, *_C, -0.1],
    "SIMPLE_FISHEYE": [*_F, *_C],
    "FISHEYE": [*_FF, *_C],
    "EUCM": [*_FF, *_C, 0.5, 1.1],
}
#: Points on the wall, all of them seen in every image that they fall into.
POINTS = 120


def camera(model: str = "PINHOLE", number: int = 1, width: int = WIDTH, height: int = HEIGHT) -> pycolmap.Camera:
    return pycolmap.Camera(camera_id=number, model=model, width=width, height=height, params=CAMERAS[model])


def taken(cam: pycolmap.Camera, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """z-depth and colour as a camera takes them; pycolmap says where its pixels look."""
    columns, rows = np.meshgrid(np.arange(cam.width) + 0.5, np.arange(cam.height) + 0.5)
    xy = cam.cam_from_img(np.stack([columns.ravel(), rows.ravel()], axis=1).astype(float))
    directions = np.concatenate([xy, np.ones((len(xy), 1))], axis=1).reshape(cam.height, cam.width, 3)
    return look(pose, directions)


def wall_model(cameras: list[pycolmap.Camera], names: list[str], unit: float = 1.0) -> pycolmap.Reconstruction:
    """Image i is taken from pose i by camera i, round and round; lengths in units of ``unit`` mm."""
    model = pycolmap.Reconstruction()
    for cam in cameras:
        model.add_camera_with_trivial_rig(cam)
    # Points that the first camera sees from the first pose.
    generator = np.random.default_rng(0)
    pixels = generator.uniform(2, [cameras[0].width - 2, cameras[0].height - 2], (POINTS, 2))
    directions = np.concatenate([cameras[0].cam_from_img(pixels), np.ones((POINTS, 1))], axis=1)
    start = poses(len(names))[0]
    depth, _ = look(start, directions)
    points = start[:3, 3] + depth[:, None] * directions @ start[:3, :3].T
    tracks: list[list[pycolmap.TrackElement]] = [[] for _ in points]
    for index, (name, pose) in enumerate(zip(names, poses(len(names)), strict=True)):
        cam = cameras[index % len(cameras)]
        rotation = pose[:3, :3].T
        seen = cam.img_from_cam((points - pose[:3, 3]) @ pose[:3, :3])
        image = pycolmap.Image(name=name, camera_id=cam.camera_id, image_id=index + 1)
        inside = (seen > 0).all(axis=1) & (seen < (cam.width, cam.height)).all(axis=1)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(place) for place in seen[inside]])
        for place, number in enumerate(np.flatnonzero(inside)):
            tracks[number].append(pycolmap.TrackElement(index + 1, place))
        world_to_camera = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ pose[:3, 3] / unit)
        model.add_image_with_trivial_frame(image, world_to_camera)
    for point, color, track in zip(points, colors(points), tracks, strict=True):
        model.add_point3D(point / unit, pycolmap.Track(track), color)
    model.update_point_3d_errors()
    return model


def write_colmap(
    folder: Path,
    cameras: list[pycolmap.Camera] | None = None,
    names: list[str] | None = None,
    place: str = "sparse/0",
    text: bool = False,
    unit: float = 1.0,
) -> Path:
    """The wall, its model in ``place`` and its images in ``images``."""
    cameras = cameras or [camera()]
    names = names or [f"{index}.png" for index in range(9)]
    model = wall_model(cameras, names, unit)
    (folder / place).mkdir(parents=True, exist_ok=True)
    (model.write_text if text else model.write_binary)(str(folder / place))
    for index, (name, pose) in enumerate(zip(names, poses(len(names)), strict=True)):
        path = folder / "images" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), taken(cameras[index % len(cameras)], pose)[1][..., ::-1])
    return folder
