"""True surfaces of scenes: meshes with the part that the camera saw."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from coliags_plugin.core.arrays import read_arrays
from coliags_plugin.core.errors import InputError
from coliags_plugin.geometry.meshes.files import read_flagged_mesh
from coliags_plugin.geometry.meshes.mesh import TriangleMesh

#: Where the truth of a scene lies in its folder: of phantoms, and C3VD's.
_PLACES = ("truth/mesh.ply", "coverage_mesh.obj")
#: C3VD's texture indices of triangles that were seen, and that were not.
_OBSERVED, _UNOBSERVED = 1, 2


@dataclass(frozen=True, eq=False)
class TrueSurface:
    """The true surface of a scene."""

    path: Path  # where it was read from
    mesh: TriangleMesh  # world frame of the scene, mm
    seen: Bool[np.ndarray, "F"]  # True for triangles that the camera saw
    seen_by: str  # how that is known; empty where it is not, and ``seen`` is all True


def find_true_surface(scene: Path) -> Path | None:
    """File of the true surface in a scene's folder, if there is one: ``truth/mesh.ply`` or ``coverage_mesh.obj``."""
    return next((scene / name for name in _PLACES if (scene / name).is_file()), None)


def read_true_surface(path: Path, any_frame: bool = False) -> TrueSurface:
    """Read a true surface, of a mesh or of the folder of a scene with one, and what was seen of it.

    Seen are, of a phantom, the triangles of ``face_seen`` in ``mesh_seen.npz`` beside it: those that are the first hit
    of a pixel of a training frame; or, with ``any_frame``, those of ``face_seen_by_any_frame``, held out or not. Of
    C3VD's ``coverage_mesh.obj``, those of texture index 1: observed in any frame.

    Raises:
        InputError: There is no mesh, or a file is damaged or does not belong to it.
    """
    if path.is_dir():
        surface = find_true_surface(path)
        if surface is None:
            raise InputError(f"{path} has no true surface", f"{' or '.join(_PLACES)} in it, or the path of a mesh")
        path = surface
    mesh, textures = read_flagged_mesh(path)
    flags = path.parent / "mesh_seen.npz"
    if path.suffix.lower() == ".ply" and flags.is_file():
        of, key = ("any", "face_seen_by_any_frame") if any_frame else ("a training", "face_seen")
        return TrueSurface(path, mesh, _phantom_flags(flags, key, mesh), f"first hit of a pixel of {of} frame")
    if textures is not None and set(np.unique(textures)) <= {_OBSERVED, _UNOBSERVED}:
        seen = textures == _OBSERVED
        if not seen.any():
            raise InputError(f"{path} marks no triangle as seen", "vt 1 at the triangles that were observed")
        return TrueSurface(path, mesh, seen, "observed in any frame, by its vt 1")
    return TrueSurface(path, mesh, np.ones(len(mesh), bool), "")


def _phantom_flags(path: Path, key: str, mesh: TriangleMesh) -> Bool[np.ndarray, "F"]:
    seen = read_arrays(path, f"an NPZ file with '{key}'", [key])[key]
    if seen.shape != (len(mesh),) or seen.dtype != bool:
        raise InputError(
            f"{path} has {seen.dtype} flags of shape {list(seen.shape)}", f"one bool for each of {len(mesh)} triangles"
        )
    return seen
