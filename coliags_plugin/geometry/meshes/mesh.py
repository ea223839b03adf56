"""Triangle meshes as plain arrays, and rays cast at them by open3d."""

from __future__ import annotations

import io
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from coliags_plugin.core import bounds
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_write
from coliags_plugin.core.images import write_image
from coliags_plugin.core.libraries import import_open3d
from coliags_plugin.core.ply import eight_bits, point_properties, read_triangles, vertex_colors, write_ply
from coliags_plugin.core.text_files import unreadable

#: Where rays begin: each of its own, or all of one.
Origins: TypeAlias = Float[np.ndarray, "N 3"] | Float[np.ndarray, "3"]


class RayScene:
    """An ``open3d.t.geometry.TriangleMesh`` indexed for rays and distances."""

    def __init__(self, mesh: Any) -> None:
        self._open3d = import_open3d("casts rays at meshes")
        self._scene = self._open3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(mesh)

    def cast(
        self, origins: Origins, directions: Float[np.ndarray, "N 3"]
    ) -> tuple[Int[np.ndarray, "N"], Float32[np.ndarray, "N"]]:
        """Triangle that each ray hits first, -1 without a hit, and how many lengths of the ray it is away. [N], [N]"""
        triangle, parameter, _ = self.first_hits(origins, directions)
        return triangle, parameter

    def first_hits(
        self, origins: Origins, directions: Float[np.ndarray, "N 3"]
    ) -> tuple[Int[np.ndarray, "N"], Float32[np.ndarray, "N"], Float32[np.ndarray, "N 2"]]:
        """Hits as of :meth:`cast`, and the weights of the second and third corner there. [N], [N], [N, 2]"""
        answer = self._scene.cast_rays(self._rays(origins, directions))
        parameter = answer["t_hit"].numpy()
        triangle = answer["primitive_ids"].numpy().astype(np.int64)  # unsigned; its largest value without a hit
        return np.where(np.isfinite(parameter), triangle, -1), parameter, answer["primitive_uvs"].numpy()

    def blocked(self, origins: Origins, directions: Float[np.ndarray, "N 3"]) -> Bool[np.ndarray, "N"]:
        """True where the mesh occludes a segment; the last thousandth of a segment is ignored. [N]"""
        rays = self._rays(origins, directions)
        return np.asarray(self._scene.test_occlusions(rays, tnear=0.0, tfar=0.999).numpy())

    def nearest(self, points: Float[np.ndarray, "N 3"]) -> tuple[Float[np.ndarray, "N"], Int[np.ndarray, "N"]]:
        """Distance to the nearest point of any triangle, scene units, and that triangle. [N], [N]"""
        points = np.ascontiguousarray(points, np.float32)
        closest = self._scene.compute_closest_points(self._open3d.core.Tensor(points))
        distances = np.linalg.norm(closest["points"].numpy().astype(np.float64) - points, axis=1)
        return distances, closest["primitive_ids"].numpy().astype(np.int64)

    def distance(self, points: Float[np.ndarray, "N 3"]) -> Float32[np.ndarray, "N"]:
        """Distance to the nearest point of any triangle in float32, faster than :meth:`nearest`. [N]"""
        points = np.ascontiguousarray(points, np.float32)
        return np.asarray(self._scene.compute_distance(self._open3d.core.Tensor(points)).numpy())

    def _rays(self, origins: Origins, directions: Float[np.ndarray, "N 3"]) -> Any:
        rays = np.empty((len(directions), 6), np.float32)
        rays[:, :3], rays[:, 3:] = origins, directions
        return self._open3d.core.Tensor(rays)


