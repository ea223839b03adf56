"""Time and disk that a reconstruction is going to take, told before it starts."""

from __future__ import annotations

from dataclasses import dataclass

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


def forecast(source: FrameSource, settings: ReconstructionSettings) -> Forecast:
    """The forecast of a video by the number and size of its frames."""
    frames, steps = -(-source.expected // settings.frames.every), settings.steps
    height, width = next(iter(source))[1].shape[:2]
    pixels = int(height * width)
    posed, submaps = _POSED * frames, max(1.0, frames / _SUBMAP_FRAMES)
    share = min(pixels, _MOST_PIXELS) / _TRAINED_PIXELS
    seconds = _POSES * frames + share * posed * (_FRAME + _STEP * _STEPS * steps / 2000) + _SUBMAP * submaps
    return Forecast(frames, seconds, frames * (_PIXEL * pixels + _DEPTH) + submaps * _SUBMAP_BYTES)
