"""Files of a scene, for readers and writers: images, ``unit.txt``, ``camera.json``, and reading many at once."""

from __future__ import annotations

import errno
import logging
import os
import posixpath
import re
import unicodedata
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Any, Literal, TypeVar, cast, get_args

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_write, write_json
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.core.jobs import Progress, with_progress
from coliags_plugin.core.json_files import image_size, read_json, read_number
from coliags_plugin.core.text_files import read_text, shortened

log = logging.getLogger(__name__)

IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg"})
TIFF_SUFFIXES = frozenset({".tiff", ".tif"})
#: Of files that may be the frames of a video, or masks of them.
FRAME_SUFFIXES = IMAGE_SUFFIXES | TIFF_SUFFIXES | {".bmp", ".webp"}
#: Of masks; the first counts where there are several.
MASK_SUFFIXES = (".png", *sorted(FRAME_SUFFIXES - {".png"}))
#: Folders of masks that lie beside the images.
MASK_FOLDERS = ("mask", "masks")
DEPTH_SUFFIXES = TIFF_SUFFIXES | {".png"}
ARRAY_SUFFIXES = frozenset({".npy"})


def files_in(folder: Path, suffixes: Collection[str]) -> list[Path]:
    """Files of a folder with one of some suffixes in either case, by name; no hidden ones, as macOS's ``._1.png``."""
    files = (path for path in folder.iterdir() if path.suffix.lower() in suffixes and not path.name.startswith("."))
    return sorted(path for path in files if path.is_file())


def one_folder(scene: Path, names: Sequence[str]) -> Path | None:
    """The only folder of one of some names; None without any."""
    folders = [scene / name for name in names if (scene / name).is_dir()]
    if len(folders) > 1:
        listed = " and ".join(f"{path.name}/" for path in folders)
        raise InputError(f"{scene} holds {listed}", "only one of them", "Move the other away")
    return folders[0] if folders else None


def sidecar_files(folder: Path, names: Sequence[str], suffixes: Sequence[str]) -> dict[str, Path | None]:
    """Files of images by name, as masks: ``a.jpg.png``, as COLMAP names them, or ``a.png``; None where missing.

    The first of ``suffixes`` counts where there are several.
    """

    @cache
    def held(parent: Path) -> dict[str, Path]:
        if not parent.is_dir():
            return {}
        return {path.stem: path for suffix in reversed(suffixes) for path in files_in(parent, (suffix,))}

    files: dict[str, Path | None] = {}
    for name in names:
        places = [folder / name, folder / name.replace("\\", "/")]  # the second: a name of Windows
        candidates = [held(p.parent).get(p.name) or held(p.parent).get(p.stem) for p in places]
        files[name] = candidates[0] or candidates[1]
    return files


def require_folder(folder: Path, expected: str) -> None:
    """Raise InputError if a folder is missing."""
    if not folder.is_dir():
        raise InputError(f"no folder {folder}", expected, "Check the path")


def required_file(path: Path, expected: str, do: str = "Restore it, or check the path") -> Path:
    """The path of a file; InputError if it is missing."""
    if not path.is_file():
        raise InputError(f"no file {path}", expected, do)
    return path


def for_every(files: Mapping[str, Path | None], where: object, what: str, or_none: str = "") -> list[Path]:
    """Files by the name of their frame, of which there must be one for every frame.

    ``where`` they are missing and ``what`` they are is for the error.
    """
    missing = [name for name, path in files.items() if path is None]
    if missing:
        raise InputError(
            f"{where}: {len(files) - len(missing)} of {len(files)} frames have {what}; {missing[0]} has none",
            f"{what} for every frame{or_none}",
            "Restore the missing ones: incomplete archives are common",
        )
    return [path for path in files.values() if path is not None]


def for_all(files: Mapping[str, Path | None], where: object, what: str) -> Sequence[Path | None]:
    """Files by the name of their frame, as by :func:`for_every`, or None for every frame."""
    return for_every(files, where, what, ", or none at all") if any(files.values()) else list(files.values())


def same_frames(folder: Path, images: Collection[Any], depths: Collection[Any], do: str) -> None:
    """Raise InputError unless there is depth for every image or for none, by the numbers in their names."""
    if depths and (lone := set(depths) ^ set(images)):
        counts = f"{len(images)} images and {len(depths)} depth files"
        raise InputError(
            f"{folder} has {counts}; frame {min(lone)} has only one of the two",
            "a depth file for every image, or none at all",
            do,
        )


