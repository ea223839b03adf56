"""One generator per purpose, all from one seed, so that no purpose disturbs another."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field

import torch

PURPOSES = ("initialisation", "frame_order", "densification")


def generators(seed: int) -> dict[str, torch.Generator]:
    """CPU generators by purpose; a purpose's stream depends on the seed and its own name only."""
    found = {}
    for purpose in PURPOSES:
        digest = hashlib.sha256(f"{seed}/{purpose}".encode()).digest()
        found[purpose] = torch.Generator().manual_seed(int.from_bytes(digest[:7], "big"))
    return found


@dataclass
class FrameOrder:
    """Training frames in random order, each once per round (docs/methods.md 4).

    Attributes:
        count: How many frames there are.
        generator: Shuffles each round.
        queue: What is left of this round; the last is next.
    """

    count: int
    generator: torch.Generator
    queue: list[int] = field(default_factory=list)

    def next(self) -> int:
        """The index of the next frame."""
        if not self.queue:
            self.queue = torch.randperm(self.count, generator=self.generator).tolist()
        return self.queue.pop()
