"""Properties of phantoms on disk: gain, distances, clipping and rotation, as a Markdown table.

python benchmarks/phantom_properties.py FOLDER ...
"""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import tyro
from machine import markdown_table

from coliags_plugin.geometry.meshes.mesh import read_mesh

#: Grey level of 255 from which a channel counts as saturated.
SATURATED = 250


@dataclass(frozen=True)
class Options:
    """Measure phantoms in the layout c3vd."""

    folders: tyro.conf.Positional[tuple[Path, ...]]
    """Folders that `coliags phantom` wrote."""


def properties(folder: Path) -> dict[str, str]:
    """The row of one phantom."""
    with (folder / "truth" / "gain.csv").open() as file:
        gain = np.array([float(row["gain_g"]) for row in csv.DictReader(file)])
    poses, wall = np.load(folder / "truth" / "camera_to_world.npy"), read_mesh(folder / "truth" / "mesh.ply")
    nearest, middle, saturated = [], [], []
    for path in sorted((folder / "images").iterdir()):
        image = cv2.imread(str(path))
        depth = cv2.imread(str(folder / "depths" / path.name.replace("color", "depth")), cv2.IMREAD_UNCHANGED)
        clear = depth[(depth > 0) & (depth < 65535)] * (100.0 / 65535.0)
        nearest.append(clear.min())
        middle.append(np.median(clear))
        saturated.append(100.0 * (image >= SATURATED).any(axis=2).mean())
    shares = [(cv2.imread(str(path), 0) > 0).mean() for path in sorted((folder / "rotation" / "seen").glob("*.png"))]
    settings = json.loads((folder / "phantom.json").read_text())["settings"]
    looks = poses[:, :3, 2]
    mean = looks.mean(axis=0) / np.linalg.norm(looks.mean(axis=0))
    turns = np.einsum("tij,tij->t", poses[1:, :3, :3], poses[:-1, :3, :3])
    return {
        "scene": f"`{folder.name}`",
        "light": settings["light"],
        "gain": settings["gain"],
        "gain swing": f"{gain.max() / gain.min():.2f}",
        "wall to camera, mm": f"{wall.rays.distance(poses[:, :3, 3]).min():.1f}",
        "nearest surface, mm": f"{min(nearest):.1f}",
        "median depth, mm (range over frames)": f"{np.median(middle):.0f} ({min(middle):.0f} to {max(middle):.0f})",
        "saturated pixels, % (largest of a frame)": f"{np.mean(saturated):.1f} ({max(saturated):.0f})",
        "viewing direction from its mean, degrees": f"{np.degrees(np.arccos(np.clip(looks @ mean, -1, 1))).max():.0f}",
        "largest step, mm": f"{np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).max():.2f}",
        "largest turn per frame, degrees": f"{np.degrees(np.arccos(np.clip(0.5 * (turns - 1.0), -1, 1))).max():.1f}",
        "rotation views seen, %": f"{100.0 * np.mean(shares):.0f}" if shares else "",
    }


if __name__ == "__main__":
    print(markdown_table([properties(folder) for folder in tyro.cli(Options).folders]))
