"""A page that opens offline: Gaussians and meshes of a run, along the path of its video, beside its frames."""

from __future__ import annotations

import json
import math
import tempfile
import zlib
from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32
from markupsafe import Markup
from typing_extensions import Self

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.scenes import Frame
from coliags_plugin.export.splats.cloud import SplatCloud
from coliags_plugin.export.splats.spz import read_splat_spz, write_spz
from coliags_plugin.fields.explicit_gaussians import FARTHEST
from coliags_plugin.geometry.meshes.mesh import TriangleMesh
from coliags_plugin.outputs.image_files import as_array, encode_jpeg
from coliags_plugin.reporting.html_page import environment

#: Pictures of frames, at most, their width, px, and the quality of their JPEG.
_PICTURES, _WIDTH, _QUALITY = 240, 256, 80
#: Frames of the video that pass in a second while it plays.
_RATE = 10.0
#: Reach of a cloud in SPZ, whose positions are multiples of 1/4096 up to 2048.
_REACH = 1024.0
#: Share of the Gaussians, at either end, whose distance to the lamp, or exponent, is brought to those of the others.
_RARE = 0.001
_ASSETS = Path(__file__).with_name("assets")


@dataclass(frozen=True)
class Layer:
    """A packed cloud of Gaussians or mesh, one of which a page shows at a time."""

    name: str  # what the reader chooses
    about: str  # one line of text that the page shows with it
    packed: Mapping[str, Any]  # JSON values that ``scene.js`` reads
    legend: Sequence[tuple[str, tuple[int, int, int]]] = ()  # what its colours (RGB) mean

    @classmethod
    def of_cloud(cls, name: str, cloud: SplatCloud) -> tuple[Self, SplatCloud]:
        """Gaussians as an SPZ file, without a text, and the cloud that a reader gets back, rounded as SPZ rounds.

        Positions and scales are multiples of a unit, a power of two in which the cloud has about SPZ's range.
        """
        reach = float(np.abs(cloud.means).max(initial=0.0))
        unit = 2.0 ** math.ceil(math.log2(reach / _REACH)) if reach > 0.0 else 1.0
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "cloud.spz"
            write_spz(file, cloud.scaled(1.0 / unit))
            data, drawn = file.read_bytes(), read_splat_spz(file).scaled(unit)
        packed = {"kind": "gaussians", "unit": unit, "data": b64encode(data).decode("ascii")}
        if cloud.attenuation is not None:
            packed["attenuation"], attenuation = _packed_attenuation(cloud.attenuation)
            drawn = replace(drawn, attenuation=attenuation)
        return cls(name, "", packed), drawn

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


@dataclass(frozen=True)
class CameraPath:
    """Poses and pictures of a video's frames, which a page follows."""

    frames: Sequence[Frame]  # in their order
    cameras: Sequence[Camera]  # of each; they share intrinsics
    training: frozenset[str]  # names of the frames that were trained on

    @cached_property
    def packed(self) -> list[dict[str, Any]]:
        """JSON values of every frame; pictures of at most 240, evenly spaced."""
        every = -(-len(self.frames) // _PICTURES)
        return [
            {
                "name": frame.name,
                "axes": camera.camera_to_world[:3, :3].tolist(),
                "center": camera.camera_to_world[:3, 3].tolist(),
                "held_out": frame.name not in self.training,
                "picture": _picture(frame) if index % every == 0 else None,
            }
            for index, (frame, camera) in enumerate(zip(self.frames, self.cameras, strict=True))
        ]


def page_html(
    title: str, layers: Sequence[Layer], path: CameraPath, start: int, distance: float, blur: float, near: float
) -> str:
    """One self-contained HTML file: layers, camera path and pictures of frames are embedded.

    Args:
        title: Of the page.
        layers: What can be shown; the first is seen at first.
        path: Where the camera goes.
        start: Index of the frame that the page opens at.
        distance: Distance of the wall from the cameras, scene units: how far a step goes.
        blur: Variance that the renderer adds to Gaussians in the image, square pixels.
        near: z-depth from which on something is drawn, scene units.
    """
    camera = path.cameras[0]
    scene = {
        "layers": [{"about": layer.about, "legend": layer.legend, **layer.packed} for layer in layers],
        "camera": {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height")},
        "frames": path.packed,
        "start": start,
        "distance": distance,
        "range": [near, 1e4 * distance],
        "blur": blur,
        "rate": _RATE,
    }
    text = Markup(json.dumps(scene, separators=(",", ":")).replace("</", "<\\/"))
    style, script = (Markup((_ASSETS / f"scene.{kind}").read_text(encoding="utf-8")) for kind in ("css", "js"))
    values = {"title": title, "layers": layers, "frames": len(path.frames), "scene": text}
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


def _picture(frame: Frame) -> str:
    image = as_array(frame.image)
    size = _WIDTH, max(1, round(image.shape[0] * _WIDTH / image.shape[1]))
    if image.shape[1] > _WIDTH:
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return f"data:image/jpeg;base64,{b64encode(encode_jpeg(image, _QUALITY)).decode('ascii')}"