def numbered(folder: Path, what: str, suffixes: frozenset[str]) -> dict[int, Path]:
    """Files ``<number>_<what>`` by number, padded or not, or ``<number>`` if ``what`` is empty; none without folder."""
    files: dict[int, Path] = {}
    pattern = rf"(\d+)_{what}" if what else r"(\d+)"
    there = sorted(folder.iterdir()) if folder.is_dir() else ()
    matches = [(path, match) for path in there if (match := re.fullmatch(pattern, path.stem))]
    for path, match in matches:
        if path.suffix.lower() not in suffixes:
            continue
        index = int(match.group(1))
        if index in files:
            raise InputError(f"{files[index]} and {path.name} have the same number", "one file per frame", "Remove one")
        files[index] = path
    if not files:
        warn_of_other_kinds([path for path, _ in matches], suffixes)
    return files


def warn_of_other_kinds(files: Sequence[Path], suffixes: Iterable[str]) -> None:
    """Log a warning that names files which are not read, if any, as they have none of the suffixes."""
    if files:
        kinds = ", ".join(sorted(suffixes))
        names = first_few([path.name for path in files])
        log.warning("%s: %s are not read, only files of the kinds %s", files[0].parent, names, kinds)


def numbered_images(folder: Path, what: str, expected: str, example: str) -> dict[int, Path]:
    """PNG images by number, at least one; see :func:`numbered`. Errors name the layout and an example of a folder."""
    images = numbered(folder, what, frozenset({".png"}))
    if not images:
        searched = folder if folder.is_dir() else folder.parent
        require_folder(searched, expected)
        do = f"Name the sequence's own folder, for instance {example}"
        raise InputError(f"{searched} holds {inventory(searched)}", expected, do)
    return images


def paired(
    folder: Path, images: Mapping[int, Path], depths: Mapping[int, Path]
) -> tuple[tuple[Path, ...], tuple[Path, ...] | None]:
    """Image files and, if any, depth files in frame order.

    Numbers must run from 0 without gaps, and there must be depth for every image or for none.
    """
    count = len(images)
    gap = next((index for index in range(count) if index not in images), None)
    if gap is not None:
        first, last = min(images), max(images)
        raise InputError(
            f"{images[first].parent} has {count} images, numbers {first} to {last}, but none is {gap}",
            "numbers from 0 without gaps, as line n of the pose file belongs to image n",
            "Restore the missing images, or renumber them and drop their poses",
        )
    same_frames(folder, images, depths, "Restore the missing files: incomplete archives are common")
    frames = range(count)
    return tuple(images[index] for index in frames), tuple(depths[index] for index in frames) if depths else None


def inventory(folder: Path) -> str:
    """The first few names in a folder, for error messages."""
    names = sorted(path.name + "/" * path.is_dir() for path in folder.iterdir())
    if not names:
        return "nothing"
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")


def named_file(folder: Path, name: str, source: str, outside: bool) -> Path:
    """The path of a file that another one, ``source`` in messages, names relative to ``folder``; it need not exist.

    ``outside`` tells whether it may lie outside of the folder. Links within the folder may always lead anywhere.
    """
    path = folder / name
    if not os.path.lexists(path):  # a name of Windows, or of macOS, which splits letters from their marks
        spelled = [name.replace("\\", "/"), *(unicodedata.normalize(form, name) for form in ("NFC", "NFD"))]
        path = folder / next((other for other in spelled if os.path.lexists(folder / other)), spelled[0])
    within = Path(posixpath.normpath(folder.absolute()))
    if not outside and not Path(posixpath.normpath(path.absolute())).is_relative_to(within):
        raise InputError(
            f"{source} names {name[:200]}, which is outside of {folder}",
            "files in the scene's own folder",
            "If you trust it: `datamanager.outside_files=true`",
        )
    try:
        path.lstat()
    except ValueError as error:  # it has a zero
        raise InputError(f"{source} names {name[:200]!r}", "the name of a file") from error
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            raise InputError(f"{source} names {name[:200]}..., {len(name):,} letters", "the name of a file") from error
    return path


