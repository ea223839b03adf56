"""PLY files of Gaussians as 3D Gaussian Splatting has them."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
from scipy.special import expit

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.ply import read_vertices, write_ply
from coliags_plugin.export.splats.cloud import SplatCloud
from coliags_plugin.fields.spherical_harmonics import MAX_DEGREE

log = logging.getLogger(__name__)

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
    "red": "a point cloud or mesh",
}


def write(path: Path, cloud: SplatCloud, comment: str = "") -> None:
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


def read(path: Path) -> SplatCloud:
    """Read Gaussians, or surfels (without ``scale_2``), of 3DGS's lineage; normals and other properties are ignored.

    Rows may have numbers that are not finite: :meth:`SplatCloud.usable`.
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
            header = file.read(_HEADER_BYTES).partition(b"end_header")[0]
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}", "a PLY file of Gaussians") from error
    lines = map(str.split, header.decode("ascii", "replace").splitlines())
    properties = {words[-1] for words in lines if words and words[0] == "property"}
    for name, kind in _OTHER_KINDS.items():
        if name in properties and not (name == "red" and properties.issuperset(_NEEDED)):
            raise InputError(
                f"{path} is {kind}",
                "a PLY of 3D Gaussians in 3DGS's attributes (x y z f_dc_* f_rest_* opacity scale_* rot_*)",
                "Convert it, for instance with `splat-transform IN OUT.ply`, or export it anew",
            )


def _stacked(columns: dict[str, np.ndarray], names: tuple[str, ...]) -> np.ndarray:
    """Columns side by side. [N, C]"""
    return np.stack([columns[name] for name in names], axis=1).astype(np.float32)
