"""A page that opens offline: Gaussians and meshes of a run, along the path of its video, beside its frames."""

from __future__ import annotations

import json
import math
import tempfile
import zlib
from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.scenes import Frame
from coliags_plugin.export.splats.cloud import SplatCloud
from coliags_plugin.export.splats.packed import read_splat_spz, write_spz
from coliags_plugin.geometry.meshes.mesh import TriangleMesh
from coliags_plugin.outputs.image_files import as_array, encode_jpeg

#: Pictures of frames, at most, their width, px, and the quality of their JPEG.
_PICTURES, _WIDTH, _QUALITY = 240, 256, 80
#: Frames of the video that pass in a second while it plays.
_RATE = 10.0
#: Reach of a cloud in SPZ, whose positions are multiples of 1/4096 up to 2048.
_REACH = 1024.0
_ASSETS = Path(__file__).with_name("assets")


@dataclass(frozen=True)
class Layer:
    """Something that a page shows, one at a time."""

    name: str  # what the reader chooses
    about: str  # one line of what is seen
    content: SplatCloud | TriangleMesh  # world frame, scene units; a mesh has colours
    shade: float = 0.0  # of a mesh: how much of its brightness follows from a light at the camera, 0 to 1


@dataclass(frozen=True)
class CameraPath:
    """Poses of the video that a page follows."""

    frames: Sequence[Frame]  # in their order
    cameras: Sequence[Camera]  # of each; they share intrinsics
    training: frozenset[str]  # names of the frames that were trained on
    start: int  # where the page opens
    distance: float  # of the wall from the cameras, scene units: how far a step goes


def page_html(title: str, layers: Sequence[Layer], path: CameraPath, blur: float, near: float) -> str:
    """One HTML file that loads nothing: its layers, cameras and pictures are within it.

    Args:
        title: Of the page.
        layers: What can be shown; the first is seen at first.
        path: Where the camera goes.
        blur: Variance that the renderer adds to Gaussians in the image, square pixels.
        near: z-depth from which on something is drawn, scene units.
    """
    camera = path.cameras[0]
    every = -(-len(path.frames) // _PICTURES)
    scene = {
        "layers": [_layer(layer) for layer in layers],
        "camera": {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height")},
        "frames": [
            {
                "name": frame.name,
                "axes": camera.camera_to_world[:3, :3].tolist(),
                "center": camera.camera_to_world[:3, 3].tolist(),
                "held_out": frame.name not in path.training,
                "picture": _picture(frame) if index % every == 0 else None,
            }
            for index, (frame, camera) in enumerate(zip(path.frames, path.cameras, strict=True))
        ],
        "start": path.start,
        "distance": path.distance,
        "range": [near, 1e4 * path.distance],
        "blur": blur,
        "rate": _RATE,
    }
    text = json.dumps(scene, separators=(",", ":")).replace("</", "<\\/")
    assets = {name: Markup((_ASSETS / f"scene.{name}").read_text(encoding="utf-8")) for name in ("css", "js")}
    return _template().render(
        title=title,
        layers=layers,
        frames=len(path.frames),
        scene=Markup(text),
        style=assets["css"],
        script=assets["js"],
    )


def _layer(layer: Layer) -> dict[str, Any]:
    content = layer.content
    packed = _packed_cloud(content) if isinstance(content, SplatCloud) else _packed_mesh(content)
    return {"about": layer.about, "shade": layer.shade, **packed}


def _packed_cloud(cloud: SplatCloud) -> dict[str, Any]:
    """Gaussians as an SPZ file, in multiples of a unit."""
    unit = spz_unit(cloud)
    with tempfile.TemporaryDirectory() as folder:
        data = _spz(cloud, unit, Path(folder)).read_bytes()
    return {"kind": "gaussians", "unit": unit, "data": b64encode(data).decode("ascii")}


def spz_unit(cloud: SplatCloud) -> float:
    """Length, in scene units, that positions and scales are multiples of: a power of two, to use all of SPZ's range."""
    reach = float(np.abs(cloud.means).max(initial=0.0))
    return 2.0 ** math.ceil(math.log2(reach / _REACH)) if reach > 0.0 else 1.0


def as_packed(cloud: SplatCloud) -> SplatCloud:
    """The Gaussians that a page draws of a cloud: rounded as SPZ rounds them."""
    unit = spz_unit(cloud)
    with tempfile.TemporaryDirectory() as folder:
        return _in_unit(read_splat_spz(_spz(cloud, unit, Path(folder))), 1.0 / unit)


def _spz(cloud: SplatCloud, unit: float, folder: Path) -> Path:
    file = folder / "cloud.spz"
    write_spz(file, _in_unit(cloud, unit))
    return file


def _in_unit(cloud: SplatCloud, unit: float) -> SplatCloud:
    return replace(cloud, means=cloud.means / np.float32(unit), scales=cloud.scales / np.float32(unit))


def _packed_mesh(mesh: TriangleMesh) -> dict[str, Any]:
    """Corners as 16-bit shares of the mesh's box, colours, and triangles, compressed."""
    low = mesh.vertices.min(axis=0)
    span = np.maximum(np.ptp(mesh.vertices, axis=0), np.finfo(np.float32).tiny)
    corners = np.rint((mesh.vertices - low) / span * 65535.0).astype("<u2")
    colors = np.full(mesh.vertices.shape, 200, np.uint8) if mesh.colors is None else mesh.colors
    data = zlib.compress(corners.tobytes() + colors.tobytes() + mesh.triangles.astype("<u4").tobytes(), 9)
    return {
        "kind": "mesh",
        "vertices": len(corners),
        "low": low.tolist(),
        "span": span.tolist(),
        "data": b64encode(data).decode("ascii"),
    }


def _picture(frame: Frame) -> str:
    image = as_array(frame.image)
    size = _WIDTH, max(1, round(image.shape[0] * _WIDTH / image.shape[1]))
    if image.shape[1] > _WIDTH:
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return f"data:image/jpeg;base64,{b64encode(encode_jpeg(image, _QUALITY)).decode('ascii')}"


@cache
def _template() -> Any:
    environment = Environment(
        loader=FileSystemLoader(_ASSETS),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("scene.html")
