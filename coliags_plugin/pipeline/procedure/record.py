"""The record of a procedure: its video, segments, what was left out, and joins (``procedure.json``)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import write_json
from coliags_plugin.core.json_files import json_text, parse_json
from coliags_plugin.pipeline.procedure.segments import Skipped, Stretch

#: Name of the file, and version of its schema.
PROCEDURE_FILE, _FORMAT = "procedure.json", 1


@dataclass(frozen=True)
class Procedure:
    """A video and its segments; what the other numbers count is the video's frames."""

    source: str  # name of the file or folder
    bytes: int  # its size, to notice that it is another one
    rate: float | None  # frames a second
    frames: int
    size: tuple[int, int]  # height and width, pixels
    first: int  # frame at which the survey began
    options: dict[str, Any]  # of cutting
    seek: bool  # whether frames are found by their number
    segments: Sequence[Stretch]
    skipped: Sequence[Skipped]
    joins: Sequence[dict[str, Any]] = ()

    @staticmethod
    def name(number: int) -> str:
        """Folder of a segment."""
        return f"segment-{number:03d}"

    def write(self, folder: Path) -> None:
        """Write ``procedure.json``."""
        segments = [{"name": self.name(number), **asdict(each)} for number, each in enumerate(self.segments)]
        content = {
            "format": _FORMAT,
            "source": [self.source],
            "bytes": self.bytes,
            "frames": self.frames,
            "rate": self.rate,
            "size": [self.size[1], self.size[0]],
            "first": self.first,
            "options": self.options,
            "seek": self.seek,
            "segments": segments,
            "skipped": [asdict(each) for each in self.skipped],
            "joins": list(self.joins),
        }
        write_json(folder / PROCEDURE_FILE, content)

    @classmethod
    def read(cls, folder: Path) -> Procedure | None:
        """Read ``procedure.json``; None without one."""
        file = folder / PROCEDURE_FILE
        if not file.is_file():
            return None
        try:
            content = parse_json(json_text(file))
            width, height = content["size"]
            return cls(
                content["source"][0], content["bytes"], content["rate"], content["frames"], (height, width),
                content["first"], content["options"], content["seek"],
                [Stretch(each["first"], each["last"]) for each in content["segments"]],
                [Skipped(**each) for each in content["skipped"]], content["joins"],
            )  # fmt: skip
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(
                f"cannot read {file}: {error}", "what `coliags reconstruct` wrote", "Choose another --output"
            ) from error
