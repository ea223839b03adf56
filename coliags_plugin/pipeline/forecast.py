"""Time and disk that a reconstruction is going to take, before it starts; and settings that keep to a budget."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

from coliags_plugin.core.errors import InputError
from coliags_plugin.pipeline.frame_sources import FrameSource
from coliags_plugin.pipeline.settings import ReconstructionSettings
from coliags_plugin.reporting.numbers import duration, file_size

#: Seconds of a CPU core, of a patient's clip on an AMD EPYC (docs/reconstruct.md 5): poses of a frame; depth and
#: evaluation of a frame with a pose; a training step; and what every sub-map takes besides. Depth and training are of
#: so many pixels there, and of so many at most.
_POSES, _FRAME, _STEP, _SUBMAP = 1.1, 1.7, 0.24, 75.0
_TRAINED_PIXELS, _MOST_PIXELS = 270 * 270, 338 * 270
#: Share of the frames that get a pose, and frames of a sub-map, in that clip; training steps of a frame, of 2000.
_POSED, _SUBMAP_FRAMES, _STEPS = 0.92, 45, 23
#: Bytes: of a pixel of a frame; of a frame's depth; and of a sub-map.
_PIXEL, _DEPTH, _SUBMAP_BYTES = 1.0, 0.45e6, 75e6
#: Least share of the training steps that a budget leaves, and most frames of which one is used.
_SHARES, _MOST_EVERY = (1.0, 0.5, 0.25), 12


@dataclass(frozen=True)
class Forecast:
    """What a reconstruction takes, roughly: half to twice as much."""

    frames: int  # of use, at most
    seconds: float  # of one CPU core
    size: float  # of the results, bytes

    def __str__(self) -> str:
        return (
            f"{self.frames} frames of use: about {duration(self.seconds)} of a CPU core and {file_size(self.size)} of "
            "disk, by a patient's clip"
        )

    def check_disk(self, folder: Path) -> None:
        """Refuse what will not fit on the disk.

        Raises:
            InputError: Less is free than half of what is expected.
        """
        there = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.is_dir())
        free = shutil.disk_usage(there).free
        if free < 0.5 * self.size:
            raise InputError(
                f"{file_size(free)} are free for {folder}, and about {file_size(self.size)} needed",
                "as much as that",
                "Use fewer frames (--every), a part of the video (--from, --to), or another disk",
            )


def forecast(source: FrameSource, settings: ReconstructionSettings) -> Forecast:
    """The forecast of a video by the number and size of its frames."""
    return _forecast(-(-source.expected // settings.frames.every), settings.steps, _pixels(source))


def _pixels(source: FrameSource) -> int:
    height, width = next(iter(source))[1].shape[:2]
    return int(height * width)


def _forecast(frames: int, steps: int, pixels: int) -> Forecast:
    posed, submaps = _POSED * frames, max(1.0, frames / _SUBMAP_FRAMES)
    share = min(pixels, _MOST_PIXELS) / _TRAINED_PIXELS
    seconds = _POSES * frames + share * posed * (_FRAME + _STEP * _STEPS * steps / 2000) + _SUBMAP * submaps
    return Forecast(frames, seconds, frames * (_PIXEL * pixels + _DEPTH) + submaps * _SUBMAP_BYTES)


def within_budget(
    source: FrameSource, settings: ReconstructionSettings, seconds: float, cores: float
) -> ReconstructionSettings:
    """Settings of which a reconstruction is expected to take no longer: first fewer training steps, then fewer frames.

    Args:
        source: The video.
        settings: Those that are wanted; nothing is increased.
        seconds: Budget, wall-clock.
        cores: CPU cores that work at a time.

    Raises:
        InputError: It takes longer with a quarter of the steps and one of twelve frames.
    """
    pixels = _pixels(source)
    for every in range(settings.frames.every, max(settings.frames.every, _MOST_EVERY) + 1):
        for share in _SHARES:
            steps = max(1, round(share * settings.steps))
            expected = _forecast(-(-source.expected // every), steps, pixels)
            if expected.seconds <= seconds * cores:
                frames = settings.frames.model_copy(update={"every": every})
                return settings.model_copy(update={"steps": steps, "frames": frames})
    raise InputError(
        f"a budget of {duration(seconds)}, and about {duration(expected.seconds / cores)} for the least: "
        f"{expected.frames} frames and {steps} steps of a hundred",
        "more time",
        "Give a larger --budget, a part of the video (--from, --to), or more processes (--jobs)",
    )


def seconds_of(text: str) -> float:
    """Seconds of a time such as ``45s``, ``30min`` or ``2.5h``.

    Raises:
        InputError: It is none.
    """
    for unit, seconds in (("min", 60.0), ("h", 3600.0), ("s", 1.0)):
        number = text.strip().removesuffix(unit)
        if number != text.strip():
            try:
                if (value := float(number)) > 0.0:
                    return value * seconds
            except ValueError:
                break
    raise InputError(f"the time '{text}'", "a number with its unit, for instance 45s, 30min or 2.5h")
