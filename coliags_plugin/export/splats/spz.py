"""SPZ files of Gaussians, by the library gsply."""

from __future__ import annotations

import math
import tempfile
from pathlib import Path

import numpy as np
from scipy.special import expit

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_write
from coliags_plugin.core.text_files import unreadable
from coliags_plugin.export.splats.cloud import SplatCloud

#: Bits of a coordinate, its sign apart; and the most of them behind the binary point: 1/4096 of a scene unit.
_COORDINATE_BITS, _MOST_FRACTIONAL_BITS = 23, 12
#: The container that all readers know: gzip, with rotations of 32 bits.
_CONTAINER = 3
#: Signs of the spherical harmonics, degree by degree, under half a turn about x: -1 where odd in y and z together.
_TURNED = np.array([1, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)
#: Of positions and of quaternions' vector parts under the same turn.
_AXES = np.array([1, -1, -1], np.float32)


def write(path: Path, cloud: SplatCloud, comment: str = "") -> None:
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


def read(path: Path) -> SplatCloud:
    """Read Gaussians, turned from SPZ's axes as :func:`write` turned them."""
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
