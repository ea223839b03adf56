"""The two folder layouts a phantom can be written in (docs/data.md 1 and 3), and the truth beside them."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from coliags_plugin.datamanagers.phantom.colon import ColonSurface
from coliags_plugin.datamanagers.phantom.imaging import Optics, PinholeOptics
from coliags_plugin.errors import InputError
from coliags_plugin.lenses import LENSES, Pinhole, octagon_mask

#: z-depth that the largest 16-bit value stands for, mm; whatever is farther is clipped there.
DEPTH_RANGE = 100.0
#: Intrinsics of C3VD's undistorted frames at 338 x 270, centres at integers (docs/phantom.md 3).
_C3VD_PINHOLE = Pinhole(200.8769, 200.4713, 167.3190, 136.9333)


class Layout(ABC):
    """How one sequence lies in a folder."""

    #: Whether frames carry normals and the mesh its coverage.
    has_normals: ClassVar[bool]

    @abstractmethod
    def optics(self, width: int, height: int) -> tuple[Optics, Bool[np.ndarray, "H W"]]:
        """The lens of frames of this size, and which of their pixels are lit. The mask is [H, W]."""

    @abstractmethod
    def write_frame(
        self,
        folder: Path,
        index: int,
        color: UInt8[np.ndarray, "H W 3"],
        z_depth: Float[np.ndarray, "H W"],
        normals: Float[np.ndarray, "H W 3"],
    ) -> None:
        """Write one frame: RGB, z-depth in mm (0 = none), normals in camera axes."""

    @abstractmethod
    def write_sequence(self, folder: Path, poses: Sequence[Float[np.ndarray, "4 4"]], optics: Optics) -> None:
        """Write what belongs to all frames: poses and, where the layout has one, the camera."""


class C3vdLayout(Layout):
    """Undistorted frames as ColIAGS reads them: images/, depths/, camera_pose.txt, camera.json."""

    has_normals = False

    def optics(self, width: int, height: int) -> tuple[Optics, Bool[np.ndarray, "H W"]]:
        """C3VD's undistorted camera, scaled by width; its principal point keeps its distance from the middle."""
        scale = width / 338.0
        k = _C3VD_PINHOLE
        pinhole = Pinhole(
            k.fx * scale,
            k.fy * scale,
            0.5 * width - 0.5 + (k.cx + 0.5 - 169.0) * scale,
            0.5 * height - 0.5 + (k.cy + 0.5 - 135.0) * scale,
        )
        return PinholeOptics(pinhole, width, height), np.ones((height, width), bool)

    def write_frame(
        self,
        folder: Path,
        index: int,
        color: UInt8[np.ndarray, "H W 3"],
        z_depth: Float[np.ndarray, "H W"],
        normals: Float[np.ndarray, "H W 3"],
    ) -> None:
        """See :class:`Layout`; normals are not part of this layout."""
        write_image(folder / "images" / f"{index:04d}_color.png", color)
        write_image(folder / "depths" / f"{index:04d}_depth.png", encode_depth(z_depth))

    def write_sequence(self, folder: Path, poses: Sequence[Float[np.ndarray, "4 4"]], optics: Optics) -> None:
        """See :class:`Layout`."""
        write_poses(folder / "camera_pose.txt", poses)
        if not isinstance(optics, PinholeOptics):
            raise TypeError("the c3vd layout holds pinhole frames")
        k = optics.pinhole
        camera = {"fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy, "h": optics.height, "w": optics.width}
        (folder / "camera.json").write_text(json.dumps(camera, indent=2) + "\n")


class C3vdRawLayout(Layout):
    """The release's own files: distorted frames with black corners, TIFF depth and normals, pose.txt."""

    has_normals = True

    def optics(self, width: int, height: int) -> tuple[Optics, Bool[np.ndarray, "H W"]]:
        """C3VD's omnidirectional lens behind its octagonal mask."""
        return LENSES["omnidirectional"].scaled(width, height), octagon_mask(width, height)

    def write_frame(
        self,
        folder: Path,
        index: int,
        color: UInt8[np.ndarray, "H W 3"],
        z_depth: Float[np.ndarray, "H W"],
        normals: Float[np.ndarray, "H W 3"],
    ) -> None:
        """See :class:`Layout`."""
        write_image(folder / f"{index:04d}_color.png", color)
        write_image(folder / f"{index:04d}_depth.tiff", encode_depth(z_depth))
        write_image(folder / f"{index:04d}_normals.tiff", encode_normals(normals))

    def write_sequence(self, folder: Path, poses: Sequence[Float[np.ndarray, "4 4"]], optics: Optics) -> None:
        """See :class:`Layout`."""
        write_poses(folder / "pose.txt", poses)


LAYOUTS: dict[str, Layout] = {"c3vd": C3vdLayout(), "c3vd-raw": C3vdRawLayout()}


def encode_depth(z_depth: Float[np.ndarray, "H W"]) -> np.ndarray:
    """C3VD's 16 bits: 65535 / 100 a mm, 65535 from 100 mm on, 0 for none. [H, W]"""
    return np.clip(np.rint(z_depth * (65535.0 / DEPTH_RANGE)), 0.0, 65535.0).astype(np.uint16)


def encode_normals(normals: Float[np.ndarray, "H W 3"]) -> np.ndarray:
    """C3VD's 16 bits: -1 to 1 becomes 0 to 65535; 0, 0, 0 where there is no wall. [H, W, 3]"""
    encoded = np.rint((normals + 1.0) * (0.5 * 65535.0)).clip(0.0, 65535.0).astype(np.uint16)
    encoded[~normals.any(axis=-1)] = 0
    return encoded


def write_image(path: Path, image: np.ndarray) -> None:
    """Write RGB or grey, 8 or 16 bit, as the suffix says.

    Raises:
        InputError: It cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if image.ndim == 3:
        image = np.ascontiguousarray(image[..., ::-1])
    if not cv2.imwrite(str(path), image):
        raise InputError(f"cannot write {path}", "a writable folder on a disk with room", "Choose another output")


def write_poses(path: Path, poses: Sequence[Float[np.ndarray, "4 4"]]) -> None:
    """One line a frame: camera-to-world, mm, 16 numbers column by column, as C3VD's release has them."""
    lines = (",".join(f"{value:.9g}" for value in pose.T.ravel()) for pose in poses)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")


def write_ply(path: Path, surface: ColonSurface, vertex_albedo: Float[np.ndarray, "V 3"]) -> None:
    """The wall as a binary PLY; vertex colours are the albedo, encoded with gamma 2.2."""
    path.parent.mkdir(parents=True, exist_ok=True)
    kinds = {name: "float" for name in ("x", "y", "z", "nx", "ny", "nz")}
    kinds |= {name: "uchar" for name in ("red", "green", "blue")}
    vertices = np.empty(
        len(surface.vertices), [(name, "<f4" if kind == "float" else "u1") for name, kind in kinds.items()]
    )
    for axis, name in enumerate("xyz"):
        vertices[name] = surface.vertices[:, axis]
        vertices[f"n{name}"] = surface.normals[:, axis]
    colors = np.rint(255.0 * np.clip(vertex_albedo, 0.0, 1.0) ** (1.0 / 2.2)).astype(np.uint8)
    for channel, name in enumerate(("red", "green", "blue")):
        vertices[name] = colors[:, channel]
    faces = np.empty(len(surface.triangles), [("count", "u1"), ("vertices", "<i4", (3,))])
    faces["count"], faces["vertices"] = 3, surface.triangles
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment millimetres; colour = albedo ^ (1 / 2.2)",
        f"element vertex {len(vertices)}",
        *(f"property {kind} {name}" for name, kind in kinds.items()),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    path.write_bytes(("\n".join(header) + "\n").encode() + vertices.tobytes() + faces.tobytes())


def write_coverage_obj(path: Path, surface: ColonSurface, observed: Bool[np.ndarray, "F"]) -> None:
    """The wall as C3VD's coverage mesh: face corners ``v/vt`` with vt 1 for observed triangles and 2 for others."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w") as file:
        file.write("# millimetres; vt 1 = observed, vt 2 = not observed\n")
        np.savetxt(file, surface.vertices, "v %.6f %.6f %.6f")
        file.write("vt 0.25 0.5\nvt 0.75 0.5\n")
        corners = np.empty((len(surface.triangles), 6), np.int64)
        corners[:, ::2] = surface.triangles.astype(np.int64) + 1
        corners[:, 1::2] = np.where(observed, 1, 2)[:, None]
        np.savetxt(file, corners, "f %d/%d %d/%d %d/%d")
