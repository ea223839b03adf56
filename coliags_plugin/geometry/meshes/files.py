"""Files of triangle meshes: PLY, OBJ and GLB."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8

from coliags_plugin.core import bounds
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_write
from coliags_plugin.core.glb import GlbArray, encode_glb
from coliags_plugin.core.open3d_library import import_open3d
from coliags_plugin.core.ply import point_properties, read_triangles, write_ply
from coliags_plugin.geometry.meshes.mesh import TriangleMesh
from coliags_plugin.geometry.meshes.obj import decode_obj, encode_obj

#: Suffixes of the formats.
MESH_FORMATS = ("ply", "obj", "glb")

_COLORS = ("red", "green", "blue")
#: glTF's number of a primitive of triangles.
_TRIANGLES = 4


def read_mesh(path: Path) -> TriangleMesh:
    """Read a mesh from a PLY, OBJ or GLB file, told apart by their suffix; lengths stay, polygons become triangles."""
    return read_flagged_mesh(path)[0]


def read_flagged_mesh(path: Path) -> tuple[TriangleMesh, Int[np.ndarray, "F"] | None]:
    """A mesh as :func:`read_mesh` reads it, and the texture index of each triangle where it is an OBJ file with such.

    The index (``vt``, counted from 1) is that of the triangle's first corner.
    """
    if not path.is_file():
        raise InputError(f"no file {path}", "a mesh as PLY, OBJ or GLB file", "Check the path")
    suffix, textures = _suffix(path), None
    if suffix == "obj":
        mesh, textures = decode_obj(path)
    else:
        mesh = _read_ply(path) if suffix == "ply" else _read_glb(path)
    if not len(mesh):
        raise InputError(f"{path} has no triangles", "a mesh", "Check that it is a mesh, not a cloud of points")
    if not (np.abs(mesh.vertices) <= bounds.LENGTH).all():  # neither NaN
        raise InputError(f"{path} has vertices that are not finite or beyond {bounds.LENGTH:g}", "coordinates in mm")
    return mesh, textures


def write_mesh(path: Path, mesh: TriangleMesh) -> None:
    """Write a mesh as PLY, OBJ or GLB, told apart by the suffix, atomically; the folder is made.

    Vertex colours are written as they are: in PLY as uchar, in OBJ as three numbers in [0, 1] behind the position (an
    extension that MeshLab, Blender and open3d read), in GLB as linear light, as glTF demands. GLB has the same axes and
    lengths as the mesh; glTF's own are y up, metres.
    """
    suffix = _suffix(path)
    if suffix == "ply":
        write_ply(path, point_properties(mesh.vertices, mesh.colors), mesh.triangles)
    else:
        atomic_write(path, encode_obj(mesh) if suffix == "obj" else encode_mesh(mesh))


def _suffix(path: Path) -> str:
    suffix = path.suffix.lower().removeprefix(".")
    if suffix not in MESH_FORMATS:
        raise InputError(f"{path.name} is no mesh file by its name", f"one of {', '.join(MESH_FORMATS)}")
    return suffix


def _read_ply(path: Path) -> TriangleMesh:
    columns, triangles = read_triangles(path)
    colored = all(name in columns and columns[name].dtype == np.uint8 for name in _COLORS)
    with np.errstate(over="ignore"):
        vertices = np.stack([columns[name] for name in "xyz"], axis=1).astype(np.float32)
    return TriangleMesh(vertices, triangles, np.stack([columns[name] for name in _COLORS], axis=1) if colored else None)


def _read_glb(path: Path) -> TriangleMesh:
    open3d = import_open3d("reads meshes")
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        read = open3d.io.read_triangle_mesh(str(path))
    triangles = np.asarray(read.triangles)
    vertices = np.asarray(read.vertices).astype(np.float32)
    if len(triangles) and (triangles.min() < 0 or triangles.max() >= len(vertices)):
        raise InputError(f"{path} has triangles of vertices that are not there", "a mesh", "Fetch it again")
    linear = np.rint(np.asarray(read.vertex_colors) * 255.0).clip(0, 255) / 255.0
    return TriangleMesh(vertices, triangles.astype(np.int64), _encoded(linear) if len(linear) else None)


def encode_mesh(mesh: TriangleMesh) -> bytes:
    """Bytes of a GLB file: one primitive with 32-bit indices, float positions and 8-bit colours.

    By hand: open3d 0.20 writes 16-bit indices at an offset that its own reader then refuses.
    """
    arrays = [
        GlbArray(mesh.triangles.astype(np.uint32).reshape(-1, 1), indices=True),
        GlbArray(mesh.vertices.astype(np.float32), bounds=True),
    ]
    attributes = {"POSITION": 1}
    if mesh.colors is not None:
        attributes["COLOR_0"] = 2
        # Of four bytes each, as glTF aligns the elements of a vertex attribute.
        rgba = np.full((len(mesh.vertices), 4), 255, np.uint8)
        rgba[:, :3] = np.rint(_linear(mesh.colors) * 255.0)
        arrays.append(GlbArray(rgba, normalized=True))
    document = {
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 0, "material": 0, "mode": _TRIANGLES}]}],
        "materials": [{"doubleSided": True, "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}}],
    }
    return encode_glb(document, arrays)


def _linear(colors: UInt8[np.ndarray, "V 3"]) -> Float[np.ndarray, "V 3"]:
    """Linear light of sRGB colours, in [0, 1]. [V, 3]"""
    encoded = colors / 255.0
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def _encoded(light: Float[np.ndarray, "V 3"]) -> UInt8[np.ndarray, "V 3"]:
    """SRGB colours of linear light in [0, 1]. [V, 3]"""
    encoded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.rint(encoded * 255.0).astype(np.uint8)