@dataclass(frozen=True, eq=False)
class Texture:
    """Texture image of a mesh, and the texture coordinates of its triangles' corners."""

    image: UInt8[np.ndarray, "H W 3"]
    corners: Float[np.ndarray, "F 3 2"]  # of the triangles, from 0 to 1: to the right, and upwards from the last row

    @cached_property
    def coordinates(self) -> tuple[Float[np.ndarray, "P 2"], Int[np.ndarray, "F 3"]]:
        """The different texture coordinates, and for each triangle the indices of those of its corners."""
        places, of_corner = np.unique(self.corners.reshape(-1, 2), axis=0, return_inverse=True)
        return places, of_corner.reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """A triangle mesh in the world frame, scene units (mm for C3VD)."""

    vertices: Float[np.ndarray, "V 3"]
    triangles: Int[np.ndarray, "F 3"]  # vertices, counter-clockwise seen from the side that the camera was on
    colors: UInt8[np.ndarray, "V 3"] | None = None  # RGB of the vertices

    def __len__(self) -> int:
        return len(self.triangles)

    @cached_property
    def _crosses(self) -> Float[np.ndarray, "F 3"]:
        """Cross products of two edges: normal times twice the area. [F, 3]"""
        first, second, third = (self.vertices[self.triangles[:, corner]].astype(np.float64) for corner in range(3))
        return np.cross(second - first, third - first)

    @cached_property
    def areas(self) -> Float[np.ndarray, "F"]:
        """Area of each triangle. [F]"""
        return 0.5 * np.linalg.norm(self._crosses, axis=1)

    @cached_property
    def normals(self) -> Float[np.ndarray, "F 3"]:
        """Unit normal of each triangle; zero where it has no area. [F, 3]"""
        return self._crosses / np.maximum(2.0 * self.areas, np.finfo(np.float64).tiny)[:, None]

    @cached_property
    def centers(self) -> Float[np.ndarray, "F 3"]:
        """Centroid of each triangle. [F, 3]"""
        return self.vertices[self.triangles].mean(axis=1, dtype=np.float64)

    @cached_property
    def border(self) -> Int[np.ndarray, "E 2"]:
        """Boundary edges, those of one triangle only, as its directed pairs of vertices. [E, 2]"""
        edges, count = np.concatenate([self.triangles[:, [a, (a + 1) % 3]] for a in range(3)]), len(self.vertices)
        return edges[~np.isin(edges[:, 0] * count + edges[:, 1], edges[:, 1] * count + edges[:, 0])]

    @cached_property
    def on_border(self) -> Bool[np.ndarray, "V"]:
        """True for vertices on the border. [V]"""
        on_border = np.zeros(len(self.vertices), bool)
        on_border[self.border] = True
        return on_border

    @cached_property
    def rays(self) -> RayScene:
        """Casts rays at the mesh and measures distances to it; made once."""
        return RayScene(self.to_open3d())

    def part(self, chosen: Bool[np.ndarray, "F"]) -> TriangleMesh:
        """The mesh of some triangles, without the vertices that no longer belong to any."""
        used, corners = np.unique(self.triangles[chosen], return_inverse=True)
        colors = None if self.colors is None else self.colors[used]
        return TriangleMesh(self.vertices[used], corners.reshape(-1, 3), colors)

    def without_small_parts(self, share: float) -> TriangleMesh:
        """The mesh without parts, connected by vertices, whose area is below a share of that of the largest part."""
        if not len(self):
            return self
        areas = np.bincount(self.parts, self.areas)
        return self.part(areas[self.parts] >= share * areas.max())

    @cached_property
    def parts(self) -> Int[np.ndarray, "F"]:
        """Part, connected by vertices, that each triangle belongs to. [F]"""
        first, second, third = self.triangles.T
        rows, columns = np.concatenate([first, second]), np.concatenate([second, third])
        count = len(self.vertices)
        graph = coo_array((np.ones(len(rows), np.int8), (rows, columns)), shape=(count, count))
        return np.asarray(connected_components(graph, directed=False)[1][first])

    def to_open3d(self) -> Any:
        """The mesh as an ``open3d.t.geometry.TriangleMesh``, for ray casting and measures."""
        open3d = import_open3d("casts rays at meshes")
        converted = open3d.t.geometry.TriangleMesh(
            open3d.core.Tensor(np.ascontiguousarray(self.vertices, np.float32)),
            open3d.core.Tensor(np.ascontiguousarray(self.triangles, np.int64)),
        )
        if self.colors is not None:
            converted.vertex.colors = open3d.core.Tensor(np.ascontiguousarray(self.colors))
        return converted


#: Suffixes of the formats.
MESH_FORMATS = ("ply", "obj", "glb")

#: Names of the colours in a GLB file, and of the same length those under which trimesh reads them in their own type:
#: it takes the low byte of 16 bits.
_COLORS, _RAW_COLORS = "COLOR_0", "_OLOR_0"


def read_mesh(path: Path) -> TriangleMesh:
    """Read a mesh from a PLY, OBJ or GLB file, by its suffix; lengths are unchanged, polygons become triangles."""
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


