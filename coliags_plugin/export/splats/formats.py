"""Files of Gaussians: PLY as 3D Gaussian Splatting has them, SPZ by the library gsply, and GLB, only written.

A format has a function that writes a file of a path, a cloud and a comment, and one that reads a path, if it is read.
"""

from __future__ import annotations

import json
import logging
import math
import struct
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import expit

from coliags_plugin.core.errors import InputError, check_name
from coliags_plugin.core.files import atomic_write
from coliags_plugin.core.ply import read_vertices, write_ply
from coliags_plugin.core.text_files import unreadable
from coliags_plugin.export.splats.cloud import SplatCloud
from coliags_plugin.fields.spherical_harmonics import MAX_DEGREE
from coliags_plugin.geometry.meshes.mesh import linear_light

log = logging.getLogger(__name__)

# PLY

#: Read of a file to know its header: 3DGS's has 1.5 kB.
_HEADER_BYTES = 65536
_ROTATIONS = tuple(f"rot_{index}" for index in range(4))
_SCALES = tuple(f"scale_{index}" for index in range(3))
_BASES = tuple(f"f_dc_{index}" for index in range(3))
_NEEDED = ("x", "y", "z", *_BASES, "opacity", *_SCALES[:2], *_ROTATIONS)
#: Properties of files of other kinds of Gaussians, and what these are.
_OTHER_KINDS = {
    "packed_position": "a compressed PLY (quantised in chunks, as SuperSplat writes it)",
    "f_offset_0": "a PLY of anchors (Scaffold-GS), which are Gaussians only together with their networks",
    "f_anchor_feat_0": "a PLY of anchors (Scaffold-GS), which are Gaussians only together with their networks",
    "filter_3D": "a PLY of Mip-Splatting, whose 3D filter is not applied to its scales and opacities",
    "trbf_center": "a PLY of Gaussians that move with time",
    "motion_0": "a PLY of Gaussians that move with time",
}


def _write_ply(path: Path, cloud: SplatCloud, comment: str) -> None:
    """Write Gaussians in 3DGS's order of attributes, binary little-endian, with the comment in the header.

    ``x y z nx ny nz f_dc_* f_rest_* opacity scale_* rot_*``: normals are 0, ``f_rest`` is channel by channel, opacities
    are logits, scales logarithms, and rotations w first.
    """
    rest = cloud.harmonics[:, 1:].transpose(0, 2, 1).reshape(len(cloud), -1)
    zeros = np.zeros(len(cloud), np.float32)
    write_ply(
        path,
        {
            **dict(zip("xyz", cloud.means.T, strict=True)),
            **dict.fromkeys(("nx", "ny", "nz"), zeros),
            **dict(zip(_BASES, cloud.harmonics[:, 0].T, strict=True)),
            **{f"f_rest_{index}": column for index, column in enumerate(rest.T)},
            "opacity": cloud.logits,
            **dict(zip(_SCALES, cloud.log_scales.T, strict=True)),
            **dict(zip(_ROTATIONS, cloud.unit_quats_wxyz.T, strict=True)),
        },
        comment=comment,
    )


def _read_ply(path: Path) -> SplatCloud:
    """Read Gaussians, or surfels (without ``scale_2``), of 3DGS's lineage; normals and other properties are ignored.

    Rows may have numbers that are not finite: :meth:`SplatCloud.checked`.
    """
    _refuse_other_kinds(path)
    columns = read_vertices(path, needed=_NEEDED)
    rest = [name for name in columns if name.startswith("f_rest_")]
    per_channel = len(rest) // 3
    counts = {(degree + 1) ** 2 - 1: degree for degree in range(MAX_DEGREE + 1)}
    if len(rest) % 3 or per_channel not in counts or set(rest) != {f"f_rest_{index}" for index in range(len(rest))}:
        numbers = ", ".join(str(3 * count) for count in counts)
        raise InputError(f"{path}: {len(rest)} properties f_rest_*", f"f_rest_0 and so on, {numbers} of them")
    higher = np.array([columns[f"f_rest_{index}"] for index in range(len(rest))], np.float32)
    higher = higher.reshape(3, per_channel, len(columns["x"])).transpose(2, 1, 0)
    scales = _SCALES if "scale_2" in columns else _SCALES[:2]
    opacity, log_scales = columns["opacity"], _stacked(columns, scales)
    if ((opacity >= 0.0) & (opacity <= 1.0)).all() and (log_scales > 0.0).all():
        log.warning(
            "%s: opacities of %.3g to %.3g and scales of %.3g to %.3g look like results of sigmoid and exponential; "
            "they are read as logits and logarithms, as 3DGS writes them. If that draws fog, export the file anew",
            *(path, opacity.min(), opacity.max(), log_scales.min(), log_scales.max()),
        )
    with np.errstate(over="ignore"):
        return SplatCloud(
            means=_stacked(columns, ("x", "y", "z")),
            quats_wxyz=_stacked(columns, _ROTATIONS),
            scales=np.exp(log_scales),
            opacities=expit(opacity.astype(np.float64)).astype(np.float32),
            harmonics=np.concatenate([_stacked(columns, _BASES)[:, None], higher], axis=1),
        )


