"""Writes scenes with estimated depth in nerfstudio's layout (docs/depth.md)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.files import write_json
from coliags_plugin.core.images import write_image, write_mask
from coliags_plugin.core.ply import point_properties, write_ply
from coliags_plugin.datamanagers.nerfstudio.reader import ESTIMATED_FROM
from coliags_plugin.geometry.poses.rigid import FLIP_Y_AND_Z

_POINTS = "points.ply"


class EstimatedSceneWriter:
    """Writes the frames of a scene one by one, then ``transforms.json`` and the points.

    ``depth_unit`` is in scene units per 16-bit step.
    """

    def __init__(self, folder: Path, depth_unit: float) -> None:
        self.folder, self.depth_unit = folder, depth_unit
        self._frames: list[dict[str, Any]] = []

    def write_frame(
        self,
        name: str,  # unique; the stem of its files
        camera: Camera,  # pinhole of the image, posed
        image: UInt8[np.ndarray, "H W 3"],  # RGB
        mask: Bool[np.ndarray, "H W"] | None,  # False where a pixel is to be ignored; None: nowhere
        depth: Float[np.ndarray, "H W"],  # z-depth, scene units; not positive where unknown
        confidence: Float[np.ndarray, "H W"],  # 0 to 1
    ) -> None:
        """Write the files of a frame."""
        file = f"{name}.png"
        steps = np.clip(np.rint(depth / self.depth_unit), 0, 65535).astype(np.uint16)
        write_image(self.folder / "images" / file, image)
        grey = np.rint(255.0 * confidence).astype(np.uint8)
        for part, values in (("depth", steps), ("confidence", grey)):
            if mask is not None:
                values[~mask] = 0
            write_image(self.folder / part / file, values)
        entry: dict[str, Any] = {
            "file_path": f"images/{file}",
            "depth_file_path": f"depth/{file}",
            "confidence_file_path": f"confidence/{file}",
        }
        if mask is not None:
            write_mask(self.folder / "masks" / file, mask)
            entry["mask_path"] = f"masks/{file}"
        k = camera.intrinsics
        entry |= {"fl_x": k.fx, "fl_y": k.fy, "cx": k.cx, "cy": k.cy, "w": k.width, "h": k.height}
        entry["transform_matrix"] = (camera.camera_to_world.cpu().double().numpy() @ FLIP_Y_AND_Z).tolist()
        self._frames.append(entry)

    def finish(
        self,
        positions: Float[np.ndarray, "N 3"],
        colors: UInt8[np.ndarray, "N 3"],
        sources: Sequence[str],
        split: tuple[Sequence[str], Sequence[str]] | None,
    ) -> None:
        """Write the initial points and ``transforms.json``.

        ``sources`` names the frames that depth and points were made from, ``split`` training and test frames.
        """
        write_ply(self.folder / _POINTS, point_properties(positions, colors))
        listed = {ESTIMATED_FROM: sources}
        if split is not None:
            listed |= {"train_filenames": split[0], "test_filenames": split[1]}
        lists = {key: [f"images/{name}.png" for name in names] for key, names in listed.items()}
        content = {
            "camera_model": "OPENCV",
            "depth_unit_scale_factor": self.depth_unit,
            "ply_file_path": _POINTS,
            **lists,
            "frames": self._frames,
        }
        write_json(self.folder / "transforms.json", content)
