"""Finding the files of C3VD as prepared by EndoGSLAM and PR-Endo (docs/layouts/c3vd-endogslam.md 1, 2)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from coliags_plugin.core.errors import InputError
from coliags_plugin.datamanagers.reading.files import TIFF_SUFFIXES, numbered, numbered_images, paired, require_folder
from coliags_plugin.geometry.poses.c3vd import recognise as has_matrices

LAYOUT = (
    "EndoGSLAM's C3VD: color/NNNN_color.png and depth/NNNN_depth.tiff with pose.txt, params.npz or both; "
    "or PR-Endo's: C3VD/<scene> beside C3VD_endogslam_optimized/<scene>"
)
PARAMS = "params.npz"
#: PR-Endo's release has the scenes in a folder X and EndoGSLAM's results in X_endogslam_optimized.
OPTIMIZED = "_endogslam_optimized"


@dataclass(frozen=True)
class PreparedFiles:
    """The files of one sequence, frame 0 first.

    ``params`` is EndoGSLAM's result, ``cloud`` the optimised Gaussians of PR-Endo's release.
    """

    folder: Path
    images: tuple[Path, ...]
    depths: tuple[Path, ...] | None
    poses: Path | None
    params: Path | None
    cloud: Path | None


def recognise(folder: Path) -> str | None:
    """The files that identify such a sequence or the folder of PR-Endo's release; None otherwise."""
    images = any(re.fullmatch(r"\d+_color", path.stem) for path in folder.glob("color/*.png"))
    poses = folder / "pose.txt"
    if images and _params(folder, None) is not None:
        return "color/NNNN_color.png and a params.npz"
    if images and poses.is_file() and has_matrices(poses):
        return "pose.txt (16 numbers a line) beside color/NNNN_color.png"
    if not images and (beside := _release(folder)):
        return f"{beside[0].parent.name}{OPTIMIZED}/ beside {beside[0].parent.name}/"
    return None


def scene_folder(path: Path) -> Path:
    """The sequence's folder: ``path`` itself, or the only scene of PR-Endo's release in it."""
    require_folder(path, LAYOUT)
    scenes = [] if (path / "color").is_dir() else _release(path)
    if len(scenes) > 1:
        raise InputError(f"{path} holds several scenes", "one scene", f"Name one, for instance {sorted(scenes)[0]}")
    return scenes[0] if scenes else path


def find_sequence(folder: Path, params_file: str | None) -> PreparedFiles:
    """Find the files of the sequence in the folder that contains ``color``.

    ``params_file`` is EndoGSLAM's result, relative to the folder or absolute; None: search in the folder and in
    PR-Endo's release.
    """
    images = numbered_images(folder / "color", "color", LAYOUT, "C3VD/cecum_t1_b")
    depths = numbered(folder / "depth", "depth", TIFF_SUFFIXES)
    params = _params(folder, params_file)
    poses = folder / "pose.txt"
    return PreparedFiles(
        folder,
        *paired(folder, images, depths),
        poses if poses.is_file() else None,
        params,
        None if params is None else _newest_cloud(params.parent),
    )


def _params(folder: Path, params_file: str | None) -> Path | None:
    if params_file is not None:
        if not (folder / params_file).is_file():
            raise InputError(f"no file {folder / params_file}", "EndoGSLAM's params.npz", "Correct params_file")
        return folder / params_file
    here = folder.resolve()
    beside = here.parent.with_name(here.parent.name + OPTIMIZED) / here.name if here.parent.name else here
    return next((path / PARAMS for path in (folder, beside) if (path / PARAMS).is_file()), None)


def _newest_cloud(folder: Path) -> Path | None:
    """``point_cloud/iteration_N/point_cloud.ply`` of the largest N."""
    clouds = {
        int(match.group(1)): path
        for path in folder.glob("point_cloud/iteration_*/point_cloud.ply")
        if (match := re.fullmatch(r"iteration_(\d+)", path.parent.name))
    }
    return clouds[max(clouds)] if clouds else None


def _release(folder: Path) -> list[Path]:
    """The scenes of PR-Endo's release in a folder for which EndoGSLAM's result exists."""
    return [
        scene
        for results in folder.glob(f"*{OPTIMIZED}")
        for scene in (folder / results.name.removesuffix(OPTIMIZED)).glob("*")
        if (scene / "color").is_dir() and (results / scene.name / PARAMS).is_file()
    ]
