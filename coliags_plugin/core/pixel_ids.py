"""Numbers that identify the pixels of a scene, and fixed random subsets of them."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

#: Multiplier of the position in the sequence, and the two of the mixing, of splitmix64; as signed integers.
_GOLDEN, _MIX = 0x9E3779B97F4A7C15 - 2**64, (0xBF58476D1CE4E5B9 - 2**64, 0x94D049BB133111EB - 2**64)


def pixel_ids(frame: int, pixels: Int[Tensor, "*P"]) -> Int[Tensor, "*P"]:
    """Numbers that no other pixel of the video has, of pixels by row times width plus column, below 2^32."""
    return pixels.to(torch.int64) + (frame << 32)


def fixed_uniform(ids: Int[Tensor, "*P"], seed: int) -> Float[Tensor, "*P"]:
    """A number in [0, 1) for each identifier, the same at every call: splitmix64 of identifier and seed."""
    return (_mixed(ids ^ _mixed(torch.tensor(seed))) >> 11 & (1 << 53) - 1).double() * 2.0**-53


def _mixed(value: Tensor) -> Tensor:
    """The output of splitmix64 in state ``value``; products wrap around."""
    value = value + _GOLDEN
    for shift, factor in zip((30, 27), _MIX, strict=True):
        value = (value ^ _shifted(value, shift)) * factor
    return value ^ _shifted(value, 31)


def _shifted(value: Tensor, bits: int) -> Tensor:
    """Shifted to the right, zeros coming in; torch would repeat the sign."""
    return value >> bits & (1 << 64 - bits) - 1
