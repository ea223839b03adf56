"""REIM-NeRF's layout of preprocessed C3VD (docs/layouts/reim-nerf.md)."""

from __future__ import annotations

import math

import numpy as np

from coliags_plugin.core.files import write_json
from coliags_plugin.core.images import write_image
from coliags_plugin.datamanagers.reim_nerf import C3VD_RANGE, MASK_FILE, PARTS, ray_cosines
from coliags_plugin.geometry.lenses.models import LENSES
from coliags_plugin.geometry.poses.trajectory import FLIP_Y_AND_Z
from coliags_plugin.phantom.layouts import Layout

#: Normalised units per mm. REIM-NeRF's own are 0.0092 to 0.0229, so that a scene lies between -1 and 1.
SCENE_SCALE = 0.0095
#: Normalised distance of the stored value 65535.
DISTMAP_SCALE = math.pi
#: The scene's middle, mm ahead of the path's.
_AHEAD = 30.0


class ReimNerfLayout(Layout):
    """Circular fisheye images, distance maps, rgb_mask.png, and a JSON file per part."""

    name = "reim-nerf"
    default_size = (1350, 1080)

    def lens(self, width, height):
        """REIM-NeRF's lens, and the circle that its preprocessing keeps."""
        lens = LENSES["fisheye"].resized(width, height)
        # Its preprocessing counts pixel centres at integers.
        cx, cy = lens.pinhole.cx - 0.5, lens.pinhole.cy - 0.5
        radius = max(min(cx, width - cx), min(cy, height - cy)) - 20.0 * width / 1350.0
        column, row = np.meshgrid(np.arange(width), np.arange(height))
        return lens, np.hypot(column - cx, row - cy) <= radius

    def is_test(self, index):
        """All but REIM-NeRF's training frames, its validation frames among them."""
        return index % 5 != 0 or _validates(index)

    def write_frame(self, folder, frame):
        clipped = np.minimum(frame.z_depth.astype(np.float64), C3VD_RANGE)
        height, width = clipped.shape
        cosines = ray_cosines(LENSES["fisheye"].resized(width, height)).astype(np.float64)
        distance = np.divide(clipped, cosines, out=np.zeros_like(clipped), where=cosines > 0.0)
        steps = np.rint(distance * (SCENE_SCALE / DISTMAP_SCALE * 65535.0))
        stored = np.clip(steps, 0.0, 65535.0).astype(np.uint16)
        write_image(folder / "images" / _name(frame.index), frame.color)
        write_image(folder / "distmaps" / _name(frame.index), stored)

    def write_sequence(self, folder, part, poses, lens):
        _, lit = self.lens(lens.width, lens.height)
        write_image(folder / MASK_FILE, np.where(lit, 0, 255).astype(np.uint8))
        shift = -(poses[:, :3, 3] + _AHEAD * poses[:, :3, 2]).mean(axis=0)
        to_middle = np.eye(4)
        to_middle[:3, 3] = shift
        frames = []
        for index, pose in enumerate(poses):
            normalised = pose @ FLIP_Y_AND_Z
            normalised[:3, 3] = (normalised[:3, 3] + shift) * SCENE_SCALE
            names = {"file_path": f"images/{_name(index)}", "distmap_path": f"distmaps/{_name(index)}"}
            frames.append({**names, "transform_matrix": normalised.tolist()})
        camera = {**_camera(lens), "scene_T": to_middle.tolist()}
        for name in PARTS:
            held = [frame for index, frame in enumerate(frames) if name in _parts_of(index)]
            write_json(folder / f"transforms_{name}.json", {**camera, "frames": held})


def _camera(lens):
    k = lens.pinhole
    return {
        "camera_model": "FISHEYE_OPENCV",
        # Pixel centres at integers, as OpenCV calibrates.
        **{"fx": k.fx, "fy": k.fy, "cx": k.cx - 0.5, "cy": k.cy - 0.5},
        **{"k1": lens.k1, "k2": lens.k2, "k3": lens.k3, "k4": lens.k4, "p1": 0.0, "p2": 0.0},
        "w": lens.width,
        "h": lens.height,
        "scene_scale": SCENE_SCALE,
        "dist_ftype": "png",
        "distmap": True,
        "rgb_mask": MASK_FILE,
        "distmap_scale": DISTMAP_SCALE,
    }


def _validates(index):
    return index % 25 == 0 and index > 0


def _parts_of(index):
    """REIM-NeRF's split: every fifth frame trains, of those every fifth but the first validates; all are ``test``."""
    if index % 5:
        return "test", "true_test"
    return "test", "val" if _validates(index) else "train"


def _name(index):
    return f"{index:04d}_color.png"