def write_mesh(path: Path, mesh: TriangleMesh, texture: Texture | None = None) -> None:
    """Write a mesh atomically as PLY, OBJ or GLB, by the suffix; creates the folder.

    Vertex colours are written as they are: in PLY as uchar, in OBJ as three numbers in [0, 1] behind the position (an
    extension that MeshLab, Blender and open3d read), in GLB as linear light, as glTF demands. GLB has the same axes and
    lengths as the mesh; glTF's own are y up, metres. A texture is written in place of colours: into GLB, beside OBJ as
    MTL and PNG; PLY has none.
    """
    suffix = _suffix(path)
    if suffix == "ply":
        write_ply(path, point_properties(mesh.vertices, mesh.colors), mesh.triangles)
    elif suffix == "glb":
        atomic_write(path, encode_mesh(mesh, texture))
    elif texture is None:
        atomic_write(path, encode_obj(mesh))
    else:
        png, material = path.with_suffix(".png"), path.with_suffix(".mtl")
        write_image(png, texture.image)
        atomic_write(material, f"newmtl wall\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd {png.name}\n".encode())
        atomic_write(path, f"mtllib {material.name}\nusemtl wall\n".encode() + encode_obj(mesh, texture))


def _suffix(path: Path) -> str:
    suffix = path.suffix.lower().removeprefix(".")
    if suffix not in MESH_FORMATS:
        raise InputError(f"{path.name} is no mesh file by its name", f"one of {', '.join(MESH_FORMATS)}")
    return suffix


def _read_ply(path: Path) -> TriangleMesh:
    columns, triangles = read_triangles(path)
    with np.errstate(over="ignore"):
        vertices = np.stack([columns[name] for name in "xyz"], axis=1).astype(np.float32)
    return TriangleMesh(vertices, triangles, vertex_colors(path, columns))


def _read_glb(path: Path) -> TriangleMesh:
    import trimesh

    try:
        content = io.BytesIO(path.read_bytes().replace(f'"{_COLORS}"'.encode(), f'"{_RAW_COLORS}"'.encode()))
        read = trimesh.load_mesh(content, file_type="glb", process=False, skip_materials=True)
        vertices, triangles = np.asarray(read.vertices, np.float32), np.asarray(read.faces, np.int64)
        colors = read.vertex_attributes.get(_RAW_COLORS)
    except Exception as error:  # trimesh raises whatever it meets
        raise unreadable(
            path, f"{path} cannot be read as GLB: {error}", "a complete GLB file", "Fetch it again"
        ) from error
    if len(triangles) and (triangles.min() < 0 or triangles.max() >= len(vertices)):
        raise InputError(f"{path} has triangles of vertices that are not there", "a mesh", "Fetch it again")
    if colors is None or len(colors) != len(vertices):
        return TriangleMesh(vertices, triangles)
    light = colors[:, :3] / (np.iinfo(colors.dtype).max if colors.dtype.kind == "u" else 1.0)
    return TriangleMesh(vertices, triangles, _encoded(np.clip(np.nan_to_num(light), 0.0, 1.0)))


def encode_mesh(mesh: TriangleMesh, texture: Texture | None = None) -> bytes:
    """Bytes of a GLB file: one primitive, seen from both sides, with 8-bit colours or a texture."""
    import trimesh
    from PIL import Image
    from trimesh.exchange.gltf import export_glb

    material: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    visual = None
    if texture is not None:
        mesh, places = _split(mesh, texture)
        image = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(texture.image))
        visual = trimesh.visual.TextureVisuals(uv=places, material=image)
        material["baseColorTexture"] = {"index": 0}
    elif mesh.colors is not None:
        linear = np.rint(linear_light(mesh.colors / 255.0) * 255.0).astype(np.uint8)
        visual = trimesh.visual.ColorVisuals(vertex_colors=linear)

    def both_sides(document: dict[str, Any]) -> None:
        document["materials"] = [{"doubleSided": True, "pbrMetallicRoughness": material}]
        document["meshes"][0]["primitives"][0]["material"] = 0

    exported = trimesh.Trimesh(mesh.vertices, mesh.triangles, visual=visual, process=False)
    return bytes(export_glb(trimesh.Scene(exported), tree_postprocessor=both_sides))


