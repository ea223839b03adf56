"""Independent random generators per purpose from one seed."""

from __future__ import annotations

import hashlib

import torch

PURPOSES = ("initialisation", "frame_order", "densification", "rendering")


def generators(seed: int) -> dict[str, torch.Generator]:
    """CPU generators by purpose; a purpose's stream depends on the seed and its own name only."""
    found = {}
    for purpose in PURPOSES:
        digest = hashlib.sha256(f"{seed}/{purpose}".encode()).digest()
        found[purpose] = torch.Generator().manual_seed(int.from_bytes(digest[:7], "big"))
    return found