def short_names(paths: Sequence[str]) -> list[str]:
    """Unique names of images given by relative paths, usable as file names.

    Common parent folders are removed and the remaining ones joined by a dash; suffixes are dropped if names stay
    unique.
    """
    whole = [PurePosixPath(posixpath.normpath(path.replace("\\", "/"))) for path in paths]
    common = len(PurePosixPath(os.path.commonpath([path.parent for path in whole])).parts)
    inner = [PurePosixPath(*path.parts[common:]) for path in whole]
    for short in ([str(path.with_suffix("")) for path in inner], [str(path) for path in inner]):
        names = [name.replace("/", "-") for name in short]
        if len(set(names)) == len(names):
            return names
    double = next(name for index, name in enumerate(names) if name in names[:index])
    raise InputError(f"two images would be called '{double}'", "names that differ in more than / and -", "Rename one")


def unposed_images(used: Sequence[Path], excluded: Iterable[Path | None] = ()) -> list[Path]:
    """Images without a pose in the folders of those with one, except other files there (depth, masks)."""
    excluded_paths = {*used, *excluded}
    suffixes = {path.suffix.lower() for path in used}
    return [
        path
        for folder in dict.fromkeys(path.parent for path in used)
        for path in files_in(folder, suffixes)
        if path not in excluded_paths
    ]


def warn_of_unposed(file: Path, others: Sequence[Path]) -> None:
    """Log a warning that names the images without a pose in ``file``, if any."""
    if others:
        named = first_few([path.name for path in others])
        log.warning("%s: %d images have no pose and are left out: %s", file, len(others), named)


def first_few(names: Sequence[str]) -> str:
    """The first three names, for messages."""
    return ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")


Unit = Literal["mm", "cm", "m", "unknown"]

#: Factors to the lengths of a loaded scene: mm, or the files' own where their unit is unknown.
FACTORS: dict[Unit, float] = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "unknown": 1.0}
#: The file that states the unit, in the scene's folder; without it the unit is that of the dataset's format.
UNIT_FILE = "unit.txt"


def read_unit(folder: Path, otherwise: Unit = "unknown") -> Unit:
    """Unit of the poses and depth of the scene in a folder; ``otherwise`` where the folder states none."""
    path = folder / UNIT_FILE
    if not path.is_file():
        return otherwise
    word = read_text(path, "the unit of length").strip()
    if word not in get_args(Unit):
        raise InputError(f"{path}: '{shortened(word)}'", " or ".join(get_args(Unit)), "Correct or remove the file")
    return cast(Unit, word)


def printed_unit(unit: Unit) -> str:
    """A unit as it is printed: ``units`` where it is unknown."""
    return "units" if unit == "unknown" else unit


def write_unit(folder: Path, unit: Unit) -> None:
    """State the unit of a scene's poses and depth."""
    atomic_write(folder / UNIT_FILE, unit + "\n")


def read_intrinsics(path: Path) -> Intrinsics:
    """The intrinsics of a ``camera.json``."""
    data = read_json(path, "a JSON object")
    data = data if isinstance(data, dict) else {}
    fx, fy = (read_number(data, key, path, "a number above 0", above=0.0) for key in ("fx", "fy"))
    cx, cy = (read_number(data, key, path) for key in ("cx", "cy"))
    return Intrinsics(fx, fy, cx + 0.5, cy + 0.5, *image_size(data, path))


def write_camera_json(path: Path, intrinsics: Intrinsics, **more: float) -> None:
    """Write a ``camera.json``; ``more`` are ``w`` and ``h``, pixels, and other values of a format, in this order."""
    k = intrinsics
    write_json(path, {"fx": k.fx, "fy": k.fy, "cx": k.cx - 0.5, "cy": k.cy - 0.5, **more})


_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

#: Largest number of threads: more would wait for the disk.
_READERS = 8


def parallel_map(
    function: Callable[[_Item], _Result],
    items: Sequence[_Item],
    what: str,
    progress: Progress | None = None,
    threads: int | None = None,
) -> list[_Result]:
    """Apply a function to every item in a thread pool and return the results in order; they are all held in memory.

    ``what`` names the task for ``progress``. ``threads`` is by default what reads files fastest. The exception of the
    first item that fails is raised, and the remaining items are cancelled.
    """
    with ThreadPoolExecutor(threads or min(_READERS, os.cpu_count() or 1)) as pool:
        pending = [pool.submit(function, item) for item in items]
        try:
            return [future.result() for future in with_progress(pending, what, progress)]
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
