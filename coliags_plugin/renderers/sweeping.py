"""Front-to-back sweep over the pairs of a tile and a Gaussian, in chunks, with the rules of compositing.

What a Gaussian is, and so its alpha at a pixel, is the caller's. The rules are in ``docs/rendering.md``, section
"Compositing".
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from coliags_plugin.renderers.splatting import CutSettings

#: Elements of the largest temporary tensors, by device type: to fit the L2 caches, or to fill the device.
CHUNK_ELEMENTS = {"cpu": 2**18, "cuda": 2**24}
#: Finite stand-in for log(0), far below every alpha_min.
_LOG_ZERO = -1e4
#: Fewest and most pairs of one tile composited at a time.
_MIN_RANKS, _MAX_RANKS = 32, 128

Evaluated = TypeVar("Evaluated")


@dataclass(frozen=True)
class Chunk(Generic[Evaluated]):
    """C consecutive pairs of each of G tiles, at all P pixels."""

    tiles: Int[Tensor, "G"]  # which tiles, no two the same
    rows: Int[Tensor, "GC"]  # index of each pair in the list of pairs; M, one past its end, where a tile has fewer
    before: Float[Tensor, "G P"]  # transmittance in front of the chunk; 0 where compositing has stopped
    transmittances: Float[Tensor, "G C P"]  # the same behind each pair
    alphas: Float[Tensor, "G C P"]
    ratios: Float[Tensor, "G C P"]  # alpha / (1 - alpha)
    weights: Float[Tensor, "G C P"]  # alpha times the transmittance in front of the pair
    evaluated: Evaluated  # what else came with the alphas

    def rows_of(self, padded: Float[Tensor, "M+1 F"]) -> Float[Tensor, "G C F"]:
        """The rows of a table that belong to the pairs. [M + 1, F] -> [G, C, F]"""
        return padded.index_select(0, self.rows).view(*self.weights.shape[:2], -1)

    def of_log_alphas(
        self, gained: Float[Tensor, "G C P"], behind: Float[Tensor, "tiles P"], alpha_max: float
    ) -> Float[Tensor, "R P"]:
        """Derivatives of the loss with respect to log(alpha): own contribution less what it occludes.

        Behind the stop, and where alpha is clamped, they are 0. ``gained`` is the first-order contribution of each pair
        and is overwritten; ``behind`` is that of all pairs not yet swept, and is reduced by this chunk's.
        """
        hidden = behind[self.tiles][:, None] - gained.cumsum(1)
        behind[self.tiles] = hidden[:, -1]
        # d loss / d log(alpha) = alpha (T g - hidden / (1 - alpha))
        result = gained.sub_(hidden.mul_(self.ratios))
        return result.mul_(self.weights > 0).mul_(self.alphas < alpha_max).flatten(0, 1)


def sweep(
    evaluate: Callable[[Int[Tensor, "R"]], tuple[Float[Tensor, "R P"], Evaluated]],
    starts: Int[Tensor, "tiles+1"],
    ones: Float[Tensor, "P"],
    cuts: CutSettings,
) -> Iterator[Chunk[Evaluated]]:
    """Iterate over every tile's pairs front to back until they end or no pixel has transmittance left.

    ``evaluate`` gives alphas of pairs at the pixels of their tiles before clamping and cut-off, in a tensor that may be
    overwritten, and what else the caller wants of these pairs; the alpha of row M, one past the end, must be 0.
    ``starts`` is the first pair of each tile, and M; ``ones`` is 1 for each pixel of a tile, of the result's dtype and
    device.
    """
    budget = CHUNK_ELEMENTS.get(ones.device.type, CHUNK_ELEMENTS["cuda"]) // len(ones)
    alpha_below = _just_below(cuts.alpha_min, ones)
    transmittance_below = _just_below(cuts.transmittance_min, ones)
    # Tiles with similar numbers of pairs are grouped, so that few rows are padding.
    counts, occupied = starts.diff().sort(descending=True, stable=True)
    occupied = occupied[: int((counts > 0).sum())]
    padding = int(starts[-1])
    for group in torch.split(occupied, max(1, budget // _MIN_RANKS)):
        tiles = group
        first, end = starts[tiles], starts[tiles + 1]
        before = ones.expand(len(tiles), -1)
        while len(tiles):
            longest = int((end - first).max())
            ranks = min(longest, _MAX_RANKS, max(_MIN_RANKS, budget // len(tiles)))
            rows = first[:, None] + torch.arange(ranks, device=first.device)
            rows = torch.where(rows < end[:, None], rows, padding).flatten()
            flat, evaluated = evaluate(rows)
            alphas = flat.view(len(tiles), ranks, -1).clamp_(max=cuts.alpha_max)
            torch.threshold_(alphas, alpha_below, 0.0)
            through = 1 - alphas
            ratios = alphas / through
            through[:, 0] *= before
            transmittances = through.cumprod_(1)
            # Transmittance only falls, so setting it to zero below the bound stops compositing for good.
            torch.threshold_(transmittances, transmittance_below, 0.0)
            # alpha T in front = alpha / (1 - alpha) T behind, which is 0 for the pair that would cross the bound.
            weights = ratios * transmittances
            yield Chunk(tiles, rows, before, transmittances, alphas, ratios, weights, evaluated)
            before = transmittances[:, -1].clone()
            first = first + ranks
            alive = (first < end) & (before.amax(-1) > 0)
            if not bool(alive.all()):
                tiles, first, end, before = tiles[alive], first[alive], end[alive], before[alive]


def padded_rows(rows: Float[Tensor, "M K"], log_alpha: int) -> Float[Tensor, "M+1 K"]:
    """Rows with one more, whose alpha is 0 everywhere: column ``log_alpha`` is added to its logarithm. [M + 1, K]"""
    padded = torch.nn.functional.pad(rows, (0, 0, 0, 1))
    padded[-1, log_alpha] = _LOG_ZERO
    return padded


def crossing_of_half(chunk: Chunk[Evaluated]) -> tuple[Int[Tensor, "G P"], Bool[Tensor, "G P"]]:
    """Index of the pair that brings the transmittance to one half or less, and whether one does. [G, P], [G, P]"""
    crossing = (chunk.transmittances > 0.5).sum(1, keepdim=True).clamp_max(chunk.weights.shape[1] - 1)
    crosses = (chunk.before > 0.5) & (chunk.transmittances.gather(1, crossing).squeeze(1) <= 0.5)
    return crossing.squeeze(1), crosses & (chunk.weights.gather(1, crossing).squeeze(1) > 0)


def _just_below(value: float, like: Tensor) -> float:
    """The largest number under ``value``; ``threshold`` drops what equals its bound, and a cut keeps it."""
    number = torch.tensor(value, dtype=like.dtype)
    return float(torch.nextafter(number, torch.zeros_like(number)))
