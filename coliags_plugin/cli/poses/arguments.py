"""Arguments of the ``poses`` subcommands on trajectories, and reading of these with a log of their conventions."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from coliags_plugin.cli.arguments import parse_size
from coliags_plugin.core.errors import InputError

if TYPE_CHECKING:
    from coliags_plugin.core.intrinsics import Intrinsics
    from coliags_plugin.geometry.poses.formats import Format
    from coliags_plugin.geometry.poses.trajectory import Trajectory

OptionalFormat = Annotated[str | None, tyro.conf.arg(metavar="FORMAT")]


def read_and_log(path: Path, name: str | None) -> tuple[Format, Trajectory]:
    """Read poses and log format, path length and direction, which reveal a wrong convention."""
    import logging

    from coliags_plugin.geometry.poses.formats import format_of

    log = logging.getLogger(__name__)
    kind = format_of(path, name)
    trajectory = kind.read(path)
    log.info("%s: %s (%s); %s", path, kind.name, trajectory.stored_as, trajectory.summary(kind.unit))
    for remark in trajectory.remarks:
        log.info("%s: %s", path, remark)
    return kind, trajectory


def parse_intrinsics(intrinsics: str | None, size: str | None) -> Intrinsics | None:
    """``fx,fy,cx,cy`` and ``WxH`` -> intrinsics; None where neither is given.

    Raises:
        InputError: Only one is given, or one has another form.
    """
    from coliags_plugin.core.intrinsics import Intrinsics
    from coliags_plugin.geometry.poses.text import prefixed_errors

    if intrinsics is None and size is None:
        return None
    if intrinsics is None or size is None:
        given, lacking = ("--size", "--intrinsics") if intrinsics is None else ("--intrinsics", "--size")
        raise InputError(f"{given} without {lacking}", "both, or neither")
    try:
        fx, fy, cx, cy = (float(part) for part in intrinsics.split(","))
    except ValueError as error:
        raise InputError(f"--intrinsics {intrinsics}", "four numbers fx,fy,cx,cy in pixels") from error
    with prefixed_errors("--intrinsics, --size"):
        return Intrinsics(fx, fy, cx, cy, *parse_size(size))
