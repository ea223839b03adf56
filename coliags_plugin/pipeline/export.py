"""Export of a reconstruction's sub-maps: COLMAP and nerfstudio layouts, trajectories, and how they are joined."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_folder, link_or_copy, make_folder, refuse_overlap, write_json
from coliags_plugin.core.scene_files import FRAME_SUFFIXES, write_unit
from coliags_plugin.geometry.poses import colmap, tum
from coliags_plugin.geometry.poses.trajectory import Trajectory
from coliags_plugin.pipeline.contents import Contents, SubmapContents, common_frames, read_contents

#: Name of the record of an export, and version of its schema.
MANIFEST, _FORMAT = "manifest.json", 1


def export_atlas(out: Path, folder: Path, overwrite: bool = False, link: bool = False) -> dict[str, Any]:
    """Export every sub-map of a video into a folder; returns the content of ``manifest.json``.

    A folder has (docs/reconstruct.md 9): ``colmap/`` with the posed images and the model, ``nerfstudio/`` with dense
    depth where it was estimated, and ``trajectory.txt`` in TUM's format, camera to world, at seconds of the video, or
    frame numbers where its rate is unknown. The manifest has, for each, the similarity from its world to that of the
    first one that it is joined to. With ``link``, images and depth are second names of the files in ``out``, where both
    are on one disk.

    Raises:
        InputError: ``out`` is of no video, has no poses, or is damaged; or ``folder`` is there without ``overwrite``.
    """
    contents = read_contents(out)
    submaps, video = {submap.key: submap for submap in contents.submaps if submap.names}, contents.video
    if not submaps:
        why = "; ".join(contents.problems)
        raise InputError(f"{out} has no sub-map with poses{f': {why}' if why else ''}", "at least one")
    refuse_overlap(folder, out)
    entries = []
    with atomic_folder(folder, overwrite) as scratch:
        for key, (first, to_first) in common_frames(contents).items():
            submap = submaps[key]
            place = f"{submap.segment or 'submap'}-{submap.number}"
            has_depth = _write_submap(contents, submap, scratch / place, link)
            entries.append(
                {
                    "name": submap.name,
                    "folder": place,
                    "frames": list(submap.names),
                    "unit": submap.unit,
                    "nerfstudio": has_depth,
                    "joined_to": submaps[first].name,
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


def _write_submap(contents: Contents, submap: SubmapContents, folder: Path, link: bool) -> bool:
    """Write the files of one sub-map; returns True if there is dense depth.

    Images are linked where asked for; all else, which programs write anew, is copied.
    """
    scene, depth = contents.folder / submap.segment / "poses", contents.folder / submap.folder / "depth"
    model = scene / submap.model
    poses = colmap.read(model)
    numbers = {name: number for number, name in submap.names.items()}
    names = poses.names_or_numbers()
    if set(names) != set(numbers):
        raise InputError(
            f"{model} has {len(names)} frames, and the atlas of its scene names {len(numbers)} of it",
            "the same frames",
            "Restore the segment, or reconstruct it again",
        )
    frames = np.array([numbers[name] for name in names])
    order = np.argsort(frames)
    make_folder(folder)
    trajectory = Trajectory(poses.camera_to_world[order], timestamps=contents.seconds(frames[order]))
    tum.write(folder / "trajectory.txt", trajectory)
    files = {f"colmap/images/{name}": scene / "images" / name for name in names}
    files |= {f"colmap/masks/{name}.png": mask for name in names if (mask := scene / f"masks/{name}.png").is_file()}
    files |= {f"colmap/sparse/0/{file.name}": file for file in sorted(model.iterdir())}
    has_depth = bool(submap.stages) and (depth / "transforms.json").is_file()
    for file in sorted(depth.rglob("*")) if has_depth else ():
        if file.is_file():
            files[f"nerfstudio/{file.relative_to(depth).as_posix()}"] = file
    for place, file in files.items():
        make_folder((folder / place).parent)
        is_image = file.suffix.lower() in FRAME_SUFFIXES
        (link_or_copy if link and is_image else shutil.copyfile)(file, folder / place)
    write_unit(folder / "colmap", submap.unit)
    return has_depth
