"""A run as one HTML page that opens offline: its Gaussians, and its meshes, along the path of the video."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from coliags_plugin.contracts import GaussianField
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_write
from coliags_plugin.core.scenes import Scene
from coliags_plugin.engine.held_light import held_light
from coliags_plugin.engine.trained import TrainedRun
from coliags_plugin.export.baking.baking import SECONDS, bake
from coliags_plugin.export.baking.distillation import adjusted_camera, best_frame
from coliags_plugin.export.baking.exporting import cost_lines, export_cost, light_facts
from coliags_plugin.export.splats.cloud import SplatCloud, field_of_cloud
from coliags_plugin.export.viewer.page import CameraPath, Layer, page_html
from coliags_plugin.fields.explicit_gaussians import AttenuatedGaussians, ExplicitGaussians
from coliags_plugin.geometry.meshes.files import read_mesh
from coliags_plugin.geometry.meshes.mesh import TriangleMesh
from coliags_plugin.renderers.splatting import SplattingRenderer
from coliags_plugin.reporting.html_page import refuse_folder
from coliags_plugin.reporting.numbers import counted
from coliags_plugin.surface.coverage.visibility import MAP_LEGEND

#: Largest page, bytes.
LARGEST_PAGE = 5_000_000
#: Bytes of a page that a Gaussian takes, about: 22, compressed and in base 64.
_BYTES = 24
#: Room for the line about the Gaussians.
_LINE_BYTES = 2000
#: How much of the room found in one attempt the next one uses.
_CAUTION = 0.98
#: How much of a mesh's brightness follows from a light at the camera: colours of the video have their shading already.
_SHADE_OF_SURFACE, _SHADE_OF_MAP = 0.5, 0.7


@dataclass(frozen=True)
class ScenePage:
    """An HTML page of a scene, with its figures."""

    html: str
    text: str  # the figures in one line
    facts: Mapping[str, Any]  # the figures


def save_page(
    trained: TrainedRun, output: Path, largest: int, light: str, seconds: float, most_steps: int | None = None
) -> ScenePage:
    """Write :func:`scene_page` to a file; an existing one is replaced."""
    refuse_folder(output)
    page = scene_page(trained, largest, light, seconds, most_steps)
    atomic_write(output, page.html)
    return page


def scene_page(
    trained: TrainedRun,
    largest: int = LARGEST_PAGE,
    light: str = "recorded",
    seconds: float = SECONDS,
    most_steps: int | None = None,
) -> ScenePage:
    """A run as an HTML page of at most so many bytes: its Gaussians, and the meshes in its folder.

    Gaussians are baked in a light, given by its name, as files are, with colours that do not depend on the direction,
    but, in the recorded light, on the distance to the lamp that moves with the camera: the most visible ones, as many
    as the page holds, fitted to what the run renders for so many seconds and steps at most, and compared with the run
    on its held-out frames. The view starts at a training frame
    (:func:`~coliags_plugin.export.baking.distillation.best_frame`). Of a method without Gaussians, the page shows the
    meshes.
    """
    meshes = [_mesh_layer(name, read_mesh(file)) for name, file in mesh_files(trained.run.path).items()]
    if isinstance(trained.model.field, GaussianField):
        return _page_of_gaussians(trained, trained.model.field, meshes, largest, light, seconds, most_steps)
    if not meshes:
        raise InputError(
            f"method '{trained.method}' has no Gaussians to draw in a browser, and its run no mesh",
            "a method of Gaussians, or a mesh",
            "Run `coliags mesh` first, or write pictures with `coliags render`",
        )
    html = _Page(trained).html(meshes)
    if len(html.encode()) > largest:
        raise InputError(f"a page of {largest} bytes", f"at least {len(html.encode())} bytes, what its meshes take")
    text = f"{trained.method} on {trained.scene.name}, step {trained.step}; no Gaussians"
    return ScenePage(html, text, {"gaussians": 0})


def _mesh_layer(name: str, mesh: TriangleMesh) -> Layer:
    about = counted(len(mesh), "triangle")
    if name == "mesh":
        return Layer.of_mesh("surface", about, mesh, _SHADE_OF_SURFACE)
    layer = Layer.of_mesh(name, f"{about}, for research use only", mesh, _SHADE_OF_MAP)
    there = set() if mesh.colors is None else set(map(tuple, np.unique(mesh.colors, axis=0).tolist()))
    return replace(layer, legend=[entry for entry in MAP_LEGEND if entry[1] in there])


def _page_of_gaussians(
    trained: TrainedRun,
    field: GaussianField,
    meshes: list[Layer],
    largest: int,
    light: str,
    seconds: float,
    most_steps: int | None,
) -> ScenePage:
    page, held = _Page(trained), held_light(light, trained.model, [frame.camera for frame in trained.scene.train])
    empty = len(page.html(meshes).encode()) + _LINE_BYTES
    if largest < empty + _BYTES:
        raise InputError(f"a page of {largest} bytes", f"more than {empty + _BYTES} bytes, what an empty one takes")
    kind = AttenuatedGaussians if held is None and field.knows_lamp else ExplicitGaussians
    splats, baking = bake(trained, held, seconds, (largest - empty) // _BYTES, 0, kind, most_steps)
    first = best_frame(field_of_cloud(splats), trained, held)
    layer, drawn = Layer.of_cloud("Gaussians", splats)
    while empty + (size := len(json.dumps(layer.packed))) > largest:
        splats = most_visible(splats, int(_CAUTION * len(splats) * (largest - empty) / size))
        layer, drawn = Layer.of_cloud("Gaussians", splats)
    cost = export_cost(trained, drawn, held if field.knows_lamp else None)
    told = [f"step {trained.step}", f"{len(splats):,} of {baking['visible']:,} Gaussians"]
    if field.knows_lamp:
        told.append(f"{light} light")
    text = "; ".join([*told, *cost_lines(cost)])
    facts = {"gaussians": len(splats), "baking": {"light": light_facts(light, field, held), **baking}, "cost": cost}
    html = page.html([replace(layer, about=text), *meshes], splats, first)
    return ScenePage(html, f"{trained.method} on {trained.scene.name}, {text}", facts)


class _Page:
    """The page of a run for any layers; frames are packed once."""

    def __init__(self, trained: TrainedRun) -> None:
        self._trained, frames = trained, trained.scene.video
        cameras = [adjusted_camera(trained, frame) for frame in frames]
        self._path = CameraPath(frames, cameras, trained.training_frames)

    def html(self, layers: list[Layer], splats: SplatCloud | None = None, first: int = 0) -> str:
        """The page; ``splats`` tell how far the wall is, and it opens at a training frame."""
        scene, renderer = self._trained.scene, self._trained.model.renderer
        frame, points = scene.train[first], scene.points.positions if splats is None else torch.as_tensor(splats.means)
        distance = look_distance(scene, frame.camera, points)
        blur = renderer.settings.eps2d if isinstance(renderer, SplattingRenderer) else 0.0
        title, near = f"{self._trained.method} on {scene.name}", min(frame.camera.near_plane, 0.02 * distance)
        return page_html(title, layers, self._path, scene.video.index(frame), distance, blur, near)


def look_distance(scene: Scene, camera: Camera, points: Float[Tensor, "N 3"]) -> float:
    """Median depth, in a view, of points in the world; of none, the extent of the scene."""
    depth, seen = camera.to("cpu", torch.float64).sees(points.detach().cpu().double())
    return float(depth[seen].median()) if seen.any() else scene.extent or 1.0


def most_visible(splats: SplatCloud, count: int) -> SplatCloud:
    """At most so many splats: those that cover most, by opacity times area seen from the front, in their order."""
    covers = splats.opacities * np.sort(splats.scales, axis=1)[:, 1:].prod(axis=1)
    kept = np.zeros(len(splats), bool)
    kept[np.argsort(-covers, kind="stable")[:count]] = True
    return splats.part(kept)


def mesh_files(run: Path) -> dict[str, Path]:
    """Meshes in a run folder by the names of their layers: of ``coliags mesh`` and ``coliags coverage``."""
    files = {"mesh": run / "mesh" / "mesh.ply"}
    for file in sorted((run / "coverage").glob("*.ply")):
        files["coverage" if file.stem == "coverage" else f"coverage: {file.stem}"] = file
    return {name: file for name, file in files.items() if file.is_file()}
