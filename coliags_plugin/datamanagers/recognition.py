"""Recognition of a folder's format by its files."""

from __future__ import annotations

import logging
import shlex
from pathlib import Path

from coliags_plugin.config import registry
from coliags_plugin.config.components import candidates
from coliags_plugin.core.errors import InputError
from coliags_plugin.datamanagers.reading.files import FRAME_SUFFIXES, files_in, inventory
from coliags_plugin.geometry.lenses.vicalib import calibration_files
from coliags_plugin.geometry.poses.trajectory import natural_order

log = logging.getLogger(__name__)

#: Suffixes of video files, in lower case.
_VIDEO_SUFFIXES = {*".3gp .avi .dv .flv .m2ts .m4v .mkv .mov .mp4 .mpeg .mpg .mts .mxf .ts .vob .webm .wmv".split()}


def formats() -> list[str]:
    """Names of all data managers that read a format of their own."""
    return candidates("datamanagers")


def find_format(path: Path) -> str:
    """The name of the one data manager that recognises a folder."""
    known = ", ".join(formats())
    if not path.exists():
        raise InputError(f"no folder {path}", f"a scene in one of the formats {known}", "Check the path")
    if path.is_file():
        raise _no_folder(path)
    found = recognised(path)
    if not found and (videos := videos_in(path)):
        raise _no_scene(path, f"{path} holds the video {videos[0].name}, and no scene")
    if not found:
        for name in formats():
            registry.datamanagers.get(name).refuse_nearly(path)
        raise InputError(
            f"{path} holds {inventory(path)}, which none of the formats {known} recognises",
            "a scene's own folder",
            "docs/data.md lists what each looks like; `data_format=NAME` chooses one and says what it misses. Images "
            "without poses become a scene by coliags poses sfm; beside depth, rgbd reads them with a TUM trajectory",
        )
    if len(found) > 1:
        seen = "; ".join(f"{name}: {reason}" for name, reason in found.items())
        raise InputError(f"{path} may be of several formats ({seen})", "one of them", "Choose with `data_format=NAME`")
    ((name, reason),) = found.items()
    log.info("%s: format %s (%s)", path, name, reason)
    return name


def videos_in(folder: Path) -> list[Path]:
    """The videos of a recording's folder in natural order; none where images are there and no calibration file.

    A WebP beside a video is its preview.
    """
    videos = files_in(folder, _VIDEO_SUFFIXES)
    if files_in(folder, FRAME_SUFFIXES - {".webp"}) and not calibration_files(folder):
        return []
    return [videos[index] for index in natural_order([path.name for path in videos])]


def _no_scene(path: Path, seen: str) -> InputError:
    """What to do about a recording that was given in the place of a scene's folder."""
    quoted = shlex.quote(str(path))
    makes = f"coliags reconstruct {quoted} --output FOLDER reconstructs it; coliags poses sfm {quoted} --output FOLDER"
    return InputError(seen, "a scene's folder", f"{makes} makes a scene with poses")


def _no_folder(path: Path) -> InputError:
    """What to do about a file that was given in the place of a scene's folder."""
    if path.suffix.lower() in _VIDEO_SUFFIXES:
        return _no_scene(path, f"{path} is a video")
    if recognised(path.parent):
        return InputError(f"{path} is a file of a scene", "the scene's folder", f"Give {shlex.quote(str(path.parent))}")
    return InputError(f"{path} is a file", "a scene's folder, as docs/data.md describes", "")


def recognised(path: Path) -> dict[str, str]:
    """Evidence in a folder for each format that recognises it, by the format's name."""
    reasons = {name: registry.datamanagers.get(name).recognise(path) for name in formats()}
    return {name: reason for name, reason in reasons.items() if reason is not None}
