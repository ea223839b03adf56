"""Writes REIM-NeRF's layout of preprocessed C3VD (docs/layouts/reim-nerf.md)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8

from coliags_plugin.core.files import write_json
from coliags_plugin.core.images import write_image
from coliags_plugin.datamanagers.reim_nerf.files import C3VD_RANGE, ray_cosines
from coliags_plugin.geometry.lenses.models import FisheyeLens
from coliags_plugin.geometry.poses.rigid import FLIP_Y_AND_Z

MASK = "rgb_mask.png"


@dataclass
class ReimNerfWriter:
    """Writes the frames of one sequence, then its mask and JSON files.

    Attributes:
        folder: Folder of the sequence.
        lens: Lens of all frames, at their size.
        scene_scale: Normalised units per mm.
        distmap_scale: Normalised distance of the stored value 65535.
    """

    folder: Path
    lens: FisheyeLens
    scene_scale: float
    distmap_scale: float
    _ranges: dict[int, tuple[float, float]] = field(default_factory=dict)

    def write_frame(self, index: int, image: UInt8[np.ndarray, "H W 3"], z_depth: Float[np.ndarray, "H W"]) -> None:
        """Write a frame; z-depth is clipped at C3VD's 100 mm.

        Args:
            index: Index of the frame, from 0.
            image: RGB, as the lens shows it. [H, W, 3]
            z_depth: mm; 0 where unknown. [H, W]
        """
        clipped = np.minimum(z_depth.astype(np.float64), C3VD_RANGE)
        cosine = self._cosines
        distance = np.divide(clipped, cosine, out=np.zeros_like(clipped), where=cosine > 0.0)
        steps = np.rint(distance * (self.scene_scale / self.distmap_scale * 65535.0))
        stored = np.clip(steps, 0.0, 65535.0).astype(np.uint16)
        write_image(self.folder / "images" / _name(index), image)
        write_image(self.folder / "distmaps" / _name(index), stored)
        known = stored[stored > 0] * (self.distmap_scale / 65535.0)
        nearest, farthest = float(known.min(initial=self.distmap_scale)), float(known.max(initial=0.0))
        self._ranges[index] = (0.9 * nearest, 1.1 * farthest)

    def write_sequence(
        self,
        camera_to_world: Float[np.ndarray, "N 4 4"],
        shift: Float[np.ndarray, "3"],
        shows: Bool[np.ndarray, "H W"],
        parts: dict[str, list[int]],
    ) -> None:
        """Write the mask and a JSON file per part, after all frames.

        Args:
            camera_to_world: OpenCV axes, mm. [N, 4, 4]
            shift: Offset added to positions before scaling, mm. [3]
            shows: Valid pixels. [H, W]
            parts: Frame indices by name of the part.
        """
        write_image(self.folder / MASK, np.where(shows, 0, 255).astype(np.uint8))
        frames = [self._frame(index, pose, shift) for index, pose in enumerate(camera_to_world)]
        to_middle = np.eye(4)
        to_middle[:3, 3] = shift
        camera = {**self._camera(), "scene_T": to_middle.tolist()}
        for name, indices in parts.items():
            content = {**camera, "frames": [frames[index] for index in indices]}
            write_json(self.folder / f"transforms_{name}.json", content)

    @cached_property
    def _cosines(self) -> Float[np.ndarray, "H W"]:
        return ray_cosines(self.lens).astype(np.float64)

    def _camera(self) -> dict[str, Any]:
        lens, k = self.lens, self.lens.pinhole
        return {
            "camera_model": "FISHEYE_OPENCV",
            # Pixel centres at integers, as OpenCV calibrates.
            **{"fx": k.fx, "fy": k.fy, "cx": k.cx - 0.5, "cy": k.cy - 0.5},
            **{"k1": lens.k1, "k2": lens.k2, "k3": lens.k3, "k4": lens.k4, "p1": 0.0, "p2": 0.0},
            "w": lens.width,
            "h": lens.height,
            "camera_angle_x": 2.0 * math.atan(lens.width / (2.0 * k.fx)),
            "camera_angle_y": 2.0 * math.atan(lens.height / (2.0 * k.fy)),
            "scene_scale": self.scene_scale,
            "dist_ftype": "png",
            "distmap": True,
            "rgb_mask": MASK,
            "distmap_scale": self.distmap_scale,
        }

    def _frame(self, index: int, pose: Float[np.ndarray, "4 4"], shift: Float[np.ndarray, "3"]) -> dict[str, Any]:
        normalised = pose @ FLIP_Y_AND_Z
        normalised[:3, 3] = (normalised[:3, 3] + shift) * self.scene_scale
        near, far = self._ranges[index]
        return {
            "file_path": f"images/{_name(index)}",
            "distmap_path": f"distmaps/{_name(index)}",
            "near": near,
            "far": far,
            "transform_matrix": normalised.tolist(),
        }


def _name(index: int) -> str:
    return f"{index:04d}_color.png"
