"""Argument types and parsers shared by several commands."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from coliags_plugin.core.errors import InputError

#: ``--set key=value``, repeatable.
Assignments = Annotated[tuple[str, ...], tyro.conf.arg(name="set", metavar="KEY=VALUE"), tyro.conf.UseAppendAction]

#: ``--light key=value``, repeatable.
LampOptions = Annotated[tuple[str, ...], tyro.conf.arg(name="light", metavar="KEY=VALUE"), tyro.conf.UseAppendAction]
#: ``--channel NAME``, repeatable.
Channels = Annotated[tuple[str, ...], tyro.conf.arg(name="channel", metavar="NAME"), tyro.conf.UseAppendAction]

OptionalPath = Annotated[Path | None, tyro.conf.arg(metavar="PATH")]
OptionalText = Annotated[str | None, tyro.conf.arg(metavar="TEXT")]
#: Name of a data manager; None: recognised from the files.
DataFormat = Annotated[str | None, tyro.conf.arg(name="format", metavar="NAME")]
OptionalInt = Annotated[int | None, tyro.conf.arg(metavar="INT")]


def parse_size(text: str) -> tuple[int, int]:
    """``WxH`` -> (width, height), pixels.

    Raises:
        InputError: The text has another form.
    """
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise InputError(f"--size {text}", "WIDTHxHEIGHT in pixels, for instance 338x270")
    return int(width), int(height)


def parse_vector(option: str, text: str) -> tuple[float, float, float]:
    """``X,Y,Z`` -> three numbers.

    Raises:
        InputError: The text has another form.
    """
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError as error:
        raise InputError(f"{option} {text}", "three numbers X,Y,Z") from error
    return x, y, z
