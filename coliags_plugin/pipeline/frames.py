"""Writes the frames of a video that are of use, without loss, with a record of those that are not."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Annotated

import numpy as np
from jaxtyping import Bool
from pydantic import BaseModel, ConfigDict, Field

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_folder, write_json
from coliags_plugin.core.images import write_image, write_mask
from coliags_plugin.core.jobs import Progress
from coliags_plugin.core.settings import read_validated
from coliags_plugin.datamanagers.reading.images import read_mask
from coliags_plugin.pipeline.frame_selection import (
    RESTING,
    THINNED,
    blurred_frames,
    corner_motion,
    reduced,
    sharpest_frames,
)
from coliags_plugin.pipeline.frame_sources import FrameSource, watched
from coliags_plugin.pipeline.settings import FEWEST, FrameSettings
from coliags_plugin.pipeline.stages import MADE
from coliags_plugin.pipeline.survey import Survey

#: Names within the folder.
IMAGES, MASK, RECORD = "images", "mask.png", "frames.json"
#: Name of a frame's file without its suffix, within its folder.
FrameName = Annotated[str, Field(pattern=r"^[^/\\]+$")]
_KEEP_MORE = ", or keep more frames with `every`, `frames.least_motion=0` or `frames.least_sharpness=0`"


class _Part(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True)


class KeptFrame(_Part):
    """A frame of use."""

    frame: int  # number in the video
    name: FrameName
    blurred: bool  # of use for poses alone
    sharpness: float = 0.0


class DroppedFrame(_Part):
    """A frame that is not used."""

    frame: int
    why: str
    sharpness: float = 0.0


class FramesRecord(_Part):
    """Content of ``frames.json``."""

    kept: list[KeptFrame]
    dropped: list[DroppedFrame]  # but those that were thinned out
    source: str = ""  # name of the video
    frames: int = 0  # that it has
    every: int = 1
    deinterlaced: bool = False
    size: list[int] = []  # width and height, pixels
    masked: float | None = None  # share of the image; None: there is no mask

    @classmethod
    def read(cls, folder: Path) -> FramesRecord | None:
        """Read ``frames.json`` in a folder of frames; None where it is missing, InputError where it is damaged."""
        return read_validated(cls, folder / RECORD, MADE) if (folder / RECORD).is_file() else None


def write_frames(
    source: FrameSource,
    survey: Survey,
    folder: Path,
    settings: FrameSettings,
    mask: Path | None = None,
    progress: Progress | None = None,
) -> str:
    """Choose frames and write them: ``images/NAME.png``, ``frames.json``, and ``mask.png`` where there is a mask.

    By a survey of these frames, whose mask is used unless one is given. Replaces the folder; returns a summary of one
    line.
    """
    used = survey.mask if mask is None else read_mask(mask, colored=True)
    sharpnesses, (height, width), first = survey.sharpness.tolist(), survey.size, source.span.first
    if used is not None and used.shape != survey.size:
        raise InputError(
            f"{mask} is {used.shape[1]} x {used.shape[0]}, the frames {width} x {height}", "a mask of the frames' size"
        )
    chosen, dropped = sharpest_frames(sharpnesses, settings, survey.times)
    blurred, sharpest = blurred_frames(chosen, sharpnesses, settings), set(chosen)
    frames, last = list[KeptFrame](), None
    with atomic_folder(folder, overwrite=True) as scratch:
        for index, (name, image) in enumerate(watched(source, "write frames", progress)):
            if index not in sharpest:
                continue
            gray = reduced(image)
            if last is not None and corner_motion(last, gray, used)[0] < settings.least_motion:
                dropped[index] = RESTING
                continue
            last, is_blurred = gray, index in blurred
            frames.append(KeptFrame(frame=first + index, name=name, blurred=is_blurred, sharpness=sharpnesses[index]))
            write_image(scratch / IMAGES / f"{name}.png", source.with_alpha(name, image))
        reasons = [f"{count} {why}" for why, count in sorted(Counter(dropped.values()).items())]
        if unsharp := sum(frame.blurred for frame in frames):
            reasons.insert(0, f"{unsharp} blurred, of use for poses alone")
        if (count := len(frames) - unsharp) < FEWEST:
            raise InputError(
                f"{count} of {len(survey)} frames of {source.path} are of use: "
                f"{', '.join(reasons) or 'it has no more'}",
                f"at least {FEWEST}",
                f"Give a longer part of the video in which the camera moves{_KEEP_MORE if dropped else ''}",
            )
        if used is not None:
            write_mask(scratch / MASK, used)
        record = FramesRecord(
            kept=frames,
            dropped=[
                DroppedFrame(frame=first + index, why=why, sharpness=sharpnesses[index])
                for index, why in sorted(dropped.items())
                if why != THINNED
            ],
            source=source.path.name,
            frames=len(survey),
            every=settings.every,
            deinterlaced=bool(source.span.deinterlace),
            size=[width, height],
            masked=None if used is None else round(float(1.0 - used.mean()), 4),
        )
        write_json(scratch / RECORD, record.model_dump(mode="json"))
    outside = "" if used is None else f"{100.0 * (1.0 - used.mean()):.0f} % of the image masked"
    size = f"{width} x {height} px{', deinterlaced' if source.span.deinterlace else ''}"
    counts = f"{len(frames)} of {len(survey)} frames, {size}"
    return "; ".join(filter(None, (counts, ", ".join(reasons), outside)))


def read_lens_mask(folder: Path) -> Bool[np.ndarray, "H W"] | None:
    """The mask of written frames; None where there is none."""
    return read_mask(folder / MASK) if (folder / MASK).is_file() else None


def read_blurred(folder: Path) -> set[str]:
    """Names of the written frames that are blurred; none where there is no record."""
    record = FramesRecord.read(folder)
    return set() if record is None else {frame.name for frame in record.kept if frame.blurred}