def _refuse_other_kinds(path: Path) -> None:
    try:
        with path.open("rb") as file:
            header = file.read(_HEADER_BYTES).partition(b"end_header")[0].decode("ascii", "replace")
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}", "a PLY file of Gaussians") from error
    properties = {line.split()[-1] for line in header.splitlines() if line.startswith("property ")}
    kinds = [kind for name, kind in _OTHER_KINDS.items() if name in properties]
    missing = [name for name in _NEEDED if name not in properties]
    if kinds or (missing and "red" in properties):
        raise InputError(
            f"{path} is {[*kinds, 'a point cloud or mesh'][0]}",
            "a PLY of 3D Gaussians in 3DGS's attributes (x y z f_dc_* f_rest_* opacity scale_* rot_*)",
            "Convert it, for instance with `splat-transform IN OUT.ply`, or export it anew",
        )


def _stacked(columns: dict[str, np.ndarray], names: tuple[str, ...]) -> np.ndarray:
    """Columns side by side. [N, C]"""
    return np.stack([columns[name] for name in names], axis=1).astype(np.float32)


# SPZ

#: Bits of a coordinate, its sign apart; and the most of them behind the binary point: 1/4096 of a scene unit.
_COORDINATE_BITS, _MOST_FRACTIONAL_BITS = 23, 12
#: The container that all readers know: gzip, with rotations of 32 bits.
_CONTAINER = 3
#: Signs of the spherical harmonics, degree by degree, under half a turn about x: -1 where odd in y and z together.
_TURNED = np.array([1, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)
#: Of positions and of quaternions' vector parts under the same turn.
_AXES = np.array([1, -1, -1], np.float32)


def write_spz(path: Path, cloud: SplatCloud, comment: str = "") -> None:
    """Write Gaussians quantised: positions to 1/4096 of a unit, log scales to 1/16 in [-10, 5.9], all else to 8 bits.

    SPZ's axes are right, up, back: what is written is turned by half a turn about x, and turned back when read. Clouds
    of more than 2048 units from the origin get coarser positions. The format has no place for a comment.
    """
    import gsply

    reach = float(np.abs(cloud.means).max())
    bits = min(_MOST_FRACTIONAL_BITS, _COORDINATE_BITS - max(0, math.floor(math.log2(max(reach, 1.0))) + 1))
    if bits < 1:
        raise InputError(
            f"Gaussians {reach:g} scene units from the origin", "at most 2^21 units, SPZ's range", "Write a PLY"
        )
    turned = _half_turn(cloud)
    data = gsply.GSData.from_arrays(
        means=turned.means,
        scales=turned.log_scales,
        quats=turned.unit_quats_wxyz,
        opacities=turned.logits,
        sh0=turned.harmonics[:, 0],
        shN=turned.harmonics[:, 1:] if turned.degree else None,
        format="ply",
    )
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder) / "cloud.spz"
        gsply.write_spz(scratch, data, version=_CONTAINER, fractional_bits=bits)
        atomic_write(path, scratch.read_bytes())


def read_spz(path: Path) -> SplatCloud:
    """Read Gaussians, turned from SPZ's axes as :func:`write_spz` turned them."""
    import gsply

    try:
        data = gsply.read_spz(path)
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}", "an SPZ file") from error
    except Exception as error:  # gsply and the decompressors beneath raise whatever they like
        raise unreadable(path, f"{path} cannot be read as SPZ: {error}", "an SPZ file of version 1 to 4") from error
    first = np.asarray(data.sh0)[:, None]
    higher = [] if data.shN is None else [np.asarray(data.shN)]
    return _half_turn(
        SplatCloud(
            means=np.asarray(data.means),
            quats_wxyz=np.asarray(data.quats),
            scales=np.exp(np.asarray(data.scales)),
            opacities=expit(np.asarray(data.opacities, np.float64)).astype(np.float32),
            harmonics=np.concatenate([first, *higher], axis=1),
        )
    )