def _split(mesh: TriangleMesh, texture: Texture) -> tuple[TriangleMesh, Float[np.ndarray, "V 2"]]:
    """The mesh, without colours, with a vertex for each of its texture coordinates, and these. [V, 2]"""
    places, of_corner = texture.coordinates
    keys, corners = np.unique(mesh.triangles.ravel() * len(places) + of_corner.ravel(), return_inverse=True)
    vertices, used = np.divmod(keys, len(places))
    return TriangleMesh(mesh.vertices[vertices], corners.reshape(-1, 3)), places[used]


def linear_light(encoded: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "V 3"]:
    """Linear light of sRGB colours, both in [0, 1]. [V, 3]"""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def _encoded(light: Float[np.ndarray, "V 3"]) -> UInt8[np.ndarray, "V 3"]:
    encoded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.rint(encoded * 255.0).astype(np.uint8)


#: Numbers of a vertex at most: position, w, colour. What follows them is not read one by one.
_MOST_NUMBERS = 7


def decode_obj(path: Path) -> tuple[TriangleMesh, Int[np.ndarray, "F"] | None]:
    """Read the triangles of an OBJ file; polygons are split into fans.

    The mesh has vertex colours where every ``v`` has six numbers, the last three up to 1 or to 255. Beside it, for each
    triangle, the texture index (``vt``, counted from 1) of its first corner; None where corners have none.
    """
    rows: dict[str, list[str]] = {"v ": [], "f ": []}
    try:
        with path.open(encoding="utf-8", errors="replace") as lines:
            for line in lines:
                if line[:2] in rows:
                    rows[line[:2]].append(line[2:])
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}", "an OBJ file") from error
    vertices, faces = _numbers(path, rows["v "]), rows["f "]
    corners, textures = _corners(path, faces)
    corners = np.where(corners < 0, corners + len(vertices), corners - 1)
    if corners.size and (corners.min() < 0 or corners.max() >= len(vertices)):
        raise InputError(f"{path} has faces of vertices that are not there", "a mesh", "Fetch it again")
    colors = None
    if vertices.shape[1] >= 6:
        colors, _ = eight_bits(vertices[:, 3:6])
    return TriangleMesh(vertices[:, :3].astype(np.float32), corners, colors), textures


def encode_obj(mesh: TriangleMesh, texture: Texture | None = None) -> bytes:
    """OBJ text of a mesh, colours in [0, 1] behind the positions; or places in a texture (``vt``) without colours."""
    text = io.BytesIO()
    rows, form = mesh.vertices.astype(np.float64), "v %.5f %.5f %.5f"
    if mesh.colors is not None and texture is None:
        rows, form = np.concatenate([rows, mesh.colors / 255.0], axis=1), form + " %.4f %.4f %.4f"
    np.savetxt(text, rows, form)
    if texture is None:
        np.savetxt(text, mesh.triangles + 1, "f %d %d %d")
    else:
        places, of_corner = texture.coordinates
        np.savetxt(text, places, "vt %.6f %.6f")
        corners = np.stack([mesh.triangles, of_corner], axis=-1).reshape(-1, 6)
        np.savetxt(text, corners + 1, "f %d/%d %d/%d %d/%d")
    return text.getvalue()


def _numbers(path: Path, rows: list[str]) -> np.ndarray:
    try:
        values = np.array([row.split(maxsplit=_MOST_NUMBERS) for row in rows], np.float64).reshape(len(rows), -1)
    except ValueError as error:
        raise unreadable(path, f"{path} has vertices that are not rows of numbers", "an OBJ file") from error
    if len(rows) and values.shape[1] < 3:
        raise InputError(f"{path} has vertices of {values.shape[1]} numbers", "x, y, z")
    return values if len(rows) else np.zeros((0, 3))


def _corners(path: Path, faces: list[str]) -> tuple[np.ndarray, np.ndarray | None]:
    """Vertex indices as they stand, [F, 3], and the texture index of each first corner, [F]."""
    vertices, textures = list[tuple[int, int, int]](), list[int]()
    try:
        for face in faces:
            fields = [corner.split("/") for corner in face.split()]
            indices = [int(field[0]) for field in fields]
            texture = int(fields[0][1]) if len(fields[0]) > 1 and fields[0][1] else 0
            for second, third in pairwise(indices[1:]):
                vertices.append((indices[0], second, third))
                textures.append(texture)
        corners, flags = np.array(vertices, np.int64).reshape(-1, 3), np.array(textures, np.int64)
    except (ValueError, IndexError, OverflowError) as error:
        raise InputError(f"{path} has a face that is not indices", "an OBJ file") from error
    return corners, flags if len(flags) and flags.all() else None
