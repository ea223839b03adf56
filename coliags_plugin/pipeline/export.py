"""Export of a reconstruction's sub-maps: COLMAP and nerfstudio layouts, trajectories, and how they are joined."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_folder, link_or_copy, make_folder, refuse_overlap, write_json
from coliags_plugin.datamanagers.reading.files import FRAME_SUFFIXES
from coliags_plugin.datamanagers.scene_settings import write_unit
from coliags_plugin.geometry.poses import colmap, tum
from coliags_plugin.geometry.poses.trajectory import Trajectory
from coliags_plugin.pipeline.contents import Contents, SubmapContents, common_frames, read_contents
from coliags_plugin.pipeline.steps import Submap

#: Name of the record of an export, and version of its schema.
MANIFEST, _FORMAT = "manifest.json", 1


def export_atlas(out: Path, folder: Path, overwrite: bool = False, link: bool = False) -> dict[str, Any]:
    """Write the sub-maps of a video, each in a folder of its own; returns what ``manifest.json`` says.

    Of each sub-map (docs/reconstruct.md 9): ``colmap/`` with the posed images and the model, ``nerfstudio/`` with dense
    depth where it was estimated, and ``trajectory.txt`` in TUM's format, camera to world, at seconds of the video, or
    frame numbers where its rate is unknown. The manifest has, for each, the similarity from its world to that of the
    first one that it is joined to. With ``link``, images and depth are second names of the files in ``out``, where both
    are on one disk.

    Raises:
        InputError: ``out`` is of no video, has no poses, or is damaged; or ``folder`` is there without ``overwrite``.
    """
    contents = read_contents(out)
    submaps, video = [submap for submap in contents.submaps if submap.names], contents.video
    if not submaps:
        why = "; ".join(contents.problems)
        raise InputError(f"{out} has no sub-map with poses{f': {why}' if why else ''}", "at least one")
    refuse_overlap(folder, out)
    placed = common_frames(contents)
    names = {submap.key: submap.name for submap in submaps}
    entries = []
    with atomic_folder(folder, overwrite) as scratch:
        for submap in submaps:
            first, to_first = placed[submap.key]
            own = f"{submap.segment or 'submap'}-{submap.number}"
            copy = link_or_copy if link else shutil.copyfile
            has_depth = _write_submap(out / submap.segment, submap, contents, scratch / own, copy)
            entries.append(
                {
                    "name": submap.name,
                    "folder": own,
                    "frames": list(submap.names),
                    "unit": submap.unit,
                    "nerfstudio": has_depth,
                    "joined_to": names[first],
                    "to_joined": to_first.tolist(),
                }
            )
        manifest = {
            "format": _FORMAT,
            "source": [video.source],
            "frames": video.frames,
            "rate": video.rate,
            "size": list(video.size or ()),
            "timestamps": "frame number" if video.rate is None else "s",
            "submaps": entries,
            "joins": [join.model_dump(mode="json") for join in contents.joins],
            "not_read": list(contents.problems),
        }
        write_json(scratch / MANIFEST, manifest)
    return manifest


def _write_submap(
    segment: Path, submap: SubmapContents, contents: Contents, folder: Path, copy: Callable[[Path, Path], object]
) -> bool:
    """Write the files of one sub-map, images by ``copy``; returns whether there is dense depth."""
    scene, model = segment / "poses", segment / "poses" / submap.model
    poses = colmap.read(model)
    numbers = {name: number for number, name in submap.names.items()}
    posed = poses.names_or_numbers()
    if set(posed) != set(numbers):
        raise InputError(
            f"{model} has {len(posed)} frames, and the atlas of its scene names {len(numbers)} of it",
            "the same frames",
            "Restore the segment, or reconstruct it again",
        )
    frames = np.array([numbers[name] for name in posed])
    order = np.argsort(frames)
    make_folder(folder)
    trajectory = Trajectory(poses.camera_to_world[order], timestamps=contents.seconds(frames[order]))
    tum.write(folder / "trajectory.txt", trajectory)
    files = [(scene / "images" / name, f"colmap/images/{name}") for name in posed]
    masks = [(scene / "masks" / f"{name}.png", f"colmap/masks/{name}.png") for name in posed]
    files += [(mask, place) for mask, place in masks if mask.is_file()]
    files += [(file, f"colmap/sparse/0/{file.name}") for file in sorted(model.iterdir())]
    _copy(files, folder, copy)
    write_unit(folder / "colmap", submap.unit)
    depth = segment / Submap(submap.number).folder / "depth"
    if not submap.stages or not (depth / "transforms.json").is_file():
        return False
    inside = sorted(path for path in depth.rglob("*") if path.is_file())
    _copy([(file, f"nerfstudio/{file.relative_to(depth).as_posix()}") for file in inside], folder, copy)
    return True


def _copy(files: Sequence[tuple[Path, str]], folder: Path, copy: Callable[[Path, Path], object]) -> None:
    """Bring files to their places in a folder: images by ``copy``; all else, which programs write anew, as a copy."""
    for parent in {(folder / place).parent for _, place in files}:
        make_folder(parent)
    for file, place in files:
        (copy if file.suffix.lower() in FRAME_SUFFIXES else shutil.copyfile)(file, folder / place)
