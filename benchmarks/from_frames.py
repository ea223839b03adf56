"""Error of what ``coliags reconstruct`` made of a phantom's frames alone, after alignment by a similarity.

``python benchmarks/from_frames.py video PHANTOM FILM.mp4`` writes the frames of a phantom as a video;
``python benchmarks/from_frames.py errors PHANTOM OUT`` prints the errors of its reconstruction: of the path, and of the
mesh against the surface that the frames show. The similarity is that of the camera positions.
"""

from __future__ import annotations

import argparse
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from coliags_plugin.core.images import read_rgb
from coliags_plugin.geometry.meshes.mesh import read_mesh
from coliags_plugin.geometry.meshes.truth import compare_meshes, read_true_surface
from coliags_plugin.geometry.poses import colmap
from coliags_plugin.geometry.poses.alignment import FrameMatches, align
from coliags_plugin.geometry.poses.trajectory import Trajectory
from coliags_plugin.reconstruction.structure.image_files import list_images
from coliags_plugin.reporting.video import write_video


def write_film(phantom: Path, film: Path) -> None:
    """The frames of a phantom as a video."""
    write_video((read_rgb(path) for path in list_images(phantom / "images")), film, 15.0)


def errors(phantom: Path, out: Path) -> dict[str, float]:
    """Errors of path and mesh, mm, after alignment."""
    found = colmap.read(out / "poses" / "sparse" / "0")
    truth = Trajectory(np.load(phantom / "truth" / "camera_to_world.npy"))
    names = found.names or ()
    places = np.array([int(re.findall(r"\d+", Path(name).stem)[0]) for name in names])
    aligned = align(found, truth, FrameMatches(np.arange(len(places)), places, "name"), with_scale=True)
    mesh = read_mesh(out / "run" / "mesh" / "mesh.ply")
    moved = replace(mesh, vertices=aligned.transform.points(mesh.vertices.astype(np.float64)).astype(np.float32))
    compared = compare_meshes(moved, read_true_surface(phantom))
    return {
        "registered": len(places),
        "frames": len(truth),
        "path_mm": float(np.linalg.norm(np.diff(truth.centers, axis=0), axis=1).sum()),
        "ate_mm": aligned.ate.rmse,
        "scale": aligned.transform.scale,
        "chamfer_mm": compared.chamfer,
        "accuracy_mm": compared.accuracy.mean,
        "accuracy_median_mm": compared.accuracy.median,
        "completeness_mm": compared.completeness.mean,
        "completeness_median_mm": compared.completeness.median,
        "f_1mm": compared.f_at(1.0),
        "f_2mm": compared.f_at(2.0),
        "normal_error_deg": compared.normal_error_median,
    }


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("video", "errors"))
    parser.add_argument("phantom", type=Path)
    parser.add_argument("other", type=Path, help="the video to write, or the reconstruction")
    asked = parser.parse_args()
    if asked.what == "video":
        write_film(asked.phantom, asked.other)
    else:
        print(json.dumps(errors(asked.phantom, asked.other), indent=2))


if __name__ == "__main__":
    main()
