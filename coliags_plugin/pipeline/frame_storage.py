"""Removes the frames of a reconstruction that its video has, and decodes them again."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from pydantic import BaseModel, ConfigDict, model_validator
from typing_extensions import Self

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import link_or_copy, make_folder, write_json
from coliags_plugin.core.images import read_rgb, write_image
from coliags_plugin.core.locks import locked
from coliags_plugin.core.progress import Progress
from coliags_plugin.core.settings import read_validated
from coliags_plugin.pipeline.frame_sources import Span, frame_source
from coliags_plugin.pipeline.frames import IMAGES, MADE, RECORD, REMOVED, FrameName, FramesRecord
from coliags_plugin.pipeline.procedure.record import Procedure
from coliags_plugin.pipeline.stages import LOCK_FILE


class _Removed(BaseModel):
    """Checksums (CRC-32) of the pixels of removed frames by name, and those of them that a scene with poses had."""

    model_config = ConfigDict(extra="forbid")

    checksums: dict[FrameName, int]
    posed: list[FrameName]

    @model_validator(mode="after")
    def _posed_are_listed(self) -> Self:
        if others := set(self.posed) - self.checksums.keys():
            raise ValueError(f"{min(others)} is posed, and has no checksum")
        return self


@dataclass(frozen=True)
class _Part:
    """Frames of a reconstruction, or of one segment of a procedure."""

    folder: Path
    seek: bool

    @property
    def images(self) -> Path:
        """Folder of the frames of use."""
        return self.folder / "frames" / IMAGES

    @property
    def posed(self) -> Path:
        """Folder of those with a pose."""
        return self.folder / "poses" / IMAGES

    @property
    def removed(self) -> Path:
        """File that lists the removed frames with their checksums."""
        return self.folder / "frames" / REMOVED

    def decoded(self, video: Path) -> Iterator[tuple[str, UInt8[np.ndarray, "H W 3"]]]:
        """Names and pixels of the frames, as the video has them."""
        record = FramesRecord.read(self.folder / "frames")
        if record is None or not record.kept:
            return
        names = {one.frame: one.name for one in record.kept}
        first = min(names)
        source = frame_source(video, Span(first, max(names), self.seek, record.deinterlaced))
        for number, (_, image) in enumerate(source, start=first):
            if number in names:
                yield names[number], image


def remove_frames(out: Path, video: Path, progress: Progress | None = None) -> int:
    """Remove the frames of a reconstruction or procedure, and its posed images; returns how many bytes this frees.

    Before, each is compared with the video; of a reconstruction, or of a segment, all are removed or none. What was
    made of them stays: poses, depth, runs, meshes and pages do without.

    Raises:
        InputError: ``out`` has no frames, or is the video's own place; or a frame of the video is missing or another,
            which is named.
    """
    if out.resolve() in (video.resolve(), *video.resolve().parents):
        raise InputError(f"{video} is within {out}", "the video, apart from what was made of it")
    freed = 0
    with _parts(out) as parts:
        for done, part in enumerate(parts, start=1):
            if not part.removed.is_file():
                _list_removed(part, video)
            removed = read_validated(_Removed, part.removed, MADE)
            files = [part.images / f"{name}.png" for name in removed.checksums]
            sizes = [file.stat().st_size for file in files if file.is_file()]
            for file in (*(part.posed / f"{name}.png" for name in removed.posed), *files):
                file.unlink(missing_ok=True)
            freed += sum(sizes)
            if progress is not None:
                progress("remove frames", done, len(parts))
    return freed


def restore_frames(out: Path, video: Path, progress: Progress | None = None) -> int:
    """Decode removed frames again, equal in every pixel; returns how many.

    Raises:
        InputError: ``out`` has no frames; or the video no longer has one of them.
    """
    count = 0
    with _parts(out) as parts:
        for done, part in enumerate(parts, start=1):
            if part.removed.is_file():
                count += _restore(part, video)
            if progress is not None:
                progress("restore frames", done, len(parts))
    return count


@contextmanager
def _parts(out: Path) -> Iterator[list[_Part]]:
    """Lock a reconstruction or procedure, and give those of its segments that have frames."""
    procedure = Procedure.read(out)
    folders = [out] if procedure is None else [out / segment.name for segment in procedure.segments]
    parts = [_Part(folder, procedure is None or procedure.seek) for folder in folders]
    parts = [part for part in parts if (part.folder / "frames" / RECORD).is_file()]
    if not parts:
        raise InputError(f"{out} has no frames of a video", "the folder that `coliags reconstruct` made of one")
    with locked(out / LOCK_FILE, out):
        yield parts


def _list_removed(part: _Part, video: Path) -> None:
    """Write which frames are to be removed, once the video was seen to have them all."""
    checksums: dict[str, int] = {}
    for name, image in part.decoded(video):
        file = part.images / f"{name}.png"
        if not np.array_equal(read_rgb(file), image):
            raise InputError(f"{video} has another frame than {file}", "the video it was decoded from", "All are kept")
        checksums[name] = _checksum(image)
    stored = {path.stem for path in part.images.iterdir()}
    if missing := sorted(stored - checksums.keys()):
        raise InputError(
            f"{video} does not have {len(missing)} frames of {part.images}: {missing[0]}", do="All are kept"
        )
    posed = [name for name in checksums if (part.posed / f"{name}.png").is_file()]
    write_json(part.removed, _Removed(checksums=checksums, posed=posed).model_dump())


def _restore(part: _Part, video: Path) -> int:
    removed = read_validated(_Removed, part.removed, MADE)
    for name, image in part.decoded(video):
        if _checksum(image) != removed.checksums.get(name):
            raise InputError(f"{video} has another frame {name} than was removed", "the video it was decoded from")
        write_image(part.images / f"{name}.png", image)
    if missing := [name for name in removed.checksums if not (part.images / f"{name}.png").is_file()]:
        raise InputError(f"{video} does not have {len(missing)} removed frames: {missing[0]}", "a whole video")
    make_folder(part.posed)
    for name in removed.posed:
        (part.posed / f"{name}.png").unlink(missing_ok=True)
        link_or_copy(part.images / f"{name}.png", part.posed / f"{name}.png")
    part.removed.unlink()
    return len(removed.checksums)


def _checksum(image: UInt8[np.ndarray, "H W 3"]) -> int:
    return zlib.crc32(image.tobytes())
