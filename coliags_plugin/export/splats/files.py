"""Formats of files of Gaussians, by name and suffix."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from coliags_plugin.core.errors import InputError, did_you_mean
from coliags_plugin.export.splats.cloud import SplatCloud
from coliags_plugin.export.splats.dot_splat import read_dot_splat, write_dot_splat
from coliags_plugin.export.splats.gltf import write_splat_glb
from coliags_plugin.export.splats.ply import read_splat_ply, write_splat_ply
from coliags_plugin.export.splats.spz import read_splat_spz, write_spz

log = logging.getLogger(__name__)

#: Third scale of surfels in files, as a share of the smaller other one: small, and a finite logarithm.
THICKNESS_SHARE = 0.01


@dataclass(frozen=True)
class SplatFormat:
    """A writer of path, cloud and comment, a reader where such files are read, and what of the numbers is kept."""

    write: Callable[[Path, SplatCloud, str], None]
    read: Callable[[Path], SplatCloud] | None
    keeps: str


#: By name, which is the suffix without its dot.
FORMATS: Mapping[str, SplatFormat] = {
    "ply": SplatFormat(write_splat_ply, read_splat_ply, "all numbers as float32"),
    "spz": SplatFormat(
        write_spz,
        read_splat_spz,
        "positions to 1/4096 unit, log scales to 1/16, colours, opacities and harmonics to 8 bits",
    ),
    "splat": SplatFormat(
        write_dot_splat,
        read_dot_splat,
        "positions and scales as float32, colours of degree 0, opacities and rotations to 8 bits",
    ),
    "glb": SplatFormat(write_splat_glb, None, "all numbers as float32"),
}


def check_format(name: str) -> None:
    """Refuse a name of no format."""
    if name not in FORMATS:
        raise InputError(f"no format '{name}'", f"one of {', '.join(FORMATS)}", did_you_mean(name, FORMATS))


def write_splats(path: Path, cloud: SplatCloud, name: str, comment: str = "") -> None:
    """Write at least one Gaussian, all finite, in a named format; surfels become flat Gaussians."""
    check_format(name)
    if not len(cloud):
        raise InputError("no Gaussian to write", "at least one")
    FORMATS[name].write(path, cloud.with_thickness(THICKNESS_SHARE), comment)


def read_splats(path: Path) -> SplatCloud:
    """Read Gaussians, in the format of the suffix; rows that are not finite are dropped with a warning."""
    readers = {f".{name}": known.read for name, known in FORMATS.items() if known.read is not None}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise InputError(f"{path}: no reader for '{path.suffix}'", f"a file {', '.join(readers)}")
    cloud = reader(path)
    usable = cloud.usable()
    dropped = len(cloud) - int(usable.sum())
    if dropped == len(cloud):
        raise InputError(
            f"{path} has {len(cloud)} Gaussians, none of which is usable", "finite numbers, rotations not 0"
        )
    if dropped:
        log.warning("%s: dropped %d of %d Gaussians that are not finite or have no rotation", path, dropped, len(cloud))
        cloud = cloud.part(usable)
    return cloud