def _half_turn(cloud: SplatCloud) -> SplatCloud:
    """The cloud turned by half a turn about x, which is its own inverse up to the sign of quaternions."""
    w, x, y, z = cloud.quats_wxyz.T
    return SplatCloud(
        means=cloud.means * _AXES,
        # The local axes are turned along, which reverses two of them: an ellipsoid stays what it is.
        quats_wxyz=np.stack([w, x, -y, -z], axis=1),
        scales=cloud.scales,
        opacities=cloud.opacities,
        harmonics=cloud.harmonics * _TURNED[: cloud.harmonics.shape[1], None],
    )


# GLB

_EXTENSION = "KHR_gaussian_splatting"
#: glTF's numbers of a primitive of points, of float32 and of a buffer of vertices, and its shapes by their channels.
_POINTS, _FLOAT32, _VERTICES = 0, 5126, 34962
_SHAPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def _write_glb(path: Path, cloud: SplatCloud, comment: str) -> None:
    """Write Gaussians as one primitive of points, float32, with the comment in ``asset.extras``.

    Attributes keep the world frame and unit of the cloud, and no node turns them, as in GLB files of meshes. Readers
    without the extension see plain points in the colours of ``COLOR_0``, linear light as in all of glTF.
    """
    attributes = _attributes(cloud)
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    size = 0
    for index, values in enumerate(attributes.values()):
        views.append({"buffer": 0, "byteOffset": size, "byteLength": values.nbytes, "target": _VERTICES})
        shape = {"count": len(values), "type": _SHAPES[values.shape[1]]}
        accessors.append({"bufferView": index, "componentType": _FLOAT32, **shape})
        size += values.nbytes
    accessors[0] |= {"min": cloud.means.min(axis=0).tolist(), "max": cloud.means.max(axis=0).tolist()}
    primitive = {
        "attributes": {name: index for index, name in enumerate(attributes)},
        "mode": _POINTS,
        "extensions": {_EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
    document = {
        "asset": {"version": "2.0", "generator": "coliags_plugin", "extras": {"comment": comment}},
        "extensionsUsed": [_EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": size}],
        "bufferViews": views,
        "accessors": accessors,
    }
    text = json.dumps(document, allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    body = b"".join(np.ascontiguousarray(values, "<f4").tobytes() for values in attributes.values())
    # Version 2; each chunk has its length and kind.
    header = struct.pack("<4sIII4s", b"glTF", 2, 12 + 8 + len(text) + 8 + len(body), len(text), b"JSON")
    atomic_write(path, header + text + struct.pack("<I4s", len(body), b"BIN\0") + body)


def _attributes(cloud: SplatCloud) -> dict[str, np.ndarray]:
    """Attributes by their names. [N, C] each"""
    opaque = np.clip(cloud.opacities, 0.0, 1.0)[:, None]
    named = {
        "POSITION": cloud.means,
        "COLOR_0": np.concatenate([linear_light(cloud.colors), opaque], axis=1),
        f"{_EXTENSION}:ROTATION": np.roll(cloud.unit_quats_wxyz, -1, axis=1),
        f"{_EXTENSION}:SCALE": cloud.scales,
        f"{_EXTENSION}:OPACITY": opaque,
    }
    for degree in range(cloud.degree + 1):
        for order in range(2 * degree + 1):
            coefficients = cloud.harmonics[:, degree * degree + order]
            named[f"{_EXTENSION}:SH_DEGREE_{degree}_COEF_{order}"] = coefficients
    return {name: values.astype(np.float32) for name, values in named.items()}


# All formats

#: Functions that write a format, and that read it, by its name, the suffix of its files.
WRITERS: dict[str, Callable[[Path, SplatCloud, str], None]] = {"ply": _write_ply, "spz": write_spz, "glb": _write_glb}
READERS: dict[str, Callable[[Path], SplatCloud]] = {"ply": _read_ply, "spz": read_spz}


def write_splats(path: Path, cloud: SplatCloud, name: str, comment: str = "") -> None:
    """Write at least one Gaussian, all finite, in a named format; surfels become flat Gaussians."""
    check_name("format", name, WRITERS)
    if not len(cloud):
        raise InputError("no Gaussian to write", "at least one")
    WRITERS[name](path, cloud.with_thickness(), comment)


def read_splats(path: Path) -> SplatCloud:
    """Read Gaussians, in the format of the suffix; rows that are not finite are dropped with a warning."""
    read = READERS.get(path.suffix.lower().removeprefix("."))
    if read is None:
        formats = ", ".join(f".{name}" for name in READERS)
        raise InputError(f"{path}: no reader for '{path.suffix}'", f"a file {formats}")
    return read(path).checked(path)
