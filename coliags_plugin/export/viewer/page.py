"""A run as one HTML page that opens offline: Gaussians and meshes along the path of its video, beside its frames."""

from __future__ import annotations

import json
import math
import tempfile
import zlib
from base64 import b64encode
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32
from markupsafe import Markup
from torch import Tensor
from typing_extensions import Self

from coliags_plugin.config.options import PageOptions
from coliags_plugin.contracts import GaussianField
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_write
from coliags_plugin.core.scenes import Frame, Scene
from coliags_plugin.engine.held_light import held_light
from coliags_plugin.engine.trained import TrainedRun
from coliags_plugin.export.baking.baking import bake
from coliags_plugin.export.baking.distillation import adjusted_camera, best_frame
from coliags_plugin.export.baking.exporting import light_facts, measure, psnr_lines
from coliags_plugin.export.splats.cloud import SplatCloud, field_of_cloud
from coliags_plugin.export.splats.formats import read_spz, write_spz
from coliags_plugin.fields.explicit_gaussians import FARTHEST
from coliags_plugin.geometry.meshes.mesh import TriangleMesh, read_mesh
from coliags_plugin.renderers.splatting import SplattingRenderer
from coliags_plugin.reporting.html_page import environment, refuse_folder
from coliags_plugin.reporting.image_files import EncodedImage
from coliags_plugin.reporting.numbers import counted
from coliags_plugin.surface.coverage.visibility import MAP_LEGEND

#: Pictures of frames, at most, their width, px, and the quality of their JPEG.
_PICTURES, _WIDTH, _QUALITY = 240, 256, 80
#: Frames of the video that pass in a second while it plays.
_RATE = 10.0
#: Reach of a cloud in SPZ, whose positions are multiples of 1/4096 up to 2048.
_REACH = 1024.0
#: Share of the Gaussians, at either end, whose distance to the lamp, or exponent, is brought to those of the others.
_RARE = 0.001
#: Bytes of a page that a Gaussian takes, at most: 22 in base 64, if it cannot be compressed.
_BYTES = 30
#: Room for the line about the Gaussians.
_LINE_BYTES = 2000
#: How much of a mesh's brightness follows from a light at the camera: colours of the video have their shading already.
_SHADE_OF_SURFACE, _SHADE_OF_MAP = 0.5, 0.7
_ASSETS = Path(__file__).with_name("assets")


@dataclass(frozen=True)
class Layer:
    """A packed cloud of Gaussians or mesh, one of which a page shows at a time."""

    name: str  # what the reader chooses
    about: str  # one line of text that the page shows with it
    packed: Mapping[str, Any]  # JSON values that ``scene.js`` reads
    legend: Sequence[tuple[str, tuple[int, int, int]]] = ()  # what its colours (RGB) mean

    @classmethod
    def of_cloud(cls, cloud: SplatCloud) -> tuple[Self, SplatCloud]:
        """Gaussians as an SPZ file, without a text, and the cloud that a reader gets back, rounded as SPZ rounds.

        Positions and scales are multiples of a unit, a power of two in which the cloud has about SPZ's range.
        """
        reach = float(np.abs(cloud.means).max(initial=0.0))
        unit = 2.0 ** math.ceil(math.log2(reach / _REACH)) if reach > 0.0 else 1.0
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "cloud.spz"
            write_spz(file, cloud.scaled(1.0 / unit))
            data, drawn = file.read_bytes(), read_spz(file).scaled(unit)
        packed = {"kind": "gaussians", "unit": unit, "data": b64encode(data).decode("ascii")}
        if cloud.attenuation is not None:
            packed["attenuation"], attenuation = _packed_attenuation(cloud.attenuation)
            drawn = replace(drawn, attenuation=attenuation)
        return cls("Gaussians", "", packed), drawn

    @classmethod
    def of_mesh(cls, name: str, about: str, mesh: TriangleMesh, shade: float) -> Self:
        """A mesh as 16-bit shares of its box, colours, and triangles, compressed.

        ``shade``: how much of its brightness follows from a light at the camera, 0 to 1.
        """
        low = mesh.vertices.min(axis=0)
        span = np.maximum(np.ptp(mesh.vertices, axis=0), np.finfo(np.float32).tiny)
        corners = np.rint((mesh.vertices - low) / span * 65535.0).astype("<u2")
        colors = np.full(mesh.vertices.shape, 200, np.uint8) if mesh.colors is None else mesh.colors
        data = zlib.compress(corners.tobytes() + colors.tobytes() + mesh.triangles.astype("<u4").tobytes(), 9)
        packed = {
            "kind": "mesh",
            "shade": shade,
            "vertices": len(corners),
            "low": low.tolist(),
            "span": span.tolist(),
            "data": b64encode(data).decode("ascii"),
        }
        return cls(name, about, packed)


