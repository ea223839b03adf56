"""Errors of the mesh fused from the depth of a scene itself, as if a run had rendered it.

``python benchmarks/mesh_depth.py SCENE PHANTOM [NAME=VALUE ...]`` takes the scene of estimated depth that ``coliags
depth PHANTOM`` writes, or the phantom for exact depth, and options of meshing; it prints the errors against
the surface that the phantom's frames show.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch

from coliags_plugin.config.yaml_tree import parse_assignments
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.render_output import RenderOutput
from coliags_plugin.core.scenes import Scene, View
from coliags_plugin.core.settings import validated
from coliags_plugin.engine.data_formats import open_scene
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.engine.trained import TrainedRun
from coliags_plugin.geometry.meshes.truth import compare_meshes, read_true_surface
from coliags_plugin.surface.meshing.fusion import fuse_run
from coliags_plugin.surface.meshing.views import MeshSettings


class DepthModel:
    """Renders the images and the depth of the training frames; opaque where there is depth."""

    def __init__(self, scene: Scene) -> None:
        self._frames = {frame.name: frame for frame in scene.train}

    def check_outputs(self, wants: Sequence[str], asking: str) -> None:
        """It has all outputs."""

    def render(self, camera: Camera, wants: Sequence[str] = (), view: View | None = None) -> RenderOutput:
        """The frame of a view."""
        frame = self._frames[view.name]
        depth = frame.depth.nan_to_num(0.0)
        maps = {name: depth for name in wants if name.startswith("depth")}
        return RenderOutput(frame.rgb, (depth > 0).float(), camera, maps)


def errors(scene: Scene, phantom: Path, settings: MeshSettings) -> dict[str, float]:
    """Errors of the mesh of a scene's depth, mm and degrees."""
    model: Any = DepthModel(scene)
    config: Any = SimpleNamespace()
    run = TrainedRun(RunFolder(Path("none")), config, "depth", scene, model, 0, torch.device("cpu"), 0, {})
    start = time.perf_counter()
    mesh = fuse_run(run, settings).mesh
    seconds = time.perf_counter() - start
    compared = compare_meshes(mesh, read_true_surface(phantom))
    at = next(score for score in compared.scores if score.threshold == 1.0)
    return {
        "normals_deg": compared.normal_error,
        "normals_median_deg": compared.normal_error_median,
        "accuracy_mm": compared.accuracy.mean,
        "completeness_mm": compared.completeness.mean,
        "precision_1mm": at.precision,
        "recall_1mm": at.recall,
        "f_1mm": at.f,
        "triangles": len(mesh),
        "seconds": seconds,
    }


def main() -> None:
    """Print the errors of a scene's mesh."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("phantom", type=Path)
    parser.add_argument("options", nargs="*", metavar="NAME=VALUE")
    arguments = parser.parse_args()
    options = parse_assignments(arguments.options)
    settings = validated(MeshSettings, options, "mesh option")
    for name, value in errors(open_scene(arguments.scene), arguments.phantom, settings).items():
        print(f"{name:20s} {value:10.4f}")


if __name__ == "__main__":
    main()
