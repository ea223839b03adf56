"""REIM-NeRF's layout of preprocessed C3VD (docs/layouts/reim-nerf.md)."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from coliags_plugin.datamanagers.reim_nerf.files import C3VD_RANGE, ray_cosines
from coliags_plugin.lenses.models import LENSES, FisheyeLens, Lens
from coliags_plugin.phantom.layouts.base import Layout, Part
from coliags_plugin.phantom.layouts.pictures import write_image
from coliags_plugin.poses.rigid import FLIP_Y_AND_Z

#: Normalised units per mm. REIM-NeRF's own are 0.0092 to 0.0229, so that a scene lies between -1 and 1.
SCENE_SCALE = 0.0095
#: Normalised distance of the number 65535.
DISTMAP_SCALE = math.pi
#: The scene's middle, mm ahead of the path's.
_AHEAD = 30.0


class ReimNerfLayout(Layout):
    """Fisheye pictures in a circle, distance maps, rgb_mask.png, and a JSON file for each part."""

    default_size = (1350, 1080)

    def lens(self, width: int, height: int) -> tuple[Lens, Bool[np.ndarray, "H W"]]:
        """REIM-NeRF's lens, and the circle that its preprocessing keeps."""
        lens = _lens(width, height)
        k = lens.pinhole
        radius = max(min(k.cx, width - k.cx), min(k.cy, height - k.cy)) - 20.0 * width / 1350.0
        column, row = np.meshgrid(np.arange(width), np.arange(height))
        return lens, np.hypot(column - k.cx, row - k.cy) <= radius

    def is_test(self, index: int) -> bool:
        """All but REIM-NeRF's training frames, its validation frames among them."""
        return index % 5 != 0 or _validates(index)

    def write_frame(
        self,
        folder: Path,
        part: Part,
        index: int,
        color: UInt8[np.ndarray, "H W 3"],
        z_depth: Float[np.ndarray, "H W"],
        normals: Float[np.ndarray, "H W 3"],
    ) -> None:
        """See :class:`Layout`; normals are not part of this layout. Depth ends at C3VD's 100 mm."""
        height, width = z_depth.shape
        cosine = _cosines(width, height)
        clipped = np.minimum(z_depth.astype(np.float64), C3VD_RANGE)
        distance = np.divide(clipped, cosine, out=np.zeros_like(clipped), where=cosine > 0.0)
        steps = np.rint(distance * (SCENE_SCALE / DISTMAP_SCALE * 65535.0))
        write_image(folder / "images" / _name(index), color)
        write_image(folder / "distmaps" / _name(index), np.clip(steps, 0.0, 65535.0).astype(np.uint16))

    def write_sequence(self, folder: Path, part: Part, poses: Sequence[Float[np.ndarray, "4 4"]], lens: Lens) -> None:
        """See :class:`Layout`."""
        _, shows = self.lens(lens.width, lens.height)
        write_image(folder / "rgb_mask.png", np.where(shows, 0, 255).astype(np.uint8))
        stacked = np.stack(poses)
        shift = np.eye(4)
        shift[:3, 3] = -(stacked[:, :3, 3] + _AHEAD * stacked[:, :3, 2]).mean(axis=0)
        camera = _camera(_lens(lens.width, lens.height)) | {"scene_T": shift.tolist()}
        frames = [_frame(folder, index, pose, shift[:3, 3]) for index, pose in enumerate(poses)]
        for name, places in _parts(len(poses)).items():
            content = {**camera, "frames": [frames[place] for place in places]}
            (folder / f"transforms_{name}.json").write_text(json.dumps(content, indent=2) + "\n")


def _lens(width: int, height: int) -> Lens:
    return LENSES["fisheye"].scaled(width, height)


@lru_cache(maxsize=1)
def _cosines(width: int, height: int) -> Float[np.ndarray, "H W"]:
    return ray_cosines(_lens(width, height)).astype(np.float64)


def _name(index: int) -> str:
    return f"{index:04d}_color.png"


def _camera(lens: Lens) -> dict[str, Any]:
    if not isinstance(lens, FisheyeLens):
        raise TypeError("REIM-NeRF's lens is a fisheye")
    k = lens.pinhole
    return {
        "camera_model": "FISHEYE_OPENCV",
        **{"fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy},
        **{"k1": lens.k1, "k2": lens.k2, "k3": lens.k3, "k4": lens.k4, "p1": 0.0, "p2": 0.0},
        "w": lens.width,
        "h": lens.height,
        "camera_angle_x": 2.0 * math.atan(lens.width / (2.0 * k.fx)),
        "camera_angle_y": 2.0 * math.atan(lens.height / (2.0 * k.fy)),
        "scene_scale": SCENE_SCALE,
        "dist_ftype": "png",
        "distmap": True,
        "rgb_mask": "rgb_mask.png",
        "distmap_scale": DISTMAP_SCALE,
    }


def _frame(folder: Path, index: int, pose: Float[np.ndarray, "4 4"], shift: Float[np.ndarray, "3"]) -> dict[str, Any]:
    normalised = pose @ FLIP_Y_AND_Z
    normalised[:3, 3] = (normalised[:3, 3] + shift) * SCENE_SCALE
    steps = cv2.imread(str(folder / "distmaps" / _name(index)), cv2.IMREAD_UNCHANGED)
    known = steps[steps > 0] * (DISTMAP_SCALE / 65535.0) if steps is not None else np.zeros(0)
    return {
        "file_path": f"images/{_name(index)}",
        "distmap_path": f"distmaps/{_name(index)}",
        "near": 0.9 * float(known.min(initial=DISTMAP_SCALE)),
        "far": 1.1 * float(known.max(initial=0.0)),
        "transform_matrix": normalised.tolist(),
    }


def _validates(index: int) -> bool:
    return index % 25 == 0 and index > 0


def _parts(count: int) -> dict[str, list[int]]:
    """REIM-NeRF's own division: every fifth frame, of those every fifth but the first for validation."""
    fifth = range(0, count, 5)
    return {
        "train": [place for place in fifth if not _validates(place)],
        "val": [place for place in fifth if _validates(place)],
        "test": list(range(count)),
        "true_test": [place for place in range(count) if place % 5],
    }
