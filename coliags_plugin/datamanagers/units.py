"""Unit of length of a scene's files: as stated, or unknown where poses came from images alone."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, cast, get_args

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_write
from coliags_plugin.core.text_files import read_text
from coliags_plugin.geometry.poses.formats import shortened

Unit = Literal["mm", "cm", "m", "unknown"]

#: Factors to the lengths of a loaded scene: mm, or the files' own where their unit is unknown.
FACTORS: dict[Unit, float] = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "unknown": 1.0}
#: The file that states the unit, in the scene's folder; without it the unit is that of the dataset's format.
UNIT_FILE = "unit.txt"


def read_unit(folder: Path, otherwise: Unit = "unknown") -> Unit:
    """The unit of the poses and depth of the scene in a folder; ``otherwise``: that of a folder that states none."""
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
