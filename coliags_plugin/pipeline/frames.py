"""Chooses the frames of a video that are of use and writes them without loss, with a record of the others."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float64
from pydantic import BaseModel, ConfigDict, Field

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_folder, write_json
from coliags_plugin.core.images import write_image, write_mask
from coliags_plugin.core.jobs import Progress, with_progress
from coliags_plugin.core.settings import read_validated
from coliags_plugin.datamanagers.file_formats import read_mask
from coliags_plugin.pipeline.frame_sources import FrameSource
from coliags_plugin.pipeline.settings import FEWEST, FrameSettings
from coliags_plugin.pipeline.stages import MADE
from coliags_plugin.pipeline.survey import Survey, corner_motion, reduced

#: Names within the folder.
IMAGES, MASK, RECORD = "images", "mask.png", "frames.json"
#: Why frames are dropped, as the record says it.
THINNED, EMPTY, RESTING = "thinned out", "black or without any texture", "the camera rests"
#: Neighbours to either side, of the frames left by thinning, that a frame's sharpness is compared with.
_NEIGHBOURS = 10
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


class DroppedFrame(_Part):
    """A frame that is not used."""

    frame: int
    why: str


class FramesRecord(_Part):
    """Content of ``frames.json``."""

    kept: list[KeptFrame]
    dropped: list[DroppedFrame]  # but those that were thinned out

    @classmethod
    def read(cls, folder: Path) -> FramesRecord | None:
        """Read ``frames.json`` in a folder of frames; None where it is missing, InputError where it is damaged."""
        return read_validated(cls, folder / RECORD, MADE) if (folder / RECORD).is_file() else None


def sharpest_frames(
    sharpness: Sequence[float], settings: FrameSettings, times: Float64[np.ndarray, "N"] | None = None
) -> tuple[list[int], dict[int, str]]:
    """Frames to use by the sharpness of every frame: ascending indices, and why each of the others is dropped.

    ``times``, s, count for ``settings.per_second``.
    """
    values, part = np.asarray(sharpness), np.arange(len(sharpness)) // settings.every
    if settings.per_second is not None and times is not None:
        part = np.floor(times * settings.per_second + 1e-6).astype(int)
    bounds = [*np.flatnonzero(np.diff(part, prepend=-1)).tolist(), len(values)]
    best = [first + int(np.argmax(values[first:stop])) for first, stop in pairwise(bounds)]
    dropped = dict.fromkeys(set(range(len(values))) - set(best), THINNED)
    some = [index for index in best if values[index] > 0.0]
    return some, dropped | dict.fromkeys(set(best) - set(some), EMPTY)


def blurred_frames(chosen: Sequence[int], sharpness: Sequence[float], settings: FrameSettings) -> set[int]:
    """Frames among the chosen ones, ascending, that are much less sharp than those around them."""
    values = np.asarray(sharpness)
    return {
        index
        for place, index in enumerate(chosen)
        if values[index]
        < settings.least_sharpness * np.median(values[chosen[max(0, place - _NEIGHBOURS) : place + _NEIGHBOURS + 1]])
    }


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
        for index, (name, image) in enumerate(with_progress(source, "write frames", progress, source.expected)):
            if index not in sharpest:
                continue
            gray = reduced(image)
            if last is not None and corner_motion(last, gray, used)[0] < settings.least_motion:
                dropped[index] = RESTING
                continue
            last = gray
            frames.append(KeptFrame(frame=first + index, name=name, blurred=index in blurred))
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
        left_out = [(first + index, why) for index, why in sorted(dropped.items()) if why != THINNED]
        record = FramesRecord(kept=frames, dropped=[DroppedFrame(frame=frame, why=why) for frame, why in left_out])
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
