"""Neighbours of a frame, chosen by their distance from it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from coliags_plugin.reconstruction.depth.settings import DepthSettings


def choose_neighbours(
    centers: Float[np.ndarray, "N 3"],
    axes: Float[np.ndarray, "N 3"],
    depths: Sequence[float],
    baselines: Sequence[float],
    settings: DepthSettings,
) -> list[list[int]]:
    """Neighbours of every frame of a video: for each baseline the first frame so far away, before and after it.

    Where the video ends on one side, the other gives more frames, farther away. A pause adds no frames, as they are
    chosen by distance, not by number.

    Args:
        centers: Camera centres in video order. [N, 3]
        axes: Unit optical axes. [N, 3]
        depths: Median depth of every frame. [N]
        baselines: Distances in units of it.
        settings: See ``max_baseline`` and ``max_turn``.

    Returns:
        For every frame the indices of its neighbours, ascending.
    """
    baselines = sorted(baselines)
    farther = [baselines[-1] + (baselines[-1] / len(baselines)) * step for step in range(1, len(baselines) + 1)]
    least_cosine = np.cos(np.radians(settings.max_turn))
    found = []
    for index in range(len(centers)):
        distance = np.linalg.norm(centers - centers[index], axis=1) / depths[index]
        seen = (axes @ axes[index] >= least_cosine) & (distance <= settings.max_baseline)
        before, after = np.arange(index - 1, -1, -1), np.arange(index + 1, len(centers))
        sides = [_first_beyond(distance, side, seen, baselines) for side in (before, after)]
        for own, other, side in ((0, 1, before), (1, 0, after)):
            lacking = len(baselines) - len(sides[other])
            if lacking > 0:
                sides[own] = _first_beyond(distance, side, seen, [*baselines, *farther[:lacking]])
        found.append(sorted({*sides[0], *sides[1]}))
    return found


def _first_beyond(distance: np.ndarray, side: np.ndarray, seen: np.ndarray, baselines: Sequence[float]) -> list[int]:
    """The first frame of one side of the video beyond each baseline, without repetition."""
    found = []
    for baseline in baselines:
        beyond = side[(distance[side] >= baseline) & seen[side]]
        if len(beyond) and int(beyond[0]) not in found:
            found.append(int(beyond[0]))
    return found
