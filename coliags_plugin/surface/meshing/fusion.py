"""Fusion of the rendered depth of a run into a mesh, and its files, compared with the true surface if there is one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_folder, write_json
from coliags_plugin.core.scenes import Frame, Scene
from coliags_plugin.datamanagers.recorded import portable_name
from coliags_plugin.engine.data_formats import open_scene
from coliags_plugin.engine.evaluator import match_truth
from coliags_plugin.engine.progress import ProgressReport
from coliags_plugin.engine.trained import TrainedRun
from coliags_plugin.geometry.meshes.mesh import MESH_FORMATS, Texture, TriangleMesh, write_mesh
from coliags_plugin.geometry.meshes.truth import (
    SurfaceComparison,
    TrueSurface,
    compare_meshes,
    find_true_surface,
    read_true_surface,
)
from coliags_plugin.reporting.image_files import write_png
from coliags_plugin.reporting.model import Block, Paragraph, simple_table
from coliags_plugin.surface.meshing.pictures import comparison_picture, distance_colors
from coliags_plugin.surface.meshing.views import (
    DepthView,
    MeshSettings,
    best_colors,
    best_texture,
    max_depth_of,
    rendered_depth,
    voxel_size_of,
)
from coliags_plugin.surface.meshing.volume import Volume, close_holes, smoothed


@dataclass(frozen=True, eq=False)
class FusedRun:
    """Mesh fused from the depth of a run."""

    mesh: TriangleMesh
    holes: int  # that were closed
    texture: Texture | None  # of the mesh, where one was asked for


def fuse_run(trained: TrainedRun, settings: MeshSettings | None = None) -> FusedRun:
    """The surface of a run: a truncated signed distance field of the depth rendered from all training poses.

    The mesh is in the world of the poses, scene units, coloured by the best views of each place, its triangles
    counter-clockwise seen from where the cameras were.
    """
    settings, frames = settings or MeshSettings(), trained.scene.train
    trained.model.check_outputs(("rgb", "alpha", f"depth_{settings.depth}"), f"meshing with {settings.depth} depth")
    if len(frames) < 2:
        raise InputError(f"scene '{trained.scene.name}' has {len(frames)} training view", "two views or more to fuse")
    size, views = voxel_size_of(settings, trained.scene), list[DepthView]()
    with ProgressReport("render depth", len(frames)) as progress:
        for view in rendered_depth(trained, settings):
            views.append(view)
            progress.update(len(views))
    volume, least = Volume(views, size, settings.truncation), min(settings.min_views, len(frames))
    mesh = volume.mesh(least, settings.min_support, settings.max_conflict)
    if not len(mesh):
        raise InputError(
            f"no surface in the depth of {len(frames)} views in voxels of {size:.3g} {trained.scene.length_unit}",
            f"opaque surface that {settings.min_views} views agree on",
            "Look at `coliags render RUN`; perhaps train longer, lower min_views, min_support or min_alpha, or raise "
            "max_conflict",
        )
    mesh, holes = close_holes(mesh.without_small_parts(settings.min_part), settings.max_hole * size, views)
    mesh = smoothed(mesh, settings.smoothing)
    texture = best_texture(mesh, size / settings.texture, views) if settings.texture else None
    return FusedRun(replace(mesh, colors=best_colors(mesh.vertices, views)), holes, texture)


#: Version of mesh.json.
FORMAT = 1


@dataclass(frozen=True)
class MeshedRun:
    """The mesh of a run and the folder it was written to."""

    folder: Path  # with ``mesh.ply`` and so on, the texture where there is one, and ``mesh.json``
    mesh: TriangleMesh  # world of the poses, scene units
    comparison: SurfaceComparison | None  # with the true surface, where there is one

    def comparison_blocks(self) -> list[Block]:
        """The figures of the comparison as two tables and a few sentences; empty without a comparison."""
        compared = self.comparison
        if compared is None:
            return []
        unit = compared.unit
        directions = {
            "accuracy: mesh to true surface": compared.accuracy,
            "completeness: seen to mesh": compared.completeness,
        }
        distances = [
            [name, f"{d.mean:.3f}", f"{d.median:.3f}", f"{d.percentile_95:.3f}"] for name, d in directions.items()
        ]
        shares = [
            [f"{score.threshold:g} {unit}", f"{score.precision:.4f}", f"{score.recall:.4f}", f"{score.f:.4f}"]
            for score in compared.scores
        ]
        return [
            simple_table([unit, "mean", "median", "95 %"], distances),
            simple_table(["within", "precision", "recall", "F"], shares),
            Paragraph(
                f"Chamfer distance (mean of both means) {compared.chamfer:.3f} {unit}, "
                f"HD95 {compared.hausdorff_95:.3f} {unit}, normals {compared.normal_error:.1f} degrees off"
            ),
            Paragraph(
                f"seen: {compared.seen_area:.0f} {unit}^2 ({compared.seen_by}); "
                f"{compared.beyond_seen:.1%} of the mesh lies beyond it"
            ),
        ]


def mesh_run(
    trained: TrainedRun,
    output: Path,
    settings: MeshSettings,
    formats: Sequence[str] = MESH_FORMATS,
    truth: Path | None = None,
    overwrite: bool = False,
) -> MeshedRun:
    """Fuse a run into a mesh and write it, with a comparison where there is a true surface.

    The folder gets the mesh in each format; ``mesh.json`` with settings, counts and figures; and, with a true surface,
    ``comparison.png``, ``mesh_error.ply`` and ``truth_error.ply``, coloured by distance. ``truth`` is that surface, in
    the world of the scene and mm, or the folder of a scene with one; None: that of the run's scene, where there is one.
    """
    scene = trained.scene
    with atomic_folder(output, overwrite) as folder:
        surface = _true_surface(scene, truth)
        fused = fuse_run(trained, settings)
        mesh = fused.mesh
        compared = None if surface is None else compare_meshes(mesh, surface)
        for name in formats:
            write_mesh(folder / f"mesh.{name}", mesh, fused.texture)
        if surface is not None:
            _write_comparison(folder, mesh, surface, scene)
        reach = max_depth_of(settings, scene)
        used = {"voxel_size": voxel_size_of(settings, scene), "max_depth": reach if np.isfinite(reach) else None}
        summary = {
            "format": FORMAT,
            "method": trained.method,
            "scene": scene.name,
            "step": trained.step,
            "views": len(scene.train),
            "unit": scene.provenance.unit,
            "settings": settings.model_dump() | used,
            "vertices": len(mesh.vertices),
            "triangles": len(mesh),
            "holes_closed": fused.holes,
            "texture": None if fused.texture is None else fused.texture.image.shape[0],
            "area": float(mesh.areas.sum()),
            "bounds": [mesh.vertices.min(axis=0).tolist(), mesh.vertices.max(axis=0).tolist()],
            "truth": None if surface is None else portable_name(surface.path.resolve(), scene.folder or Path()),
            "comparison": None if compared is None else compared.as_json(),
        }
        write_json(folder / "mesh.json", summary)
    return MeshedRun(output, mesh, compared)


def _true_surface(scene: Scene, truth: Path | None) -> TrueSurface | None:
    path = truth or (None if scene.folder is None else find_true_surface(scene.folder))
    if path is None or (truth is None and not scene.is_metric):
        return None
    unit = "mm"
    if not scene.is_metric:  # a scene of the same poses shares its scale
        if not path.is_dir():
            raise InputError(
                f"scene '{scene.name}' is of unknown scale, {path} in mm",
                "the folder of a scene with the same poses, and with a true surface",
                "Pass `truth=SCENE`, or give the scene its scale first (docs/poses.md)",
            )
        unit = match_truth(scene, open_scene(path)).scene.length_unit
    surface = replace(read_true_surface(path), unit=unit)
    if surface.seen_by:
        return surface
    hit = first_hits(surface.mesh, scene.train)
    if not hit.any():
        raise InputError(
            f"no training view of scene '{scene.name}' sees any of {path}",
            "the true surface of this scene, in mm and in the world of its poses",
        )
    return replace(surface, seen=hit, seen_by="first hit of a pixel of a training frame, cast at the mesh")


def first_hits(mesh: TriangleMesh, frames: Sequence[Frame]) -> Bool[np.ndarray, "F"]:
    """Triangles that are the first hit of the ray through the centre of an unmasked pixel of any frame. [F]"""
    first = np.zeros(len(mesh), bool)
    for frame in frames:
        camera = frame.camera.to("cpu", torch.float64)
        directions = camera.rays()[frame.valid.cpu()]
        triangle, _ = mesh.rays.cast(camera.center.numpy(), directions.numpy())
        first[triangle[triangle >= 0]] = True
    return first


def _write_comparison(folder: Path, mesh: TriangleMesh, truth: TrueSurface, scene: Scene) -> None:
    frames = scene.train
    cameras = [frames[index].camera for index in sorted({0, len(frames) // 2, len(frames) - 1})]
    write_png(folder / "comparison.png", comparison_picture(mesh, truth, cameras))
    errors = distance_colors(truth.mesh.rays.nearest(mesh.vertices)[0])
    write_mesh(folder / "mesh_error.ply", replace(mesh, colors=errors))
    shown = np.zeros(len(truth.mesh.vertices), bool)
    shown[truth.mesh.triangles[truth.seen]] = True
    gaps = distance_colors(mesh.rays.nearest(truth.mesh.vertices)[0], shown)
    write_mesh(folder / "truth_error.ply", replace(truth.mesh, colors=gaps))
