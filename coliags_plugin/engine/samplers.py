"""Random generators of a run, and samplers of training steps: whole frames, or batches of pixels."""

from __future__ import annotations

import hashlib
from typing import ClassVar

import torch
from pydantic import Field

from coliags_plugin.contracts import Draw, Sampler
from coliags_plugin.core.settings import Settings

PURPOSES = ("initialisation", "frame_order", "densification", "rendering")


def generators(seed: int) -> dict[str, torch.Generator]:
    """CPU generators by purpose; a purpose's stream depends on the seed and its own name only."""
    streams = {}
    for purpose in PURPOSES:
        digest = hashlib.sha256(f"{seed}/{purpose}".encode()).digest()
        streams[purpose] = torch.Generator().manual_seed(int.from_bytes(digest[:7], "big"))
    return streams


class FrameSampler(Sampler):
    """One whole frame per step, each once per round in random order (docs/methods.md 4)."""

    whole_images: ClassVar[bool] = True

    def next(self) -> list[Draw]:
        """Draw the next frame."""
        return [Draw(_next_frame(self))]


class PixelSamplerSettings(Settings):
    """Options of pixel batches."""

    pixels: int = Field(default=1024, ge=1)  # number in a batch, of all its frames together
    frames: int = Field(default=4, ge=1)  # that they are taken from, as evenly as can be


class PixelSampler(Sampler[PixelSamplerSettings]):
    """Random pixels of a few frames per step, each frame once per round in random order."""

    whole_images: ClassVar[bool] = False

    settings: PixelSamplerSettings

    def next(self) -> list[Draw]:
        """Draw pixels of the next frames."""
        frames = min(self.settings.frames, self.settings.pixels)
        draws = []
        for turn in range(frames):
            frame = _next_frame(self)
            width, height = self.sizes[frame]
            count = self.settings.pixels * (turn + 1) // frames - self.settings.pixels * turn // frames
            index = torch.randint(width * height, (count,), generator=self.generator)
            draws.append(Draw(frame, torch.stack([index % width, index // width], dim=1)))
        return draws


def _next_frame(sampler: Sampler) -> int:
    """Next frame of a shuffled round."""
    if not sampler.queue:
        sampler.queue = torch.randperm(len(sampler.sizes), generator=sampler.generator).tolist()
    return sampler.queue.pop()