def packed_path(
    frames: Sequence[Frame], cameras: Sequence[Camera], training: Collection[str], label: Callable[[str], str] = str
) -> dict[str, Any]:
    """JSON values of a video that a page follows: intrinsics, and frames with pictures of at most 240, evenly spaced.

    Args:
        frames: The frames in their order.
        cameras: Camera of each; they share intrinsics.
        training: Names of the frames that were trained on.
        label: What the page calls a frame of a name.
    """
    every = -(-len(frames) // _PICTURES)
    packed = [
        {
            "name": label(frame.name),
            "axes": camera.camera_to_world[:3, :3].tolist(),
            "center": camera.camera_to_world[:3, 3].tolist(),
            "held_out": frame.name not in training,
            "picture": EncodedImage.jpeg(frame.image, _QUALITY, _WIDTH).uri if index % every == 0 else None,
        }
        for index, (frame, camera) in enumerate(zip(frames, cameras, strict=True))
    ]
    intrinsics = {name: getattr(cameras[0], name) for name in ("fx", "fy", "cx", "cy", "width", "height")}
    return {"camera": intrinsics, "frames": packed}


def page_html(
    title: str, layers: Sequence[Layer], path: Mapping[str, Any], start: int, distance: float, blur: float, near: float
) -> str:
    """One self-contained HTML file: layers, camera path and pictures of frames are embedded.

    Args:
        title: Of the page.
        layers: What can be shown; the first is seen at first.
        path: Where the camera goes, as of :func:`packed_path`.
        start: Index of the frame that the page opens at.
        distance: Distance of the wall from the cameras, scene units: how far a step goes.
        blur: Variance that the renderer adds to Gaussians in the image, square pixels.
        near: z-depth from which on something is drawn, scene units.
    """
    scene = {
        "layers": [{"about": layer.about, "legend": layer.legend, **layer.packed} for layer in layers],
        **path,
        "start": start,
        "distance": distance,
        "range": [near, 1e4 * distance],
        "blur": blur,
        "rate": _RATE,
    }
    text = Markup(json.dumps(scene, separators=(",", ":")).replace("</", "<\\/"))
    style, script = (Markup((_ASSETS / f"scene.{kind}").read_text(encoding="utf-8")) for kind in ("css", "js"))
    values = {"title": title, "layers": layers, "frames": len(path["frames"]), "scene": text}
    return environment(_ASSETS).get_template("scene.html").render(**values, style=style, script=script)


def _packed_attenuation(
    attenuation: Float32[np.ndarray, "N 2"],
) -> tuple[dict[str, Any], Float32[np.ndarray, "N 2"]]:
    """Quantise log distances and exponents to 8 bits each: JSON values for the page, and the rounded attenuation."""
    values = np.stack([np.log(attenuation[:, 0]), attenuation[:, 1]], axis=1)
    low, high = np.quantile(values, (_RARE, 1.0 - _RARE), axis=0)
    span = np.maximum(high - low, np.finfo(np.float32).tiny)
    levels = np.rint(np.clip((values - low) / span, 0.0, 1.0) * 255.0)
    logs, exponents = (low + span / 255.0 * levels).T
    data = b64encode(zlib.compress(levels.T.astype(np.uint8).tobytes(), 9)).decode("ascii")
    rounded = np.stack([np.exp(logs), exponents], axis=1).astype(np.float32)
    packed = {"low": low.tolist(), "span": span.tolist(), "farthest": math.log(FARTHEST), "data": data}
    return packed, rounded


@dataclass(frozen=True)
class ScenePage:
    """An HTML page of a scene, with its figures."""

    html: str
    text: str  # the figures in one line
    facts: Mapping[str, Any]  # the figures


def save_page(
    trained: TrainedRun, options: PageOptions, most_steps: int | None = None, label: Callable[[str], str] = str
) -> ScenePage:
    """Write :func:`scene_page` to a file, ``scene.html`` in the run folder by default; an existing one is replaced."""
    output = options.output or trained.run.path / "scene.html"
    refuse_folder(output)
    page = scene_page(trained, options, most_steps, label)
    atomic_write(output, page.html)
    return page


def scene_page(
    trained: TrainedRun,
    options: PageOptions | None = None,
    most_steps: int | None = None,
    label: Callable[[str], str] = str,
) -> ScenePage:
    """A run as an HTML page of at most so many bytes: its Gaussians, and the meshes in its folder.

    Gaussians are baked in a light, given by its name, as files are, with colours that do not depend on the direction,
    but, in the recorded light, on the distance to the lamp that moves with the camera: the most visible ones, as many
    as the page holds, fitted to what the run renders for so many seconds and steps at most, and compared with the run
    on its held-out frames. The view starts at a training frame
    (:func:`~coliags_plugin.export.baking.distillation.best_frame`). Of a method without Gaussians, the page shows the
    meshes.
    """
    options = options or PageOptions()
    meshes = [_mesh_layer(name, read_mesh(file)) for name, file in mesh_files(trained.run.path).items()]
    video = trained.scene.video
    path = packed_path(video, [adjusted_camera(trained, frame) for frame in video], trained.training_frames, label)
    if isinstance(trained.model.field, GaussianField):
        return _page_of_gaussians(trained, trained.model.field, path, meshes, options, most_steps)
    if not meshes:
        raise InputError(
            f"method '{trained.method}' has no Gaussians to draw in a browser, and its run no mesh",
            "a method of Gaussians, or a mesh",
            "Run `coliags mesh` first, or write pictures with `coliags render`",
        )
    html = _html(trained, path, meshes)
    size, largest = len(html.encode()), options.largest
    if size > largest:
        raise InputError(f"a page of {largest} bytes", f"at least {size} bytes, what its meshes take")
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
    path: Mapping[str, Any],
    meshes: list[Layer],
    options: PageOptions,
    most_steps: int | None,
) -> ScenePage:
    light, largest = options.light, options.largest
    lamp = held_light(light, trained.model, [frame.camera for frame in trained.scene.train])
    empty = len(_html(trained, path, meshes).encode()) + _LINE_BYTES
    if largest < empty + _BYTES:
        raise InputError(f"a page of {largest} bytes", f"more than {empty + _BYTES} bytes, what an empty one takes")
    attenuated = lamp is None and field.knows_lamp
    splats, baking = bake(trained, lamp, options.seconds, (largest - empty) // _BYTES, 0, attenuated, most_steps)
    first = best_frame(field_of_cloud(splats), trained, lamp)
    layer, drawn = Layer.of_cloud(splats)
    measured = measure(trained, drawn, lamp if field.knows_lamp else None)
    parts = [f"step {trained.step}", f"{len(splats):,} of {baking['visible']:,} Gaussians"]
    if field.knows_lamp:
        parts.append(f"{light} light")
    text = "; ".join([*parts, *psnr_lines(measured, "in_light", "in that light")])
    facts = {
        "gaussians": len(splats),
        "baking": {"light": light_facts(light, field, lamp), **baking},
        "measured": measured,
    }
    html = _html(trained, path, [replace(layer, about=text), *meshes], splats, first)
    return ScenePage(html, f"{trained.method} on {trained.scene.name}, {text}", facts)


def _html(
    trained: TrainedRun, path: Mapping[str, Any], layers: list[Layer], splats: SplatCloud | None = None, first: int = 0
) -> str:
    """The page of a run for any layers; ``splats`` tell how far the wall is, and it opens at a training frame."""
    scene, renderer = trained.scene, trained.model.renderer
    frame, points = scene.train[first], scene.points.positions if splats is None else torch.as_tensor(splats.means)
    distance = look_distance(scene, frame.camera, points)
    blur = renderer.settings.eps2d if isinstance(renderer, SplattingRenderer) else 0.0
    title, near = f"{scene.name} ({trained.method})", min(frame.camera.near_plane, 0.02 * distance)
    return page_html(title, layers, path, scene.video.index(frame), distance, blur, near)


def look_distance(scene: Scene, camera: Camera, points: Float[Tensor, "N 3"]) -> float:
    """Median depth, in a view, of points in the world; of none, the extent of the scene."""
    depth, in_view = camera.to("cpu", torch.float64).sees(points.detach().cpu().double())
    return float(depth[in_view].median()) if in_view.any() else scene.extent or 1.0


def mesh_files(run: Path) -> dict[str, Path]:
    """Meshes in a run folder by the names of their layers: of ``coliags mesh`` and ``coliags coverage``."""
    files = {"mesh": run / "mesh" / "mesh.ply"}
    for file in sorted((run / "coverage").glob("*.ply")):
        files["coverage" if file.stem == "coverage" else f"coverage: {file.stem}"] = file
    return {name: file for name, file in files.items() if file.is_file()}
